"""From a composed config to one that can be run: every check that comes before the first folder is made."""

from __future__ import annotations

import errno
import importlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from trackmdp import config
from trackmdp.config import CommandConfig, TrainConfig, WorldConfig, load_run_config
from trackmdp.config.checks import refuse_ignored
from trackmdp.config.compose import composed_values, config_of
from trackmdp.config.learning import file_of_classes
from trackmdp.config.logs import require_packages
from trackmdp.config.resume import by_key, continued, key_of, run_folder
from trackmdp.errors import RunError, UserError, message_of
from trackmdp.imports import importing
from trackmdp.machine import make_device

if TYPE_CHECKING:
    from trackmdp.world.group import Subject


@dataclass(frozen=True)
class Prepared:
    """A command that can be run: all that can be checked has been.

    Attributes:
        command: the command to run.
        cfg: its config.
        folder: where it writes.
        problem: the world or the tracks of `cfg`, where checking has built them; else `run` builds them, when the
            command's first line is on the terminal.
    """

    command: str
    cfg: CommandConfig
    folder: Path
    problem: Subject | None = None

    def run(self) -> Any:
        """Run the command; returns its result.

        Raises:
            RunError: its folder was removed meanwhile, or a file could not be written.
        """
        # Not at the top of the file: a command imports torch and TorchRL, which takes seconds, and a mistyped option
        # is refused before.
        with importing():
            run: Callable[..., Any] = importlib.import_module(
                f"trackmdp.app.commands.{self.command}"
            ).run
        try:
            if isinstance(self.cfg, WorldConfig):
                return run(self.cfg, self.folder, self.problem or _problem(self.cfg, self.folder))
            return run(self.cfg, self.folder)
        except OSError as error:
            # Somebody tidied up while the run was on; "no such file" about a part of a checkpoint would puzzle.
            if not self.folder.is_dir():
                raise RunError(
                    f"hydra.run.dir={self.folder}: the folder was removed while the run wrote to it"
                ) from error
            if error.filename and error.errno != errno.ENOENT:  # as a full disk
                raise RunError(f"{error.filename}: {error.strerror}") from error
            raise


def prepare(command: str, composed: DictConfig, words: Sequence[str]) -> Prepared:
    """From Hydra's config to a command that can be run in the current folder, by every check there is.

    Raises:
        UserError: an option is not allowed, or the file it names is missing or not as expected.
    """
    schema = config.ROOTS[command]
    values = composed_values(composed, schema)
    resumes = values.get("resume") is not None
    # Those of a run that goes on are for its own options, which the defaults here are not.
    cfg = config_of(values, schema, rules=not resumes)
    if not resumes:
        refuse_ignored(cfg, by_key(words))
    # Where a sweep is watched no folder for a report is made.
    watched = isinstance(cfg, config.ReportConfig) and cfg.watch
    folder = Path(cfg.sweep) if watched else folder_of(composed, "hydra.run.dir")
    prepared = check(command, cfg, folder, words)
    if resumes:  # a run that goes on has a config of its own
        refuse_ignored(prepared.cfg, by_key(words))
    _check_here(prepared.cfg, prepared.folder)
    return prepared


def check(command: str, cfg: CommandConfig, folder: Path, words: Sequence[str]) -> Prepared:
    """Check the files that the config names: runs, sweeps, files to write, tables of motion and prices.

    Args:
        command: the command to run.
        cfg: its typed config.
        folder: where it is to write, unless `cfg.resume` names a run, which then goes on in its own folder.
        words: the overrides that were typed.

    Raises:
        UserError: a named file is missing, or not as expected.
    """
    try:
        if isinstance(cfg, TrainConfig):
            # A resumed run goes on under its saved config, so that everything after this line looks at that one.
            folder = run_folder(cfg, folder)
            cfg = continued(cfg, folder, words)
            require_packages(cfg.log)
        _check_files(cfg, folder, words)
        # A world from options alone cannot fail once they are in range; one from files can, and is refused before a
        # folder is made.
        problem = None
        if isinstance(cfg, WorldConfig) and _reads_files(cfg):
            problem = _problem(cfg, folder)
    except OSError as error:
        raise UserError(f"{error.filename}: cannot be read ({error.strerror})") from error
    return Prepared(command, cfg, folder, problem)


def announce(ready: Prepared, label: str = "") -> None:
    """The first line at the terminal, before anything heavy is imported; `label` goes before it in brackets."""
    cfg, to = ready.cfg, f"-> {shown(ready.folder)}"
    if cfg.quiet or not isinstance(cfg, WorldConfig):
        return
    head = f"({label}) {ready.command}" if label else ready.command
    if runs := _runs(cfg):
        say(f"{head} {', '.join(runs)} {to}")
        return
    chosen = (getattr(cfg, name, None) for name in ("algo", "baseline", "solver"))
    subject = next((f" {each.name}" for each in chosen if each), "")
    rows, columns = cfg.grid.sides
    seed = f", seed {cfg.seed}" if hasattr(cfg, "seed") else ""
    where = f"on a {rows}x{columns} grid, T_max {cfg.grid.t_max}, kernel {cfg.kernel.name}{seed}"
    line = f"{head}{subject} {where}"
    # On two lines rather than broken within a name, at the width that every terminal has.
    say(f"{line}{' ' if len(line) + len(to) < 80 else chr(10) + '  '}{to}")


def shown(folder: Path) -> Path:
    """The folder as seen from the current one, where it lies in it."""
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _reads_files(cfg: WorldConfig) -> bool:
    """Whether building the world can still fail: it is read from files, or its target may never exit."""
    # Where the target never exits, the undiscounted value is infinite, which only building the world finds out.
    exits = getattr(cfg.kernel, "exit_probability", 0.0) > 1e-9
    tables = [getattr(cfg.cost, "sensor", None), *vars(cfg.sensor).values()]
    return not exits or any(isinstance(table, str) for table in tables)


def _problem(cfg: WorldConfig, folder: Path) -> Subject:
    """The world or the tracks of `cfg`; those of a run that `folder` holds already are read from there."""
    # Imported here: scipy takes longer than all other checks.
    if isinstance(cfg, TrainConfig):
        from trackmdp.training.inputs import problem_of

        return problem_of(cfg, folder)
    from trackmdp.world.configured import make_problem

    return make_problem(cfg)


def _runs(cfg: CommandConfig) -> list[str]:
    """The runs that `evaluate` or `compare` read their world from; none where it is the options' own."""
    if isinstance(cfg, config.CompareConfig):
        return cfg.runs or []
    return [cfg.run] if isinstance(cfg, config.EvaluateConfig) and cfg.run else []


def _check_files(cfg: CommandConfig, folder: Path, words: Sequence[str]) -> None:
    if isinstance(cfg, config.CompareConfig):
        count = len({*(cfg.runs or []), *(cfg.baselines or [])})
        if count < 2:
            raise UserError(
                f"expected at least two policies, run=FOLDER or baseline=NAME, got {count}"
            )
    begun = (folder / "config.yaml").is_file()  # then the run has its own copy of the classes
    if isinstance(cfg, TrainConfig) and not begun and (classes := file_of_classes(cfg.algo)):
        from trackmdp.algos.estimates.alike import cell_classes  # imports scipy, as a world does

        cell_classes(classes, cfg.grid.sides)
    if runs := _runs(cfg):
        _check_runs(cfg, runs, words)
    elif isinstance(cfg, config.ExportConfig):
        load_run_config(cfg.run)
    elif isinstance(cfg, config.ReportConfig):
        if not Path(cfg.sweep).is_dir():
            raise UserError(f"sweep={cfg.sweep}: no such folder")
        # All folders below would be searched for runs: minutes, for a report of unrelated runs.
        if not Path(cfg.sweep).resolve().name:
            raise UserError(
                f"sweep={cfg.sweep}: expected the folder of a sweep, not the root of the file system"
            )
    elif isinstance(cfg, config.ReplayConfig):
        _check_outputs(cfg)


def _check_here(cfg: CommandConfig, folder: Path) -> None:
    """Refuse devices that this machine lacks, and weights that are not there; runs of a sweep may be elsewhere."""
    devices = {"device": getattr(cfg, "device", "cpu")}
    if isinstance(cfg, TrainConfig):
        devices["collector.device"] = cfg.collector.device
        if cfg.init_from is not None and not (folder / "config.yaml").is_file():
            with importing():
                from trackmdp.training.checkpoint import newest

            newest(Path(cfg.init_from), "init_from")
    if {*devices.values()} != {"cpu"}:  # torch takes seconds
        with importing():
            for key, name in devices.items():
                make_device(name, key)


def _check_runs(cfg: CommandConfig, runs: Sequence[str], words: Sequence[str]) -> None:
    """Refuse words that contradict the runs whose world and policy are judged, or that these leave without effect."""
    # False alarms are for testing trained policies.
    believed = isinstance(getattr(cfg, "sensor", None), config.FalseAlarmConfig)
    own = {"grid", "kernel", "cost", "task"} | ({"sensor"} if not believed else set())
    for word in words:
        if key_of(word).split(".")[0] in own:
            raise UserError(
                f"{word}: not together with run={','.join(runs)}: its own world is used"
            )
    typed = by_key(words)
    for run in runs:
        learned = load_run_config(run)
        if not isinstance(cfg, config.EvaluateConfig):
            continue
        least = learned.targets.count
        if "targets.count" in typed and cfg.targets.count < least:
            raise UserError(
                f"targets.count={typed['targets.count']}: expected at least {least}, as the run has"
            )
        learned.targets.count = max(least, cfg.targets.count)
        # Whether they are read is up to how many targets the run has, and to what it learned of them.
        several = ("targets.", "evaluation.")
        refuse_ignored(learned, {k: v for k, v in typed.items() if k.startswith(several)})


def _check_outputs(cfg: config.ReplayConfig) -> None:
    """Refuse an output that is a folder or a device where a file is to be written, or the other way round."""
    for key in ("html", "layout"):
        if (named := getattr(cfg, key)) is not None:
            place = Path(named)
            if not place.name or place.exists() != place.is_file():
                raise UserError(f"{key}={named}: expected a file to write, not a folder or device")
    if cfg.csv is not None and Path(cfg.csv).exists() and not Path(cfg.csv).is_dir():
        raise UserError(f"csv={cfg.csv}: expected a folder")


def folder_of(cfg: DictConfig, key: str) -> Path:
    """The folder at a dotted key, such as ``hydra.run.dir``, its interpolations resolved.

    Raises:
        UserError: it is missing, empty or no folder's name, or an interpolation in it leads nowhere.
    """
    try:
        value = OmegaConf.select(cfg, key)  # None for a missing key, and for "???"
    except Exception as error:  # a resolver of `${name:...}` may raise anything
        raise UserError(f"{key}: {message_of(error)}") from error
    if not isinstance(value, str):
        raise UserError(f"{key}: missing, expected a folder")
    if not value:  # an unset variable of the shell; to `Path` it is the current folder
        raise UserError(f"{key}=: empty, expected a folder")
    folder = Path(value)
    try:
        # Asked for its error alone: a name that is too long, or a folder that may not be looked into, is refused here
        # in one line.
        folder.exists()
    except OSError as error:
        raise UserError(
            f"{key}={value}: expected a folder that can be written to ({error.strerror})"
        ) from error
    return folder


@contextmanager
def made_folder(key: str, folder: Path, *, written: bool = True) -> Iterator[None]:
    """Make `folder`; of the folders that were not there before, those left empty are removed afterwards.

    Raises:
        UserError: it cannot be made, or with `written` not be written to.
    """
    # Noted before anything is made, so that exactly these are taken away again, also after a signal at any moment.
    path = folder.absolute()
    made = [each for each in (path, *path.parents) if not each.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # A folder that was there already may be read-only: mkdir does not complain, the first file would.
            if written and not os.access(folder, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, "it cannot be written to")
        except OSError as error:
            raise UserError(
                f"{key}={folder}: expected a folder that can be written to ({error.strerror})"
            ) from error
        yield
    finally:
        remove_if_empty(made)


def remove_if_empty(folders: Iterable[Path]) -> None:
    """Remove the folders, in this order, up to the first that is not empty."""
    for folder in folders:
        try:
            folder.rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            return
