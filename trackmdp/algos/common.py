"""The protocol that the training loop expects of an algorithm, and helpers that several algorithms use."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from inspect import signature
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from trackmdp.arrays.entries import block_rows
from trackmdp.arrays.types import AnyArray, IndexArray
from trackmdp.config import TrainConfig
from trackmdp.config.registry import maker
from trackmdp.config.tree import flatten
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task

NEVER_LOCATED = (
    "algo.total_frames: in none of them was a target located and sensed again; expected more"
)


class Algorithm(Protocol):
    """One learning method. An iteration is one collected batch, if frames are left, and then some learning."""

    policy: TensorDictModuleBase
    """Acts while collecting."""
    iterations: int
    """Iterations of the whole run."""
    device: torch.device
    """Where the networks live."""

    @property
    def actor(self) -> TensorDictModuleBase:
        """The deterministic policy that is evaluated."""
        ...

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """One iteration of learning on `batch` `[B, time]` (None once all frames are in); returns its diagnostics."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to resume exactly."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`; `actor` is the policy of that time, which `evaluate` and `export` take."""
        ...


def make_algorithm(
    cfg: TrainConfig,
    task: Task,
    device: torch.device,
    nets: Mapping[str, Any] | None = None,
    targets: Sequence[int] = (),
) -> Algorithm:
    """The learner that a config names; it is given the task, never the motion.

    Args:
        cfg: the config.
        task: the task.
        device: where the networks live.
        nets: `actor` and `critic` of the user's own.
        targets: kind of each target, where it learns of several together.

    Raises:
        UserError: the learner takes no such networks.
    """
    made = maker(cfg.algo)
    if unknown := (nets or {}).keys() - signature(made).parameters.keys():
        raise UserError(f"{min(unknown)}: algo={cfg.algo.name} makes its own, expected a2c or ppo")
    # Rounded up: 100,001 frames in batches of 10,000 are 11 iterations, the last one whole as well.
    batches = -(-cfg.collector.total_frames // cfg.collector.frames_per_batch)
    given = {"iterations": batches, "seed": cfg.seed, "device": device} | dict(nets or {})
    if targets:
        given["targets"] = targets
    return made(task.task, cfg.algo, **given)


class Checkpointed:
    """An object saved in a checkpoint by the names of its parts.

    Modules, optimizers and the like by their `state_dict`, generators by their state, arrays as tensors, plain values
    as they are.
    """

    parts: ClassVar[tuple[str, ...]]

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to resume exactly."""
        return {name.strip("_"): _state(getattr(self, name)) for name in self.parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`.

        Raises:
            ValueError: a floating-point tensor is of another type there; torch would convert it without a word.
        """
        saved_parts = flatten(state)
        for name, part in flatten(self.state_dict()).items():
            saved = saved_parts.get(name)
            if isinstance(part, Tensor) and isinstance(saved, Tensor) and part.is_floating_point():
                check_type(name, saved, part.dtype)
        for name in self.parts:
            part, saved = getattr(self, name), state[name.strip("_")]
            if isinstance(part, torch.Generator):
                # That of another kind of device has another length. A run resumes on the same kind; to look at what
                # was learned no draws need to go on.
                if len(saved) == len(part.get_state()):
                    part.set_state(saved.cpu())
            elif isinstance(part, np.random.Generator):
                part.bit_generator.state = json.loads(saved)
            elif hasattr(part, "load_state_dict"):
                part.load_state_dict(saved)
            else:
                setattr(self, name, _as(part, saved))


def check_type(name: str, saved: Tensor, *expected: torch.dtype) -> None:
    """Raise a ValueError unless the tensor `name` of a checkpoint is of one of the types `expected`."""
    if saved.dtype not in expected:
        raise ValueError(f"{name}: {saved.dtype}, expected {expected[0]}")


def _as(part: Any, saved: Any) -> Any:
    """A saved value as the kind that the part is of, on its device."""
    if isinstance(part, Tensor):
        return saved.to(part)
    return saved.cpu().numpy() if isinstance(part, np.ndarray) else saved


def _state(part: Any) -> Any:
    if isinstance(part, torch.Generator):
        return part.get_state()
    if isinstance(part, np.random.Generator):
        return json.dumps(part.bit_generator.state)  # 128 bits, too many for an integer
    if isinstance(part, np.ndarray):
        return torch.as_tensor(part)
    return part.state_dict() if hasattr(part, "state_dict") else part


def located(task: Task) -> Task:
    """The task of policies that remember the last detection alone, with the mode where it is revealed."""
    return task.remembering(revealed=task.revealed) if task.order else task


def known_alone(batch: TensorDictBase, task: Task) -> TensorDictBase:
    """A collected batch with the keys of `located(task)`: the mode alone, where the memory holds more."""
    if task.order:
        for part in (batch, batch["next"]):
            mode = part["key"] % task.revealed
            part["key"] = task.keys.cell(part["key"]) * task.revealed + mode
    return batch


def lifted(task: Task, table: PolicyTable) -> PolicyTable:
    """The policy of `task` that acts as `table`, made for it or for `located(task)`."""
    if table.task.order == task.order:
        return table
    keys = np.arange(task.num_keys)
    known = task.keys.cell(keys) * task.revealed + keys % task.revealed
    return PolicyTable(task, table.written[block_rows(known, task.num_choices)])


def choosable_places(task: Task, located: IndexArray, sensors: IndexArray) -> IndexArray:
    """`[C]`, places of those among `sensors` `[E]` that exist and can be chosen after a detection in `located` `[E]`.

    Numbers from S on stand for no sensor.
    """
    there = np.flatnonzero(sensors < task.total_sensors)
    possible = task.choosable(located[there], sensors[there])
    return there if possible is None else there[np.asarray(possible).ravel()]


def tensors(arrays: Mapping[str, Any]) -> dict[str, Tensor]:
    """NumPy arrays as a checkpoint holds them."""
    return {name: torch.as_tensor(part) for name, part in arrays.items()}


def arrays(tensors: Mapping[str, Tensor]) -> dict[str, AnyArray]:
    """The arrays of `tensors`, wherever a checkpoint was loaded to."""
    return {name: part.cpu().numpy() for name, part in tensors.items()}


class Averages:
    """Means of diagnostics over the updates of one iteration, without a device sync per update."""

    def __init__(self) -> None:
        self._values: dict[str, list[Tensor]] = {}

    def add(self, **values: Tensor) -> None:
        """Add one update's scalars."""
        for name, value in values.items():
            self._values.setdefault(name, []).append(value.detach())

    def means(self) -> dict[str, float]:
        """The mean of each diagnostic.

        Raises:
            FloatingPointError: a mean is not finite, training has diverged.
        """
        # One `item` per diagnostic and iteration: each waits for the device.
        means = {name: torch.stack(values).mean().item() for name, values in self._values.items()}
        for name, value in means.items():
            if not math.isfinite(value):
                raise FloatingPointError(f"{name} is {value}")
        return means


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Use `rate` from the next update on."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def clipped_step(
    loss: Tensor,
    optimizer: torch.optim.Optimizer,
    parameters: Sequence[nn.Parameter],
    max_norm: float,
) -> Tensor:
    """One gradient step with the gradient's norm clipped; returns the norm before clipping.

    Raises:
        FloatingPointError: the loss is not finite; the parameters are left as they were.
    """
    # Before `backward`: a nan in Adam's moments would stay there for good.
    if not torch.isfinite(loss):
        raise FloatingPointError(f"the loss is {loss.item()}")
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = nn.utils.get_total_norm([each.grad for each in parameters if each.grad is not None])
    if norm > max_norm:  # else `clip_grad_norm_` would multiply every gradient by one
        nn.utils.clip_grads_with_norm_(parameters, max_norm, norm)
    # The moments of what no batch touches sink below 1e-38, where processors take five times as long; beside Adam's
    # epsilon, 1e-8, they are nothing.
    torch.set_flush_denormal(True)
    try:
        optimizer.step()
    finally:  # it is the whole thread's, also where Ctrl-C ends the step
        torch.set_flush_denormal(False)
    return norm


def explained_variance(predicted: Tensor, target: Tensor) -> Tensor:
    """1 - Var[target - predicted] / Var[target]; 0 where the target does not vary."""
    if target.numel() < 2:
        return torch.zeros(())
    variance = target.var()
    return torch.where(
        variance > 0, 1 - (target - predicted).var() / variance, torch.zeros_like(variance)
    )
