"""Hydra's own flags, and its answers to questions about the config: --cfg, --info, --hydra-help, --shell-completion."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from trackmdp import __version__
from trackmdp.app.compose import Composer
from trackmdp.errors import UserError

_INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Flags and overrides of a command line; the flags are those that Hydra's own commands have.

    Raises:
        UserError: a flag is unknown, lacks its value, or does not go with another.
    """
    # Intermixed: Hydra users write flags between overrides, `train algo=ppo -m seed=0,1`.
    args = _parser().parse_intermixed_args(list(words))
    # It is offered by the parser all the same, so that the refusal can say why.
    if args.experimental_rerun is not None:
        raise UserError("--experimental-rerun: not offered, it would unpickle a file; start from the run's config.yaml")
    asked = [args.cfg, args.info, args.hydra_help or None, args.shell_completion or None, args.multirun or None]
    if sum(each is not None for each in [*asked, args.run or None]) > 1:
        raise UserError("expected only one of --run, --multirun, --cfg, --info, --hydra-help and --shell-completion")
    if args.cfg is None and (args.resolve or args.package is not None):
        raise UserError("--resolve and --package: only together with --cfg")
    return args


def answer(compose: Composer, args: argparse.Namespace) -> bool:
    """Show what was asked for; returns whether anything was, instead of a run.

    Raises:
        UserError: the words do not make a config, or the question makes no sense.
    """
    if not (args.cfg or args.info or args.hydra_help or args.shell_completion):
        return False
    hydra = GlobalHydra.instance().hydra  # its methods print; what they print is Hydra's business, not ours
    assert hydra is not None
    if args.cfg or args.info:
        cfg = compose(compose.words)
        if args.package not in (None, "_global_") and OmegaConf.select(cfg, args.package) is None:
            raise UserError(f"--package {args.package}: not in the config")
    try:
        if args.cfg:
            hydra.show_cfg(compose.name, compose.words, args.cfg, args.package, args.resolve)
        elif args.info:
            hydra.show_info(args.info, compose.name, compose.words)
        elif args.hydra_help:
            args.overrides = []  # Hydra's help is about no command
            hydra.hydra_help(None, _parser(), args)
        else:
            hydra.shell_completion(compose.name, compose.words)
    except Exception as error:  # of many kinds; all are about what was typed
        said = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(said[0]) from error
    return True


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        """Refuse as every mistake is refused: in one line, without the usage."""
        raise UserError(f"{message} (see --help)")


def _parser() -> argparse.ArgumentParser:
    # An abbreviation that works today would be ambiguous once another flag begins alike.
    parser = _Parser(add_help=False, allow_abbrev=False)
    flag = parser.add_argument
    flag("overrides", nargs="*", help="option=value, to set a value or choose from a group")
    flag("--help", "-h", action="store_true", help="the command's help")
    flag("--hydra-help", action="store_true", help="Hydra's help")
    flag("--version", action="version", version=f"trackmdp {__version__}", help="show the version")
    flag("--cfg", "-c", choices=["job", "hydra", "all"], help="show the config instead of running")
    flag("--resolve", action="store_true", help="with --cfg: resolve interpolations")
    flag("--package", "-p", help="with --cfg: the part to show, such as algo")
    flag("--run", "-r", action="store_true", help="run once")
    flag("--multirun", "-m", action="store_true", help="run once for every combination of option=a,b,c")
    flag("--shell-completion", "-sc", action="store_true", help="install=bash, uninstall=bash, query=bash")
    flag("--config-name", "-cn", help="the primary config in place of the command's")
    flag("--config-dir", "-cd", help="a folder with further choices")
    flag("--experimental-rerun", help="not offered")
    flag("--info", "-i", const="all", nargs="?", choices=_INFO, help="show how the config is composed")
    return parser
