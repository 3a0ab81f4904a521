"""From any deterministic rule to a table, by calling it on every state that it can reach.

After a miss the next state is known in advance: the same located cell, n + 1, and the history with the set just chosen.
So M * (t_max + 1) states, visited in order of n, determine a policy that does not draw. Where it reads `key` as well,
what is remembered at a detection, it has as many plans as there are keys.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, distributions
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from trackmdp.errors import UserError
from trackmdp.seeding import preserved_global_rng
from trackmdp.world.model import Task
from trackmdp.world.windows import Window

STATE_KEYS = ("last_cell", "steps_since_detection", "action_history")

Rule: TypeAlias = Callable[..., Tensor]
"""`last_cell` `[B]`, `steps_since_detection` `[B]`, `action_history` `[B, t_max+1, K]`, and `key` `[B]` where the task
has keys -> bool `[B, K]`.

K = M, or with a window the sensors around `last_cell`, in the local numbers of `Window`."""

TAKE_ITS_MODE = "simulate it, or take its mode by Policy.from_module"


class DrawsError(UserError):
    """An exact value was asked of something that has none: it draws at random, or keeps a state of its own."""


def acting() -> set_exploration_type:
    """What the caller chose by `set_exploration_type`; where nothing is chosen a policy acts as it explores, RANDOM.

    A TorchRL actor would otherwise be valued at its mode without a word, although it draws while collecting.
    """
    return set_exploration_type(exploration_type() or ExplorationType.RANDOM)


_HISTORY_AT_ONCE = 2**22  # entries of the action history in one block; a net's activations follow from it


def state_keys(task: Task) -> list[str]:
    """What is observed of a state: `key` as well, where a policy knows more at a detection than the cell."""
    return [*STATE_KEYS, "key"] if task.keyed else list(STATE_KEYS)


def known_task(task: Task, policy: object) -> Task:
    """The task as `policy` knows it: a module that does not read `key`, and any function, knows the cell alone."""
    return task if "key" in getattr(policy, "in_keys", ()) else task.remembering()


def function_rule(task: Task, function: Callable[..., Any]) -> Rule:
    """A user's function as a rule, what it returns checked.

    Raises:
        UserError: when asked, it returns something else than bool `[B, K]`.
    """

    def rule(last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor) -> Tensor:
        action = torch.as_tensor(function(last_cell, steps_since_detection, action_history))
        return _checked(action, (len(last_cell), task.num_sensors), "the function returned")

    return rule


def module_rule(task: Task, module: TensorDictModuleBase) -> Rule:
    """A TensorDict module as a rule; it reads the keys of a state and writes `action`.

    Raises:
        UserError: it reads or writes other keys, or its action has another form.
    """
    # A table has a row for each state of these keys; one that reads more, its own past say, is no function of them.
    known = state_keys(task)
    others = [str(key) for key in module.in_keys if key not in known]
    if (kept := kept_keys(module)) and set(others) <= {*kept, "is_init"}:
        raise DrawsError(f"policy: keeps {', '.join(kept)} from step to step, so it has no exact value; simulate it")
    if others:
        raise UserError(f"policy: the module reads {', '.join(others)}, expected {', '.join(known)} at most")
    if "action" not in module.out_keys:
        raise UserError("policy: the module writes no action")

    def rule(*state: Tensor) -> Tensor:
        batch = TensorDict(dict(zip(known, state, strict=True)), state[0].shape, device=state[0].device)
        return module_action(task, module, batch)

    return rule


def module_action(task: Task, module: TensorDictModuleBase, batch: TensorDict) -> Tensor:
    """The action of a module in `batch` `[B]`, to which it writes; bool `[B, K]`.

    Raises:
        UserError: the action has another form.
    """
    return _checked(module(batch)["action"], (len(batch), task.num_sensors), "the module's action is")


def kept_keys(module: TensorDictModuleBase) -> list[str]:
    """What a recurrent module reads that it wrote at the step before, under `next`, as TorchRL's GRU and LSTM do."""
    return [str(key) for key in module.in_keys if ("next", key) in module.out_keys]


def _checked(action: Tensor, shape: tuple[int, int], what: str) -> Tensor:
    if action.dtype != torch.bool or tuple(action.shape) != shape:
        form = f"{str(action.dtype).removeprefix('torch.')} {list(action.shape)}"
        raise UserError(f"policy: {what} {form}, expected bool {list(shape)}")
    return action


def unrolled(task: Task, rule: Rule, device: torch.device) -> sparse.csr_array:
    """`[keys * (t_max + 1), S]` bool, the sets of a rule; row key * (t_max + 1) + n as in `Policy.sets`.

    Torch's global generators are left as they were.
    """
    with preserved_global_rng():
        return _table(task, rule, device)


def draws(task: Task, rule: Rule, device: torch.device, sets: sparse.csr_array) -> bool:
    """Whether a rule that was unrolled to `sets` draws: asked again it answers otherwise, or uses torch's generators.

    The first test finds any source of randomness that changes some answer; the second also finds one that seldom does,
    if it is one of torch's global generators, which TorchRL's modules draw from.
    """
    with preserved_global_rng():
        torch.manual_seed(torch.initial_seed() + 1)  # another place in the random stream than the first time
        before = _generator_states()
        again = _table(task, rule, device)
        moved = any(not torch.equal(*pair) for pair in zip(before, _generator_states(), strict=True))
    same = np.array_equal(again.indptr, sets.indptr) and np.array_equal(again.indices, sets.indices)
    return moved or not same


def mixture(task: Task, module: TensorDictModuleBase, device: torch.device) -> sparse.csr_array | None:
    """`[keys * (t_max + 1), S]` float64, with what probability a stochastic actor switches each sensor on.

    Exact values need no more than these where they do not depend on the history: the next state then depends on the
    sensor at the target's cell alone, and the price is a sum over the sensors.

    Args:
        task: what it acts in.
        module: a module of TorchRL; its distribution must be a Bernoulli per sensor.
        device: where to ask it.

    Returns:
        None where the module has no such distribution, or is asked for its mode.

    Raises:
        DrawsError: the probabilities depend on the history, that is on what was drawn before.
        UserError: it reads or writes other keys.
    """
    stochastic = isinstance(module, ProbabilisticTensorDictSequential)
    if not stochastic or exploration_type() != ExplorationType.RANDOM:
        return None
    module_rule(task, module)  # refuses keys that are not its business
    names = state_keys(task)

    def probabilities(filled: bool) -> Rule:
        def rule(*state: Tensor) -> Tensor:
            known = torch.full_like(state[2], filled) & _taken(state[1], state[2])
            batch = TensorDict(dict(zip(names, (*state[:2], known, *state[3:]), strict=True)), state[0].shape)
            chances = _bernoulli(module.get_dist(batch.to(device)))
            if chances is None or chances.shape != (len(state[0]), task.num_sensors):
                raise _NoProbabilitiesError
            return chances

        return rule

    try:
        with preserved_global_rng():
            # Two histories as far apart as can be: a network that reads them at all answers otherwise.
            none, full = (_table(task, probabilities(filled), device, torch.float64) for filled in (False, True))
    except _NoProbabilitiesError:
        return None
    if (none != full).nnz:
        raise DrawsError(
            f"policy: its probabilities depend on the sets that it drew before, so no exact value; {TAKE_ITS_MODE}"
        )
    return none


class _NoProbabilitiesError(Exception):
    """A distribution that is not a Bernoulli per sensor."""


def _taken(misses: Tensor, history: Tensor) -> Tensor:
    """`[B, t_max+1, 1]` bool, the slots of a history that hold an action after `misses` `[B]`."""
    return (torch.arange(history.shape[1], device=misses.device) < misses.unsqueeze(1)).unsqueeze(-1)


def _bernoulli(found: distributions.Distribution) -> Tensor | None:
    """`[B, K]` probabilities of a Bernoulli, however often it is wrapped in `Independent`."""
    while isinstance(found, distributions.Independent):
        found = found.base_dist
    return found.probs.double() if isinstance(found, distributions.Bernoulli) else None


@torch.no_grad()
def _table(task: Task, rule: Rule, device: torch.device, dtype: torch.dtype = torch.bool) -> sparse.csr_array:
    """A rule's answers of any dtype as rows of a table; where they are bool, each is remembered as the set chosen."""
    k, choices = task.num_sensors, task.num_choices
    # One key takes a history of (t_max + 1) K bools; blocks keep all of them from being there at once.
    at_once = max(1, _HISTORY_AT_ONCE // (choices * k))
    window = Window.of(task, device)
    columns, values, lengths = [], [], []
    for begin in range(0, task.num_keys, at_once):
        keys = torch.arange(begin, min(begin + at_once, task.num_keys), device=device)
        cells = task.keys.cell(keys)
        # [B, t_max+1, K] in row-major order is B * (t_max+1) rows of the table, in the table's order.
        on = _followed(rule, task, keys, dtype).reshape(-1, k)
        if window.is_local:
            on *= window.inside(cells).repeat_interleave(choices, dim=0).cpu().numpy()
        # Row-major order: flat place p of [rows, K] is column p mod K. Without a window K = S and columns are sensors.
        place = np.flatnonzero(on)
        chosen = place % k
        if window.is_local:
            # A window's local numbers go through it row by row, as the cells do: columns stay in order.
            chosen = window.around(cells).cpu().numpy()[place // (k * choices), chosen]
        columns.append(chosen)
        values.append(on.reshape(-1)[place])
        # Sensors on per row, whose running sum is the CSR row pointer.
        lengths.append(np.count_nonzero(on, axis=1))
    indptr = np.concatenate([[0], np.cumsum(np.concatenate(lengths))])
    found = np.concatenate(values), np.concatenate(columns), indptr
    return sparse.csr_array(found, shape=(task.num_keys * choices, task.total_sensors))


def _followed(rule: Rule, task: Task, keys: Tensor, dtype: torch.dtype) -> npt.NDArray[Any]:
    """`[B, t_max+1, K]` the answers at n = 0, 1, ... misses after detections that left `keys` `[B]`."""
    cells, choices, known = task.keys.cell(keys), task.num_choices, (keys,) if task.keyed else ()
    # Slot n is written after the call for n: at n misses the rule sees slots 0 ... n - 1, as in the environment.
    history = torch.zeros(len(cells), choices, task.num_sensors, dtype=dtype, device=cells.device)
    for n in range(choices):
        # Copies, for a rule may keep what it is given, or write to it.
        state = cells.clone(), torch.full_like(cells, n), history.to(torch.bool, copy=True)
        history[:, n] = rule(*state, *(key.clone() for key in known))
    return history.cpu().numpy()


def _generator_states() -> list[Tensor]:
    """Of torch's global generators, the CPU's and those of all GPUs in use."""
    gpus = torch.cuda.get_rng_state_all() if torch.cuda.is_available() and torch.cuda.is_initialized() else []
    return [torch.get_rng_state(), *gpus]
