"""The whole state of a run: taken between two iterations, put back exactly, or refused."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from torchrl.collectors import BaseCollector, Collector

from trackmdp.algos.common import Algorithm
from trackmdp.config import TrainConfig
from trackmdp.config.checks import own_paths
from trackmdp.config.tree import fixed_options, flatten
from trackmdp.errors import UserError
from trackmdp.training import checkpoint
from trackmdp.untrusted import decoded

_EXACT = ("torch", "torchrl", "tensordict", "numpy", "scipy", "hydra-core", "trackmdp")
_PARTS = {"format", "iteration", "identity", "versions", "algorithm", "collector", "random", "position", "callbacks"}
"""Of the state of a run: what `capture` takes, and the two that `checkpoint.save` adds."""

_NOT_WEIGHTS = {"optimizer", "buffer", "generator"}


@dataclass(frozen=True)
class Position:
    """How far a run is: iterations done, frames collected, seconds spent, and the sum of the frames' rewards."""

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0
    reward: float = 0.0


def identity(cfg: TrainConfig, folder: Path) -> str:
    """SHA-256 of all options that must not change when the run in `folder` is resumed."""
    # repr writes floats with all digits, so that equal hashes mean equal options.
    return hashlib.sha256(repr(fixed_options(own_paths(cfg, folder))).encode()).hexdigest()


def capture(
    cfg: TrainConfig,
    folder: Path,
    algorithm: Algorithm,
    collector: BaseCollector,
    at: Position,
    callbacks: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Everything that the next iteration depends on, and what has been written so far.

    Args:
        cfg: the run's config.
        folder: of the run.
        algorithm: networks, optimizers, schedules, buffers.
        collector: rows in mid-episode and the environment's generators.
        at: how far the run is.
        callbacks: states of the callbacks by their names, such as how many bytes of `metrics.csv` there are.
    """
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {
        "identity": identity(cfg, folder),
        "versions": {name: version(name) for name in _EXACT},
        "algorithm": algorithm.state_dict(),
        # None for collectors in worker processes, whose environments cannot be asked: they begin new episodes.
        "collector": {"environment": collector.env.snapshot()} if isinstance(collector, Collector) else None,
        "random": {"cpu": torch.get_rng_state(), "cuda": cuda},
        "position": vars(at),
        "callbacks": dict(callbacks),
    }


def restore(state: Mapping[str, Any], algorithm: Algorithm, collector: BaseCollector) -> Position:
    """Put a captured state back, the random generators last; call after everything has been built."""
    algorithm.load_state_dict(state["algorithm"])
    if state["collector"] is not None and isinstance(collector, Collector):
        # Private, but in no state_dict of TorchRL: the observations with which the next batch begins, rows in
        # mid-episode. An episode's end is not among them, for the environment has begun the next one in that row.
        collector._carrier.update(collector.env.restore(state["collector"]["environment"]))
    # Last, since building the learner and the collector (which resets its environments) draws numbers. `.cpu()`: with
    # device=cuda the checkpoint's tensors were loaded to the GPU, generators' states must lie on the CPU.
    torch.set_rng_state(state["random"]["cpu"].cpu())
    if state["random"]["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all([rng.cpu() for rng in state["random"]["cuda"]])
    return Position(**state["position"])


def find(cfg: TrainConfig, folder: Path, device: torch.device) -> tuple[dict[str, Any] | None, list[str]]:
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
            _check(state, cfg, file)
        except UserError as error:
            passed_over.append(str(error))
            continue
        return {**state, "file": str(file)}, passed_over
    raise UserError(f"resume={cfg.resume}: no checkpoint to resume from ({'; '.join(passed_over) or 'there is none'})")


def take_weights(algorithm: Algorithm, run: Path, device: torch.device) -> list[str]:
    """Start from the weights of another run's newest checkpoint, where name and shape fit; returns the names taken.

    Raises:
        UserError: the run has no checkpoint, or nothing of it fits.
    """
    file = checkpoint.newest(run)
    state = checkpoint.load(file, device)
    with decoded(str(file), "the state of a run"):
        given = dict(_weights(state["algorithm"]))
    own = algorithm.state_dict()
    taken = []
    with torch.no_grad(), decoded(str(file), "the weights of a run"):
        for name, tensor in _weights(own):
            if name in given and given[name].shape == tensor.shape:
                # Into the tensors of our own state, which is then loaded as a whole: state_dict may have handed out
                # copies.
                tensor.copy_(given[name])
                taken.append(name)
    if not taken:
        raise UserError(f"init_from={run}: none of its weights has the name and shape of one of ours")
    algorithm.load_state_dict(own)
    return taken


def load_learned(algorithm: Algorithm, cfg: TrainConfig, file: Path, device: torch.device) -> None:
    """Put the learner of a checkpoint of the run `cfg` back, to use what it has learned.

    Raises:
        UserError: the checkpoint is damaged, belongs to a run with another config, or does not fit.
    """
    state = checkpoint.load(file, device)
    _check_identity(state, cfg, file)
    with decoded(str(file), "a state that fits this run"):
        algorithm.load_state_dict(state["algorithm"])


def _check_identity(state: Mapping[str, Any], cfg: TrainConfig, file: Path) -> None:
    if state.get("identity") != identity(cfg, file.parent.parent):  # RUN/checkpoints/iteration-00000012.pt
        raise UserError(f"{file}: belongs to a run with another config")


def _check(state: Mapping[str, Any], cfg: TrainConfig, file: Path) -> None:
    """See that the state is one to resume from, before anything of it is used."""
    _check_identity(state, cfg, file)
    with decoded(str(file), "the state of a run"):
        if state["versions"].keys() != set(_EXACT):
            raise ValueError(f"versions of other packages than {', '.join(_EXACT)}")
        # Another version may draw or round otherwise: the run would go on, but not as the one that was interrupted.
        for name, written in state["versions"].items():
            if written != version(name):
                raise UserError(f"{file}: written with {name} {written}, this is {version(name)}; expected the same")
        at = Position(**state["position"])
        # 2^53: up to there a float holds every integer, as metrics and JSON readers need.
        if any(type(each) is not int or not 0 <= each < 2**53 for each in (at.iteration, at.frames)):
            raise ValueError("a position that is none")
        if not (0 <= at.seconds < math.inf and math.isfinite(at.reward)) or at.iteration != state["iteration"]:
            raise ValueError("a position that is none")
        # No part more either: what nothing here reads was not written here.
        if state.keys() != _PARTS:
            raise ValueError(f"parts {sorted(map(str, state.keys() ^ _PARTS))} missing or too many")


def _weights(state: Mapping[str, Any]) -> list[tuple[str, torch.Tensor]]:
    """The floating-point tensors of an algorithm's state that belong to networks."""
    named = ((name, value) for name, value in flatten(state).items() if not _NOT_WEIGHTS & {*name.split(".")})
    return [(name, value) for name, value in named if isinstance(value, torch.Tensor) and value.is_floating_point()]
