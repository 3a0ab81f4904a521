"""From the words of a command to its run: composed once, checked once, all before a folder is made.

Hydra's own flags ask about the config instead: --cfg, --info, --hydra-help, --shell-completion.
"""

from __future__ import annotations

import argparse
import io
import shlex
import sys
from collections.abc import Generator, Sequence
from contextlib import closing, nullcontext, redirect_stdout
from dataclasses import replace
from functools import partial
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.utils import configure_log, run_job
from hydra.experimental.callback import Callback
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, read_write

from trackmdp import __version__
from trackmdp.app.completion import bash, complete_line
from trackmdp.app.composer import Composer
from trackmdp.app.prepare import (
    Prepared,
    announce,
    folder_of,
    made_folder,
    prepare,
    say,
)
from trackmdp.app.words import gathered, parsed, run_words
from trackmdp.config import GROUPS, ROOTS
from trackmdp.config.checks import build_config, validate
from trackmdp.config.registry import maker
from trackmdp.config.resume import key_of
from trackmdp.errors import UserError, message_of
from trackmdp.signals import ENDING, handled, leave

_INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
_OF_SWEEPS = ("hydra.sweep", "hydra.launcher")
_OF_SINGLE_RUNS = {
    "hydra.run.dir": "the folder of a sweep is hydra.sweep.dir",
    "hydra.sweep.subdir": "a run's folder has the name of its options",
}
"""Options that a single run, and that a sweep does not read."""


def launch(command: str, words: Sequence[str]) -> int:
    """Compose, check and run `trackmdp command words...`; returns the exit status.

    Raises:
        UserError: the command line, or a file it names, is not as expected; nothing has been written then.
    """
    args = parse(words)
    if command == "compare":
        args.overrides = gathered(args.overrides)
    with Composer(command, args.overrides, args.config_name, args.config_dir) as compose:
        # Before anything is checked or made: `--cfg job` also shows a config that a run would refuse.
        if answer(compose, args):
            return 0
        many = args.multirun or "hydra.mode=MULTIRUN" in args.overrides
        with handled(leave, *ENDING):
            return _sweep(compose) if many else _run_once(compose)


def _run_once(compose: Composer) -> int:
    for word in compose.words:
        if key_of(word).startswith(_OF_SWEEPS):
            raise UserError(f"{word}: without effect on a single run, expected -m beside it")
    cfg = compose(compose.words)
    if cfg.hydra.mode is RunMode.MULTIRUN:  # in a file, as an experiment of the user's
        raise UserError("hydra.mode=MULTIRUN: expected -m on the command line")
    # The default folder has the time in its name: no run would ever be resumed.
    if cfg.get("resume") == "auto" and "${now:" in str(OmegaConf.to_container(cfg.hydra.run)):
        raise UserError("resume=auto: expected hydra.run.dir=FOLDER beside it, the run's own")
    # All checks come first, so that a mistyped line leaves no folder behind.
    ready = prepare(compose.command, cfg, run_words(compose.words))
    # Files of a replay have names of their own, most of them elsewhere; a sweep that is watched may be another user's.
    written = compose.command != "replay" and not getattr(ready.cfg, "watch", False)
    # A run that failed before its first file leaves nothing; one that wrote something keeps it.
    with made_folder("hydra.run.dir", ready.folder, written=written):
        # Hydra marks its part read-only once it is composed.
        with read_write(cfg.hydra):
            cfg.hydra.run.dir = str(ready.folder)  # a run that is resumed writes to its own
        announce(ready)
        grids = OmegaConf.select(cfg, "hydra.sweeper.blocks")  # a single run does not read them
        if grids and not ready.cfg.quiet:
            say("one run with the defaults: -m is missing, which runs all that this config plans")
        _run_in_hydra(cfg, ready)
    return 0


def _run_in_hydra(cfg: DictConfig, ready: Prepared) -> None:
    """Run under Hydra's own settings: logging, environment variables, current folder, the folder `.hydra`."""
    configure_log(cfg.hydra.hydra_logging, cfg.hydra.verbose)
    ready = replace(
        ready, folder=ready.folder.absolute()
    )  # hydra.job.chdir moves the current folder
    raised: list[Exception] = []

    def task(_: DictConfig) -> Any:
        try:
            return ready.run()
        # Kept, since Hydra would add lines of its own. KeyboardInterrupt and `Preempted` pass through it as they are.
        except Exception as error:
            raised.append(error)

    # Hydra's base class, which does nothing, in place of callbacks that a config would name by `_target_`.
    context = HydraContext(GlobalHydra.instance().config_loader(), Callback())  # type: ignore[arg-type]
    # Hydra's public call below its command line: it makes `.hydra`, changes folder and sets the environment, as a user
    # of Hydra expects, without its own parsing of sys.argv and its handling of errors.
    run_job(task, cfg, job_dir_key="hydra.run.dir", job_subdir_key=None, hydra_context=context)
    # Only now, after Hydra has restored the environment and the current folder.
    if raised:
        raise raised[0]


def _sweep(compose: Composer) -> int:
    from trackmdp.app.sweep.plan import plan
    from trackmdp.app.sweep.sweep import sweep
    from trackmdp.training.display import make_console

    command, cfg = compose.command, _of_all_runs(compose)
    # Now, so that a missing package is reported before anything is planned or written.
    sweeper = _plugin("sweeper", cfg.hydra.sweeper)
    launcher = _plugin("launcher", cfg.hydra.launcher)
    _register_name(compose, cfg)
    folder = folder_of(cfg, "hydra.sweep.dir")
    # Absolute: runs start in processes, perhaps on other machines, with another current folder.
    place = folder.absolute()

    console = make_console(cfg.quiet)
    planned = partial(
        plan, command, place, compose, console=console, concurrent=launcher.concurrent
    )
    batches = maker(sweeper)(sweeper, run_words(compose.words), place, planned)
    line = shlex.join(["trackmdp", command, "-m", *compose.words])
    # A search lets go of its study, which it no longer can at Python's end.
    ends = closing(batches) if isinstance(batches, Generator) else nullcontext()
    with made_folder("hydra.sweep.dir", folder), ends:
        # A grid has been composed and checked to the last run by now; a search plans its runs as it goes.
        return sweep(place, command, line, batches, partial(maker(launcher), launcher), console)


def _register_name(compose: Composer, cfg: DictConfig) -> None:
    """Have `${sweep_name:}` resolved, of which `hydra.sweep.dir` is made.

    The same words find the same folder again, and with it the runs that are done. Hydra's own time stamp would begin
    anew each time.
    """

    def name() -> str:
        from trackmdp.app.sweep.plan import sweep_name

        found = _plugin("sweeper", cfg.hydra.sweeper)
        blocks = getattr(found, "blocks", [found.name]) or []
        return sweep_name(compose.command, run_words(compose.words), blocks)

    OmegaConf.register_new_resolver("sweep_name", name, replace=True)


def _of_all_runs(compose: Composer) -> Any:
    """The config of the words that all runs have in common.

    Raises:
        UserError: a word cannot be read, or has no effect on a sweep; or it gives several values to a setting of
            Hydra's own, of which a sweep has one.
    """
    common, several = [], []
    for word in compose.words:
        if why := _OF_SINGLE_RUNS.get(key_of(word)):
            raise UserError(f"{word}: without effect, {why}")
        if not parsed(word).is_sweep_override():
            common.append(word)
        elif run_words([word]):
            several.append(f"{key_of(word)}.")
        else:
            raise UserError(f"{word}: expected one {word.partition('=')[0].split('/')[-1]}")
    # Hydra refuses words with several values outside its own multirun; options of the sweep as a whole have one
    # value. Of `algo=a2c,ppo algo.hidden=64` the default algorithm may not have the second option either.
    return compose([word for word in common if not key_of(word).startswith(tuple(several))])


def _plugin(part: str, node: DictConfig) -> Any:
    """The typed, checked options of `hydra.<part>`.

    Raises:
        UserError: a value is out of its range, the option chosen is none of ours, or a package for it is missing.
    """
    known = GROUPS[f"hydra/{part}"]
    schema: Any = OmegaConf.get_type(node)
    if schema not in known.values():
        raise UserError(f"hydra/{part}: expected one of {', '.join(known)}")
    plain = OmegaConf.to_container(node, resolve=True)
    return validate(build_config(plain, schema, f"hydra.{part}."), f"hydra.{part}")


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Flags and overrides of a command line; the flags of Hydra's own commands.

    Raises:
        UserError: a flag is unknown, lacks its value, or does not go with another.
    """
    # Intermixed: Hydra users write flags between overrides, `train algo=ppo -m seed=0,1`.
    args = _parser().parse_intermixed_args(list(words))
    # Both are offered by the parser all the same, so that the refusal can give the reason.
    if args.config_path is not None:
        raise UserError("--config-path: expected --config-dir FOLDER")
    if args.experimental_rerun is not None:
        raise UserError(
            "--experimental-rerun: not offered, it would unpickle a file; start from the run's config.yaml"
        )
    if args.cfg is None and (args.resolve or args.package is not None):
        raise UserError("--resolve and --package: only together with --cfg")
    return args


def answer(compose: Composer, args: argparse.Namespace) -> bool:
    """Show the information asked for; returns whether any was, instead of a run.

    Raises:
        UserError: the words do not make a config, or the question makes no sense.
    """
    if not (args.cfg or args.info or args.hydra_help or args.shell_completion):
        return False
    hydra = GlobalHydra.instance().hydra  # its methods print
    assert hydra is not None
    if args.cfg or args.info:
        cfg = compose(compose.words)
        _register_name(compose, cfg)
        if args.package not in (None, "_global_") and OmegaConf.select(cfg, args.package) is None:
            raise UserError(f"--package {args.package}: not in the config")
    # Hydra logs its answers, and `logging` shows a traceback for each line that nobody reads: `--info defaults | head`.
    with redirect_stdout(io.StringIO()) as answered:
        try:
            if args.cfg:
                # It is composed: Hydra's own command would do so once more.
                hydra.compose_config = lambda **_: cfg  # type: ignore[method-assign]
                hydra.show_cfg(compose.name, compose.words, args.cfg, args.package, args.resolve)
            elif args.info:
                hydra.show_info(args.info, compose.name, compose.words)
            elif args.hydra_help:
                args.overrides = []  # Hydra's help is about no command
                hydra.hydra_help(None, _parser(), args)
            elif compose.words == ["install=bash"]:
                sys.stdout.write(bash([*ROOTS, "example"]))
            elif compose.words == ["query=bash"]:
                complete_line(hydra, compose.name)
            else:  # Hydra's own scripts know no commands
                given = " ".join(compose.words)
                raise UserError(f"--shell-completion {given}: expected install=bash or query=bash")
        except Exception as error:  # of many kinds; all are about the command line
            raise UserError(message_of(error)) from error
    sys.stdout.write(answered.getvalue())
    return True


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> None:  # type: ignore[override]
        """Refuse as every mistake is refused: in one line, without the usage."""
        _, _, flag = message.partition("unrecognized arguments: --")
        hint = f"write {flag.split()[0].partition('=')[0]}=VALUE" if flag else "see --help"
        raise UserError(f"{message} ({hint})")


def _parser() -> argparse.ArgumentParser:
    # An abbreviation that works today would be ambiguous once another flag begins alike.
    parser = _Parser(add_help=False, allow_abbrev=False)
    flag = parser.add_argument
    flag("overrides", nargs="*", help="option=value, to set a value or choose from a group")
    flag("--help", "-h", action="store_true", help="the command's help")
    flag("--version", action="version", version=f"trackmdp {__version__}", help="show the version")
    flag("--resolve", action="store_true", help="with --cfg: resolve interpolations")
    flag("--package", "-p", help="with --cfg: the part to show, such as algo")
    flag("--config-name", "-cn", help="the primary config in place of the command's")
    flag("--config-dir", "-cd", action="append", default=[], help="a folder with further choices")
    flag("--experimental-rerun", help="not offered")
    flag("--config-path", "-cp", help="not offered")
    one_of = parser.add_mutually_exclusive_group().add_argument
    one_of("--run", "-r", action="store_true", help="run once")
    every = "run once for every combination of option=a,b,c"
    one_of("--multirun", "-m", action="store_true", help=every)
    shown = ["job", "hydra", "all"]
    one_of("--cfg", "-c", choices=shown, help="show the config instead of running")
    how = "show how the config is composed"
    one_of("--info", "-i", const="all", nargs="?", choices=_INFO, help=how)
    one_of("--hydra-help", action="store_true", help="Hydra's help")
    one_of("--shell-completion", "-sc", action="store_true", help="install=bash, query=bash")
    return parser
