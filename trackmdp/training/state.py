"""The whole state of a run: when it is saved, between two iterations, and how it is put back, exactly, or refused."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from trackmdp.algos.common import Algorithm
from trackmdp.config import CheckpointConfig, TrainConfig
from trackmdp.config.tree import flatten
from trackmdp.errors import Preempted, UserError
from trackmdp.machine import make_device
from trackmdp.training import checkpoint
from trackmdp.training.callbacks import Callback, Position, Row, Training
from trackmdp.training.collect import collectors
from trackmdp.training.inputs import identity
from trackmdp.untrusted import decoded
from trackmdp.world.group import Subject

PACKAGES = ("torch", "torchrl", "tensordict", "hydra-core", "numpy", "scipy")
_NOT_WEIGHTS = {"optimizer", "buffer", "generator", "explore", "unit"}
"""Parts of a state that are not learned: how much is explored, and the prices in which `AdditiveQ` counts, are the new
run's own."""
version = cache(metadata.version)  # read from files, which each checkpoint would do again
_SAVING = 50  # seconds of training to one of saving, at least


def capture(trainer: Training, folder: Path) -> dict[str, Any]:
    """Everything that the next iteration depends on, and the files written so far.

    Networks, optimizers, schedules and buffers; rows in mid-episode and the environment's generators; how far the run
    is; states of the callbacks by their names, such as how many bytes of `metrics.csv` there are.
    """
    collector = trainer.collector
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {
        "identity": identity(trainer.config, folder, trainer.problem),
        "versions": _versions(trainer.config),
        "algorithm": trainer.algorithm.state_dict(),
        # None for collectors in worker processes: their environments cannot be saved and begin new episodes.
        "collector": {"environment": collector.env.snapshot()}
        if isinstance(collector, collectors.Collector)
        else None,
        "random": {"cpu": torch.get_rng_state(), "cuda": cuda},
        "position": vars(trainer.position),
        "callbacks": {each.name: each.state_dict() for each in trainer.callbacks if each.name},
    }


def _versions(cfg: TrainConfig) -> dict[str, str]:
    """Of all that draws and rounds: packages, and kinds of devices, whose generators differ."""
    devices = {"device": cfg.device, "collector.device": cfg.collector.device}
    kinds = {key: make_device(name, key).type for key, name in devices.items()}
    return {name: version(name) for name in (*PACKAGES, "trackmdp")} | kinds


def restore(
    state: Mapping[str, Any], algorithm: Algorithm, collector: collectors.BaseCollector
) -> Position:
    """Put a captured state back, the random generators last; call after everything has been built."""
    algorithm.load_state_dict(state["algorithm"])
    if state["collector"] is not None and isinstance(collector, collectors.Collector):
        # Private, but in no state_dict of TorchRL: the observations with which the next batch begins, rows in
        # mid-episode. An episode's end is not among them, for the environment has begun the next one in that row.
        collector._carrier.update(collector.env.restore(state["collector"]["environment"]))
    # Last, since building the learner and the collector (which resets its environments) draws numbers. `.cpu()`: with
    # device=cuda the checkpoint's tensors were loaded to the GPU, generators' states must lie on the CPU.
    torch.set_rng_state(state["random"]["cpu"].cpu())
    if state["random"]["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all([rng.cpu() for rng in state["random"]["cuda"]])
    return Position(**state["position"])


def find(
    cfg: TrainConfig, problem: Subject, folder: Path, device: torch.device
) -> tuple[dict[str, Any] | None, list[str]]:
    """The state to resume from, None to start anew; and a line for each checkpoint that had to be passed over.

    `resume=auto` and a run's folder fall back to the newest checkpoint that can be read and is this run's; a checkpoint
    named by itself is taken or refused.

    Raises:
        UserError: every one is damaged, or belongs to another run or to other versions.
    """
    if cfg.resume is None:
        return None, []
    named = Path(cfg.resume)
    # Newest first: after a power failure the last one may be damaged while the one before is whole.
    files = [named] if named.is_file() else checkpoint.available_checkpoints(folder / "checkpoints")
    if not files and cfg.resume == "auto":
        return None, []
    passed_over: list[str] = []
    for file in files:
        try:
            state = checkpoint.load(file, device)
            # Refused before anything is put back: half a state would be worse than none.
            _check(state, cfg, problem, file)
        except UserError as error:
            passed_over.append(str(error))
            continue
        return {**state, "file": str(file)}, passed_over
    raise UserError(
        f"resume={cfg.resume}: no checkpoint to resume from ({'; '.join(passed_over) or 'there is none'})"
    )


def take_weights(algorithm: Algorithm, run: Path, device: torch.device) -> list[str]:
    """Start from the weights of another run's newest checkpoint, where name and shape fit; returns the names taken.

    Raises:
        UserError: there is no such run, it has no checkpoint, nothing of it fits, or there are no networks yet.
    """
    file = checkpoint.newest(run, "init_from")
    state = checkpoint.load(file, device)
    own, taken = algorithm.state_dict(), []
    if not (ours := _weights(own)):
        raise UserError(
            f"init_from={run}: the learner makes its networks from its data, expected null, or a2c, ppo or dqn"
        )
    with torch.no_grad(), decoded(str(file), "the weights of a run"):
        given = dict(_weights(state["algorithm"]))
        for name, tensor in ours:
            if name in given and given[name].shape == tensor.shape:
                # Into the tensors of our own state, which is then loaded as a whole: state_dict may have handed out
                # copies.
                tensor.copy_(given[name])
                taken.append(name)
    if not taken:
        raise UserError(
            f"init_from={run}: none of its weights has the name and shape of one of ours"
        )
    algorithm.load_state_dict(own)
    return taken


def load_learned(
    algorithm: Algorithm, cfg: TrainConfig, problem: Subject, file: Path, device: torch.device
) -> None:
    """Put the learner of a checkpoint of the run `cfg` back, to use its policy.

    Raises:
        UserError: the checkpoint is damaged, belongs to another run, or does not fit.
    """
    state = checkpoint.load(file, device)
    _check_identity(state, cfg, problem, file)
    with decoded(str(file), "a state that fits this run"):
        algorithm.load_state_dict(state["algorithm"])


def _check_identity(
    state: Mapping[str, Any], cfg: TrainConfig, problem: Subject, file: Path
) -> None:
    folder = file.parent.parent  # RUN/checkpoints/iteration-00000012.pt
    if state.get("identity") != identity(cfg, folder, problem):
        raise UserError(f"{file}: belongs to a run with another config or problem")


def _check(state: Mapping[str, Any], cfg: TrainConfig, problem: Subject, file: Path) -> None:
    """See that the state is one to resume from, before anything of it is used."""
    _check_identity(state, cfg, problem, file)
    with decoded(str(file), "the state of a run"):
        # Another version may draw or round otherwise: the run would go on, but not as the one that was interrupted.
        for name, here in _versions(cfg).items():
            if (written := state["versions"][name]) != here:
                raise UserError(
                    f"{file}: written with {name} {written}, this is {here}; expected the same"
                )
        at = Position(**state["position"])
        # A negative or far position would end the run at once, as if it were done.
        if at.iteration != state["iteration"] or not 0 <= at.frames < 2**53:
            raise ValueError(f"a position at iteration {at.iteration}, {at.frames} frames")
        state["callbacks"][Checkpoints.name]  # without these states metrics.csv would begin anew


def _weights(state: Mapping[str, Any]) -> list[tuple[str, torch.Tensor]]:
    """The floating-point tensors of an algorithm's state that belong to networks."""
    return [
        (name, value)
        for name, value in flatten(state).items()
        if not _NOT_WEIGHTS & {*name.split(".")}
        and isinstance(value, torch.Tensor)
        and value.is_floating_point()
    ]


class Checkpoints(Callback):
    """Saves the run by frames and by time, at its end, and where a signal asks for its end.

    Args:
        cfg: how often, and how many checkpoints are kept.
        folder: of the checkpoints.
    """

    name = "checkpoints"

    def __init__(self, cfg: CheckpointConfig, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder
        self._best, self._rest = -math.inf, 0.0
        self._is_best = False

    def on_start(self, trainer: Training) -> None:
        """Intervals count from where the run is.

        The process that wrote the checkpoint may have been killed before last.pt and best.pt were the same file.
        """
        self._saved = trainer.position
        file = checkpoint.named(self._folder, trainer.position.iteration)
        if trainer.position.iteration and file.is_file():
            self._put_best_right(trainer, file.with_name(checkpoint.BEST))
            checkpoint.point(file, best=self._is_best)

    def _put_best_right(self, trainer: Training, best: Path) -> None:
        """Where best.pt is damaged, or of another course of the run, the checkpoint of the start takes its place.

        Its figure is then its own: the one in its state may be of a checkpoint that was removed.
        """
        if self._best == -math.inf:
            best.unlink(missing_ok=True)  # no checkpoint up to here counts
        elif not self._is_best:
            try:
                if checkpoint.load(best)["iteration"] < trainer.position.iteration:
                    return
            except UserError:
                pass
            score = trainer.evaluator.score(trainer.policy())
            self._best, self._is_best = score.evaluation.aihtr, True

    def on_update(self, trainer: Training, row: Row) -> None:  # noqa: ARG002
        """Save after the last iteration, and where it is due."""
        if self._is_planned(trainer) or self.due(trainer.position):
            self.save(trainer)

    def on_end(self, trainer: Training) -> None:
        """Save where a signal ended the run: that is the one error that leaves a state between two iterations."""
        if isinstance(trainer.error, Preempted) and trainer.position != self._saved:
            self.save(trainer)

    def due(self, at: Position) -> bool:
        """Whether to save at `at`.

        By time not before training took 50 times as long as the last saving, which would else take too much of it.
        """
        seconds = self._cfg.seconds is not None and at.seconds - self._saved.seconds >= max(
            self._cfg.seconds, self._rest
        )
        return self._passes_multiple(at) or seconds

    def _passes_multiple(self, at: Position) -> bool:
        # Multiples that were passed, since batches seldom end on one: every=30,000 with batches of 20,000 saves at
        # 40,000, 60,000 and 100,000.
        every = self._cfg.every
        return every > 0 and at.frames // every > self._saved.frames // every

    def _is_planned(self, trainer: Training) -> bool:
        """Whether this iteration is saved in every run of this config, cut or not."""
        return trainer.position.iteration == trainer.iterations or self._passes_multiple(
            trainer.position
        )

    def save(self, trainer: Training) -> None:
        """Save the run as it is, and call the callbacks."""
        begin = time.monotonic()
        # Where checkpoints are counted in frames, one that a signal or the clock asked for is none of the candidates:
        # else which one is the best would depend on where the run was cut.
        counts = not self._cfg.every or self._is_planned(trainer)
        aihtr = self._attained(trainer) if counts else -math.inf
        self._is_best, self._best = aihtr > self._best, max(self._best, aihtr)
        # `_best` and `_is_best` are part of the state, so they are set before it is taken. The logs are called before
        # this callback: the lengths of files in their states include this iteration's row and episodes.
        state = capture(trainer, self._folder.parent)
        file = checkpoint.save(
            self._folder, trainer.position.iteration, state, keep=self._cfg.keep, best=self._is_best
        )
        # Measured, since saving a large replay buffer to a slow disk may take longer than the interval asked for.
        self._saved, self._rest = trainer.position, _SAVING * (time.monotonic() - begin)
        for callback in trainer.callbacks:
            callback.on_checkpoint(trainer, file)

    def _attained(self, trainer: Training) -> float:
        """AIHTR of the very policy that is saved.

        The last evaluation may be of an earlier policy, and of another one in a run that was resumed in
        between: best.pt would depend on where a run was cut.
        """
        # Evaluating draws from no generator of the run, so that saving more often leaves the run as it is.
        score = trainer.score if trainer.evaluates else trainer.evaluator.score(trainer.policy())
        return score.evaluation.aihtr

    def state_dict(self) -> dict[str, Any]:
        """The highest AIHTR of the checkpoints that count, and whether it is this one's."""
        return {"best": self._best, "is_best": self._is_best}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._best, self._is_best = float(state["best"]), state["is_best"]
