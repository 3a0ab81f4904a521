"""Forms of policies: functions, TensorDict modules and their transforms, and objects that hold a policy.

A rule is the common form: it maps states to sets of sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import signature
from typing import Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import transforms
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from trackmdp.environment.observation import ObservationVector
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.actions import ActionMask, checked_action
from trackmdp.sensing.task import Task

STATE_KEYS = ("last_cell", "steps_since_detection", "action_history")
_VECTOR = "observation"

Rule: TypeAlias = Callable[..., Tensor]
"""`last_cell` `[B]`, `steps_since_detection` `[B]`, `action_history` `[B, t_max+1, K]`, and `key` `[B]` where the task
has keys -> bool `[B, K]`.

K = S, or with a window the sensors around `last_cell`, in the local numbers of `Window`."""

TAKE_ITS_MODE = "simulate it, or take its mode by Policy.from_module"

_STATELESS = (
    ObservationVector,
    transforms.CatTensors,
    transforms.DTypeCastTransform,
    transforms.ExcludeTransform,
    transforms.FlattenObservation,
    transforms.ObservationNorm,
    transforms.RenameTransform,
    transforms.SelectTransform,
    transforms.SqueezeTransform,
    transforms.UnsqueezeTransform,
)
_NORMS = (transforms.VecNorm, transforms.VecNormV2)
"""Transforms with statistics that change at each call; an `ObservationNorm` takes their place."""


class DrawsError(UserError):
    """An exact value was asked for of a policy without one: it draws at random, or keeps a state of its own."""


def acting() -> set_exploration_type:
    """The exploration type chosen by `set_exploration_type`, or RANDOM, as which a policy acts while it collects.

    By default TorchRL would take an actor's mode, without a word, although it draws while collecting.
    """
    return set_exploration_type(exploration_type() or ExplorationType.RANDOM)


def state_keys(task: Task, targets: Sequence[int] = ()) -> list[str]:
    """Observed keys of a state; with `key` where a policy remembers more than the cell.

    With `present` where there are several targets, of the kinds `targets`.
    """
    more = ["key"] if task.keyed else ["present"] if targets else []
    return [*STATE_KEYS, *more]


def known_task(task: Task, policy: object) -> Task:
    """The task as `policy` sees it: a module that does not read `key`, and any function, sees the cell alone.

    Raises:
        UserError: it is no task.
    """
    if not hasattr(task, "remembering"):
        kind = type(task).__name__
        raise UserError(
            f"policy: the first argument is a {kind}, expected a world or recorded tracks"
        )
    return task if "key" in getattr(policy, "in_keys", ()) else task.remembering()


def adapted(task: Task | None, policy: Any) -> Any:
    """The policy that an object holds: a `Run`, a `Solution`, a dense table of `task`, a model of Stable-Baselines3.

    All other objects are returned as they are.

    Raises:
        UserError: it is a class.
    """
    if isinstance(policy, type):
        raise UserError(f"policy: the class {policy.__name__}, expected an object of it")
    if isinstance(policy, PolicyTable | TensorDictModuleBase):
        return policy
    if task is not None and isinstance(policy, Tensor | np.ndarray):
        return PolicyTable.from_dense(task, np.asarray(policy))
    if isinstance(held := getattr(policy, "policy", None), PolicyTable):
        return held
    if hasattr(policy, "predict") and hasattr(policy, "observation_space"):
        return _predicted(task, policy)
    return policy


def _predicted(task: Task | None, model: Any) -> Callable[..., Any]:
    """The mode of a model of Stable-Baselines3 as a function.

    Raises:
        UserError: it reads more than a function is given, and the mask; or an array in place of a dict.
    """
    known = (*STATE_KEYS, "action_mask")
    reads = getattr(model.observation_space, "spaces", None)
    if reads is None:
        found = type(model.observation_space).__name__
        raise UserError(f"policy: the model reads a {found}, expected a Dict of {', '.join(known)}")
    check_reads(reads, known)
    mask = None if task is None else ActionMask(task)

    def function(*state: Tensor) -> Any:
        seen = dict(zip(STATE_KEYS, state, strict=True))
        if mask is not None and mask.observed:
            seen["action_mask"] = mask(state[0])
        return mode_of(model, {name: part for name, part in seen.items() if name in reads})

    return function


def check_reads(keys: Iterable[Any], known: Sequence[str]) -> None:
    """Raise a `UserError` if a model reads keys that are not shown."""
    if others := sorted({*map(str, keys)} - {*known}):
        raise UserError(
            f"policy: the model reads {', '.join(others)}, expected {', '.join(known)} at most"
        )


def mode_of(model: Any, state: Mapping[str, Tensor]) -> Any:
    """The most likely actions of a model of Stable-Baselines3 in states `[B]`.

    Raises:
        UserError: it reads states of another shape.
    """
    spaces = getattr(model.observation_space, "spaces", {})
    for name, part in state.items():
        own = tuple(spaces[name].shape) if name in spaces else tuple(part.shape[1:])
        if own[len(own) - part.ndim + 1 :] != part.shape[1:]:
            found = f"the model reads {name} of {list(own)}, got {list(part.shape[1:])}"
            raise UserError(f"policy: {found}, of other targets or another grid")
    seen = {name: part.numpy() for name, part in state.items()}
    return model.predict(seen, deterministic=True)[0]


def rule_of(task: Task, policy: TensorDictModuleBase | Callable[..., Any]) -> Rule:
    """A TensorDict module or a function as a rule.

    Raises:
        UserError: it is neither, or the module reads or writes other keys; the rule, when its action has another form.
    """
    if isinstance(policy, TensorDictModuleBase):
        return module_rule(task, policy)
    if callable(policy):
        return function_rule(task, policy)
    raise UserError(
        f"policy: a {type(policy).__name__}, expected a Policy, a Run, a Solution, a TensorDict module, a function, a "
        "table, a model of Stable-Baselines3, or the name of a baseline"
    )


def function_rule(task: Task, function: Callable[..., Any]) -> Rule:
    """A user's function of the state as a rule; see `rule_of`."""
    try:
        # A module of torch takes what its `forward` takes.
        signature(getattr(function, "forward", function)).bind(*STATE_KEYS)
    except TypeError:
        name = getattr(function, "__name__", type(function).__name__)
        raise UserError(f"policy: {name}: expected a function of {', '.join(STATE_KEYS)}") from None
    except ValueError:  # a builtin without a signature
        pass

    def rule(*state: Tensor) -> Tensor:
        found = function(*state)
        shape = len(state[0]), task.num_sensors
        try:
            action = torch.as_tensor(found)
        except (RuntimeError, TypeError, ValueError):
            kind = type(found).__name__
            expected = f"0 or 1 for each sensor, {list(shape)}"
            raise UserError(f"policy: its action: expected {expected}, got {kind}") from None
        return checked_action(action, shape, "policy: its action", task.budget)

    return rule


def module_rule(task: Task, module: TensorDictModuleBase) -> Rule:
    """A TensorDict module as a rule; see `rule_of`. It reads the keys of a state, or their `ObservationVector`."""
    # A table has a row for each state of these keys; a module that reads more, its own past for instance, is no
    # function of them.
    known = state_keys(task)
    others = [str(key) for key in module.in_keys if key not in (*known, _VECTOR)]
    if (kept := kept_keys(module)) and set(others) <= {*kept, "is_init"}:
        raise DrawsError(
            f"policy: keeps {', '.join(kept)} from step to step, so it has no exact value; simulate it"
        )
    if others:
        raise UserError(
            f"policy: the module reads {', '.join(others)}, expected {', '.join(known)} or {_VECTOR} at most"
        )
    if "action" not in module.out_keys:
        raise UserError("policy: the module writes no action")

    def rule(*state: Tensor) -> Tensor:
        rows = dict(zip(known, state, strict=True))
        return module_action(task, module, TensorDict(rows, state[0].shape, device=state[0].device))

    return rule


def module_action(task: Task, module: TensorDictModuleBase, batch: TensorDictBase) -> Tensor:
    """The action of a module in the states `batch` `[B]`, which it writes to; bool `[B, K]`.

    Raises:
        UserError: the action has another form.
    """
    action = module(observed(task, module, batch))["action"]
    shape = len(batch), task.num_sensors
    return checked_action(action, shape, "policy: its action", task.budget)


def observed(task: Task, module: TensorDictModuleBase, batch: TensorDictBase) -> TensorDictBase:
    """The states `batch` `[B]` with their `ObservationVector` where the module reads it."""
    for part in module.modules():
        if isinstance(part, ObservationVector):
            part.fit(task)
    return ObservationVector(task)(batch) if _VECTOR in module.in_keys else batch


def kept_keys(module: TensorDictModuleBase) -> list[str]:
    """Keys that a recurrent module writes under `next` for its next step, like TorchRL's GRU and LSTM."""
    return [str(key) for key in module.in_keys if ("next", key) in module.out_keys]


def transformed(
    module: TensorDictModuleBase, transform: transforms.Transform
) -> TensorDictModuleBase:
    """A module behind the transforms of a `TransformedEnv`, as functions of a state; norms are frozen.

    Transforms of keys that the module does not read, such as `RewardSum`, are left out.

    Raises:
        DrawsError: the module reads a key of a transform that keeps a state from step to step, such as `CatFrames`.
    """
    parts = list(transform) if isinstance(transform, transforms.Compose) else [transform]
    kept: list[Any] = []
    needed = set(module.in_keys)
    for part in reversed(parts):
        if isinstance(part, _STATELESS + _NORMS):
            needed |= set(part.in_keys)
            kept.insert(0, part.to_observation_norm() if isinstance(part, _NORMS) else part.clone())
        elif read := needed & set(part.out_keys):
            raise DrawsError(
                f"policy: reads {', '.join(map(str, read))} of {type(part).__name__}, which is no function of a "
                "state, so it has no exact value"
            )
    return TensorDictSequential(*kept, module)
