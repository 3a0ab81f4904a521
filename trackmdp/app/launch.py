"""From the words of a command to its run: Hydra composes the config, every check runs before a folder is made."""

from __future__ import annotations

import argparse
import importlib
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import _run_hydra, create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from trackmdp.app.diagnose import diagnose
from trackmdp.app.outputs import make_folder, remove_if_empty
from trackmdp.app.prepare import announce, check_files, typed_config
from trackmdp.config import CommandConfig, TrainConfig, conf_dir, register
from trackmdp.config.resume import continued, run_folder
from trackmdp.config.sweeps import BlocksConfig, OptunaConfig, SweeperConfig, plugin
from trackmdp.errors import RunError, UserError

if TYPE_CHECKING:
    from trackmdp.app.sweep.plan import Job

__all__ = ["launch"]


def launch(command: str, words: Sequence[str]) -> int:
    """Compose, check and run `trackmdp command words...`; returns the exit status.

    Raises:
        UserError: what was typed, or a file it names, is not as expected; nothing has been written then.
    """
    version.setbase("1.3")
    register()
    args = _parse(words)
    hydra = _hydra(args)
    try:
        if args.cfg or args.info or args.hydra_help or args.shell_completion:
            return _ask_hydra(command, args, hydra)
        if args.multirun or "hydra.mode=MULTIRUN" in args.overrides:
            return _sweep(command, args, hydra)
        return _run_once(command, args, hydra)
    finally:
        GlobalHydra.instance().clear()


def _run_once(command: str, args: argparse.Namespace, hydra: Hydra) -> int:
    cfg = _compose(command, args, hydra, RunMode.RUN)
    typed = _checked(command, cfg, cfg.hydra.overrides.task, Path.cwd())
    folder = Path(cfg.hydra.run.dir)
    if isinstance(typed, TrainConfig):
        folder = run_folder(typed, folder)
        typed = continued(typed, folder, cfg.hydra.overrides.task)
    made = make_folder("hydra.run.dir", folder)
    job = _Job(command)
    # Hydra composes once more, and the time stamp of the folder must stay.
    overrides = [*args.overrides, "hydra.mode=RUN", _assign("hydra.run.dir", folder)]
    try:
        announce(command, typed, folder)
        hydra.run(_config_name(command, args), job, overrides)
    finally:
        remove_if_empty(made)
    if job.told is not None:
        raise job.told
    return 0


def _sweep(command: str, args: argparse.Namespace, hydra: Hydra) -> int:
    from trackmdp.app.sweep.launchers import make_launcher
    from trackmdp.app.sweep.plan import of_task, sweep_name
    from trackmdp.app.sweep.sweep import sweep
    from trackmdp.training.display import make_console

    cfg = _compose(command, args, hydra, RunMode.MULTIRUN)
    typed, sweeper = of_task(args.overrides), plugin("sweeper", cfg.hydra.sweeper)
    launch_jobs = make_launcher(plugin("launcher", cfg.hydra.launcher))
    grids = (sweeper.blocks or []) if isinstance(sweeper, BlocksConfig) else [sweeper.name]
    OmegaConf.register_new_resolver("sweep_name", lambda: sweep_name(command, typed, grids), replace=True)
    folder = Path(cfg.hydra.sweep.dir)
    batches = _batches(command, args, hydra, sweeper, folder.absolute())
    line = shlex.join(["trackmdp", command, "-m", *args.overrides])
    made = make_folder("hydra.sweep.dir", folder)
    try:
        return sweep(folder.absolute(), command, line, batches, launch_jobs, make_console(cfg.quiet))
    finally:
        remove_if_empty(made)


def _batches(
    command: str, args: argparse.Namespace, hydra: Hydra, sweeper: SweeperConfig, folder: Path
) -> Iterable[Sequence[Job]]:
    """The jobs of a sweep: all at once, or as a search asks for them."""
    from trackmdp.app.sweep.plan import combinations, of_task, plan

    def composed(words: Sequence[str]) -> DictConfig:
        alone = argparse.Namespace(**{**vars(args), "overrides": list(words)})
        return _compose(command, alone, hydra, RunMode.RUN)

    typed = of_task(args.overrides)
    if isinstance(sweeper, BlocksConfig):
        return [plan(command, combinations(sweeper.blocks or [], typed), folder, composed)]
    assert isinstance(sweeper, OptunaConfig)
    from trackmdp.app.sweep.trials import trials

    def planned(words: Sequence[str], telling: set[str]) -> Job:
        return plan(command, [words], folder, composed, telling)[0]

    return trials(sweeper, typed, folder, planned)


@dataclass
class _Job:
    """What Hydra calls to run the command."""

    command: str
    told: UserError | RunError | None = None

    def __call__(self, cfg: DictConfig) -> Any:
        hydra = HydraConfig.get()
        folder, typed_in, task = Path(hydra.runtime.output_dir), Path(hydra.runtime.cwd), list(hydra.overrides.task)
        try:
            typed = _checked(self.command, cfg, task, typed_in)
            if isinstance(typed, TrainConfig):
                typed = continued(typed, folder, task)
            run: Callable[[Any, Path], Any] = importlib.import_module(f"trackmdp.app.commands.{self.command}").run
            return run(typed, folder)
        except (UserError, RunError) as error:
            self.told = error  # raised once Hydra is done: it would add lines of its own
            return None


def _checked(command: str, cfg: DictConfig, task: Sequence[str], folder: Path) -> CommandConfig:
    typed = typed_config(command, cfg, folder)
    check_files(typed, task)
    return typed


def _ask_hydra(command: str, args: argparse.Namespace, hydra: Hydra) -> int:
    """Hydra's own questions: --cfg, --info, --hydra-help, --shell-completion."""
    if not args.hydra_help and not args.shell_completion:
        _compose(command, args, hydra, RunMode.MULTIRUN if args.multirun else RunMode.RUN)
    GlobalHydra.instance().clear()
    try:
        _run_hydra(args, _parser(), _nothing, conf_dir(), _config_name(command, args))
    except (ValueError, HydraException) as error:
        raise UserError(str(error)) from error
    return 0


def _nothing(cfg: DictConfig) -> None:
    """Stands for the run where Hydra only shows something."""


def _compose(command: str, args: argparse.Namespace, hydra: Hydra, mode: RunMode) -> DictConfig:
    compose = _composer(command, args, hydra)
    try:
        return compose(args.overrides, mode)
    except Exception as error:  # Hydra raises many kinds, ValueError among them; all are about what was typed
        raise diagnose(error, command, args.overrides, compose) from error


def _composer(command: str, args: argparse.Namespace, hydra: Hydra) -> Callable[[Sequence[str], RunMode], DictConfig]:
    def compose(overrides: Sequence[str], mode: RunMode) -> DictConfig:
        cfg = hydra.compose_config(_config_name(command, args), list(overrides), mode)
        HydraConfig.instance().set_config(cfg)
        return cfg

    return compose


def _config_name(command: str, args: argparse.Namespace) -> str:
    return args.config_name or command


def _hydra(args: argparse.Namespace) -> Hydra:
    search_path = create_config_search_path(str(Path(args.config_path).absolute()) if args.config_path else conf_dir())
    if args.config_dir is not None:
        folder = Path(args.config_dir).absolute()
        if not folder.is_dir():
            raise UserError(f"--config-dir {args.config_dir}: no such folder")
        search_path.prepend("command-line", f"file://{folder}", SearchPathQuery(provider="schema"))
    return Hydra.create_main_hydra2("trackmdp", search_path)


def _parser() -> argparse.ArgumentParser:
    parser = get_args_parser()

    def refuse(message: str) -> None:
        raise UserError(f"{message} (see --help)")

    parser.error = refuse  # type: ignore[assignment,method-assign]
    return parser


def _parse(words: Sequence[str]) -> argparse.Namespace:
    args = _parser().parse_intermixed_args(list(words))
    if args.experimental_rerun is not None:
        raise UserError("--experimental-rerun: not offered, it would unpickle a file; start from the run's config.yaml")
    return args


def _assign(key: str, folder: Path) -> str:
    """`key='folder'` in Hydra's grammar."""
    quoted = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    return f"{key}='{quoted}'"
