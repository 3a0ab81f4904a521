"""From the words of a command to its run: Hydra composes the config, every check runs before a folder is made."""

from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import _run_hydra, create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from trackmdp.config import (
    ROOTS,
    CommandConfig,
    EvaluateConfig,
    ExportConfig,
    TrainConfig,
    WorldConfig,
    conf_dir,
    from_hydra,
    load_run,
    register,
)
from trackmdp.config.resume import continued, run_folder
from trackmdp.diagnose import diagnose
from trackmdp.errors import FAILED, USER_MISTAKE, RunError, UserError
from trackmdp.outputs import make_folder, remove_if_empty

__all__ = ["launch"]

WORLD_KEYS = ("grid", "kernel", "cost")


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
        if args.multirun or any(word.startswith("hydra.mode=") for word in args.overrides):
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
    job = _Job(command, sweeps=False)
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
    cfg = _compose(command, args, hydra, RunMode.MULTIRUN)
    folder = Path(cfg.hydra.sweep.dir)
    made = make_folder("hydra.sweep.dir", folder)
    job = _Job(command, sweeps=True)
    overrides = [*args.overrides, "hydra.mode=MULTIRUN", _assign("hydra.sweep.dir", folder)]
    try:
        if not cfg.quiet:
            _say(f"{command} sweep -> {folder}")
        hydra.multirun(_config_name(command, args), job, overrides)
    except (HydraException, OmegaConfBaseException) as error:  # refused before the first job
        if job.started:
            raise
        if made:
            (folder / "multirun.yaml").unlink(missing_ok=True)
        raise diagnose(error, command, args.overrides, _composer(command, args, hydra)) from error
    except Exception:
        if not job.failures:
            raise
    finally:
        remove_if_empty(made)
    if not job.failures:
        return 0
    sys.stderr.write(
        f"trackmdp {command}: {len(job.failures)} of {job.started} jobs failed: {'; '.join(job.failures)}\n"
    )
    return FAILED if job.broken else USER_MISTAKE


@dataclass
class _Job:
    """What Hydra calls for each job: here, or in another process with a launcher plug-in."""

    command: str
    sweeps: bool
    started: int = 0
    told: UserError | RunError | None = None
    failures: list[str] = field(default_factory=list)
    broken: int = 0

    def __call__(self, cfg: DictConfig) -> Any:
        hydra = HydraConfig.get()
        self.started += 1
        folder, typed_in, task = Path(hydra.runtime.output_dir), Path(hydra.runtime.cwd), list(hydra.overrides.task)
        try:
            typed = _checked(self.command, cfg, task, typed_in)
            if isinstance(typed, TrainConfig):
                typed = continued(typed, folder, task)
            if self.sweeps:
                announce(
                    self.command, typed, folder.relative_to(typed_in) if folder.is_relative_to(typed_in) else folder
                )
            run: Callable[[Any, Path], Any] = importlib.import_module(f"trackmdp.commands.{self.command}").run
            return run(typed, folder)
        except Exception as error:
            if not self.sweeps and isinstance(error, (UserError, RunError)):
                self.told = error  # raised once Hydra is done: it would add lines of its own
                return None
            if self.sweeps:
                self._report(error, f"job {hydra.job.num} ({', '.join(task)})", folder)
            raise

    def _report(self, error: Exception, name: str, folder: Path) -> None:
        """Say at once which job of a sweep failed; the others go on."""
        remove_if_empty([folder])
        self.broken += not isinstance(error, UserError)
        if not isinstance(error, (UserError, RunError)):
            traceback.print_exc()
        self.failures.append(f"{name}: {' '.join(str(error).split()) or type(error).__name__}")
        sys.stderr.write(f"trackmdp {self.command}: {self.failures[-1]}\n")


def announce(command: str, cfg: CommandConfig, folder: Path) -> None:
    """The first line at the terminal, before anything heavy is imported."""
    if cfg.quiet or not isinstance(cfg, WorldConfig):
        return
    what = next((getattr(cfg, name).name for name in ("algo", "baseline", "solver") if getattr(cfg, name, None)), "")
    if isinstance(cfg, EvaluateConfig) and cfg.run is not None:
        _say(f"evaluate {cfg.run} -> {folder}")
        return
    n = cfg.grid.size
    seed = f", seed {cfg.seed}" if hasattr(cfg, "seed") else ""
    where = f"on a {n}x{n} grid, T_max {cfg.grid.t_max}, kernel {cfg.kernel.name}{seed}"
    _say(" ".join(f"{command} {what} {where} -> {folder}".split()))


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _checked(command: str, cfg: DictConfig, task: Sequence[str], folder: Path) -> CommandConfig:
    """The typed config of one job, with every check that does not need the heavy libraries."""
    if "hydra" in cfg:
        cfg = cfg.copy()
        cfg._set_flag("struct", False)
        del cfg["hydra"]
    typed = from_hydra(cfg, ROOTS[command], folder)
    if isinstance(typed, EvaluateConfig) and typed.run is not None:
        for word in task:
            key = word.lstrip("+~").split("=")[0]
            if key.split(".")[0].split("@")[0] in WORLD_KEYS:
                raise UserError(f"{word}: not together with run={typed.run}, whose own world is used")
        load_run(typed.run)
    elif isinstance(typed, ExportConfig):
        load_run(typed.run)
    elif isinstance(typed, WorldConfig) and reads_files(typed):
        from trackmdp.build import make_world

        make_world(typed)
    return typed


def reads_files(cfg: WorldConfig) -> bool:
    """Whether building the world can still fail: it is read from files, or its target may never exit."""
    exits = getattr(cfg.kernel, "exit_probability", 0.0) > 1e-9
    return not exits or isinstance(getattr(cfg.cost, "sensor", None), str)


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
