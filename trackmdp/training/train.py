"""`train`: learn a policy from Python; names and defaults are those of the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch.nn.parameter import is_lazy

from trackmdp.config import GROUPS, TrainConfig, options
from trackmdp.config.compose import compose, default, given
from trackmdp.config.logs import require_packages
from trackmdp.config.resume import run_folder
from trackmdp.environment.observation import ObservationVector
from trackmdp.errors import UserError, path_of
from trackmdp.seeding import preserved_global_rng, single_precision
from trackmdp.training.blocks import make_trainer
from trackmdp.training.callbacks import Callback
from trackmdp.training.display import make_console
from trackmdp.training.inputs import words_of
from trackmdp.training.lock import locked_run
from trackmdp.training.run import Run, complete
from trackmdp.untrusted import reason
from trackmdp.world.group import Group, Subject, check_problem, learned_in

_OF_PROBLEM = ("grid", "kernel", "cost", "task", "sensor")
"""Options that the command makes a problem of; from Python it is made before."""


def train(
    problem: Subject,
    algo: str = default("algo"),
    *,
    seed: int = 0,
    folder: str | Path | None = None,
    progress: bool = False,
    callbacks: Sequence[Callback] = (),
    actor: TensorDictModuleBase | None = None,
    critic: TensorDictModuleBase | None = None,
    **options: Any,
) -> Run:
    """Learn a sensing policy without the motion model, and evaluate it exactly.

    ::

        run = train(world, "ppo", total_frames=100_000, learning_rate={"end": 1e-4}, **{"collector.envs": 64})

    Args:
        problem: the world, or recorded tracks, or a `Group` of targets; the learner is given the task alone. Of a group
            `a2c`, `ppo` and `dqn` learn from all targets together, the others a single target's plan, to be merged.
        algo: name of the algorithm, as in `trackmdp train algo=...`; by default `model_based`: its estimate follows
            the problem.
        seed: every random draw of the run derives from it; torch's global generators are left as they were.
        folder: made if it is missing, and written to as the command does; None to write nothing. With
            ``resume="auto"`` a run in it is resumed.
        progress: show it at the terminal.
        callbacks: see `trackmdp.training.callbacks`.
        actor: of `a2c` and `ppo`, in place of theirs: a `ProbabilisticActor` with `return_log_prob=True` that reads
            keys of the state, or `observation` (`ObservationVector`). It is trained in place, in memory alone.
        critic: of the same: a module that reads such keys and writes `state_value` `[B, 1]`.
        options: those of the command line, without those of the problem. A name without a dot that the command does
            not have is the algorithm's; a dict holds several options of one node.

    Raises:
        UserError: a name, type or range is wrong, there is not enough memory, or the folder holds another run.
        RunError: learning or writing broke down.
        Preempted: a signal ended the run; with a folder it can be resumed.
    """
    check_problem(problem, "train")
    wrong = (
        [each for each in callbacks if not isinstance(each, Callback)]
        if isinstance(callbacks, Sequence)
        else [callbacks]
    )
    if wrong:
        raise UserError(f"callbacks: a {type(wrong[0]).__name__}, expected a list of Callback")
    place = None if folder is None else path_of(folder, "folder")
    if place is None and (name := next((n for n in ("log", "resume") if options.get(n)), None)):
        raise UserError(f"{name}={options[name]}: expected folder=FOLDER beside it, for its files")
    nets = _nets(problem, {"actor": actor, "critic": critic}, place)
    typed = {_key(name): value for name, value in options.items()}
    typed |= given({"algo": algo}) | {"seed": seed, "quiet": not progress}
    config, subject = _config(problem, typed, place)
    if place is not None:
        _prepare(config, place)
    # Networks of one's own are of the precision that they were made in.
    precision = nullcontext() if nets else single_precision()
    lock = locked_run(place, "folder") if place else nullcontext()
    with lock, preserved_global_rng(), precision:
        console = make_console(quiet=not progress)
        return complete(
            make_trainer(subject, config, place, console, callbacks=callbacks, nets=nets)
        )


def _prepare(config: TrainConfig, folder: Path) -> None:
    """Make the folder of a run.

    Raises:
        UserError: it cannot be made, or holds a run that is not to be resumed; `resume` names no run; or a log's
            package is missing.
    """
    require_packages(config.log)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"folder={folder}: cannot be made ({reason(error)})") from None
    run_folder(config, folder, "folder")


def _config(
    problem: Subject, typed: dict[str, Any], folder: Path | None
) -> tuple[TrainConfig, Subject]:
    """The checked config, and what the learner learns in: of several targets all, or a single one."""
    for name in typed:
        if name.partition(".")[0] in _OF_PROBLEM or name == "targets.count":
            raise UserError(
                f"{name}: of the problem, expected where that is made (make_world, World, load_tracks)"
            )
    config: TrainConfig = compose("train", typed | words_of(problem, folder))
    subject = learned_in(problem, config.targets.count, joint=config.algo.joint)
    if subject is not problem:  # the words name the problem that is in the run's folder
        config = compose("train", typed | words_of(problem, folder, subject))
    return config, subject


def _nets(
    problem: Subject, given: Mapping[str, TensorDictModuleBase | None], folder: Path | None
) -> dict[str, TensorDictModuleBase]:
    """The networks that are given, behind an `ObservationVector` where they read one.

    Raises:
        UserError: they are of another kind, or a folder is given, from which they could not be read back.
    """
    found = {name: net for name, net in given.items() if net is not None}
    for name, net in found.items():
        if isinstance(problem, Group):
            raise UserError(f"{name}: expected none with several targets")
        wanted = {"actor": "action_log_prob", "critic": "state_value"}[name]
        if wanted not in getattr(net, "out_keys", ()):
            raise UserError(
                f"{name}: a {type(net).__name__}, expected a module that writes {wanted}"
            )
        if any(map(is_lazy, net.parameters())):
            raise UserError(
                f"{name}: lazy layers, expected the sizes of all, known after a first call"
            )
        if folder is not None:
            raise UserError(f"folder={folder}: expected None with {name}: its class is in no file")
        if "observation" in net.in_keys:
            # An actor's parts one by one: only the last of a sequence may draw.
            drawing = isinstance(net, ProbabilisticTensorDictSequential)
            whole = ProbabilisticTensorDictSequential if drawing else TensorDictSequential
            found[name] = whole(ObservationVector(problem.task), *(net if drawing else [net]))
    return found


def _key(name: str) -> str:
    """The option, or group of them, that an argument names."""
    known = "." in name or name in options(TrainConfig) or name in GROUPS
    return name if known else f"algo.{name}"
