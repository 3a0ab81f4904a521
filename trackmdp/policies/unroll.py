"""Tables of rules: a rule that does not draw is asked for its action in every state that it can reach.

After a miss the next state is known in advance: the same located cell, n + 1, and the history with the last set. So
M * (t_max + 1) states, visited in order of n, determine a policy that does not draw; where it reads `key` as well, keys
take the place of the M cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, distributions
from torchrl.envs.utils import ExplorationType, exploration_type

from trackmdp.arrays.entries import row_index
from trackmdp.arrays.types import AnyArray
from trackmdp.policies.forms import (
    TAKE_ITS_MODE,
    DrawsError,
    Rule,
    module_rule,
    observed,
    state_keys,
)
from trackmdp.seeding import preserved_global_rng
from trackmdp.sensing.actions import ActionMask
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

_HISTORY_AT_ONCE = 2**22
"""Entries of the action history in one block; the size of a net's activations follows from it."""


def unrolled(
    task: Task, rule: Rule, device: torch.device | str, *, check: bool
) -> sparse.csr_array:
    """`[keys * (t_max + 1), S]` bool, the sets of a rule; row key * (t_max + 1) + n as in `Policy.sets`.

    Torch's global generators are left as they were. With `check` the rule is asked again. To compare its answers finds
    any source of randomness that changes some; torch's global generators, which TorchRL's modules draw from, also show
    one that seldom does.

    Raises:
        DrawsError: with `check`, it draws.
    """
    place = torch.device(device)
    with preserved_global_rng():
        sets = _table(task, rule, place)
        if not check:
            return sets
        # Another place in the random stream than the first time.
        torch.manual_seed(torch.initial_seed() + 1)
        before = _generator_states()
        again = _table(task, rule, place)
        kept = all(map(torch.equal, before, _generator_states()))
    same = np.array_equal(again.indptr, sets.indptr) and np.array_equal(again.indices, sets.indices)
    if not (kept and same):
        raise DrawsError(f"policy: draws at random, so that it has no exact value; {TAKE_ITS_MODE}")
    return sets


def mixture(task: Task, module: Any, device: torch.device) -> sparse.csr_array | None:
    """`[keys * (t_max + 1), S]` float64, the probability with which a stochastic actor switches each sensor on.

    Exact values need no more than these where they do not depend on the history: the next state then depends on the
    sensors that cover the target's cell alone, and the price is a sum over the sensors.

    Args:
        task: the task it acts in.
        module: a module or a function; its distribution must be a Bernoulli per sensor.
        device: device of the module.

    Returns:
        None where the module has no such distribution, or is asked for its mode.

    Raises:
        DrawsError: the probabilities depend on the history, that is on earlier draws.
        UserError: it reads or writes other keys.
    """
    stochastic = isinstance(module, ProbabilisticTensorDictSequential)
    if not stochastic or exploration_type() != ExplorationType.RANDOM:
        return None
    module_rule(task, module)  # refuses other keys
    names = state_keys(task)

    def probabilities(filled: bool) -> Rule:
        def rule(*state: Tensor) -> Tensor:
            # Slots n and later are empty in any history.
            slots = torch.arange(task.num_choices, device=state[1].device)
            taken = (slots < state[1].unsqueeze(1)).unsqueeze(-1) & filled
            known = taken.expand_as(state[2])
            rows = dict(zip(names, (*state[:2], known, *state[3:]), strict=True))
            batch = TensorDict(rows, state[0].shape).to(device)
            found = module.get_dist(observed(task, module, batch))
            while isinstance(found, distributions.Independent):
                found = found.base_dist
            shape = len(state[0]), task.num_sensors
            if not isinstance(found, distributions.Bernoulli) or found.probs.shape != shape:
                raise _NoProbabilitiesError
            return found.probs.double()

        return rule

    try:
        with preserved_global_rng():
            # Two histories as far apart as can be: a network that reads them at all answers otherwise.
            none, full = (
                _table(task, probabilities(filled), device, torch.float64)
                for filled in (False, True)
            )
    except _NoProbabilitiesError:
        return None
    if (none != full).nnz:
        raise DrawsError(
            f"policy: its probabilities depend on earlier draws, so it has no exact value; {TAKE_ITS_MODE}"
        )
    return none


class _NoProbabilitiesError(Exception):
    """A distribution that is not a Bernoulli per sensor."""


@torch.no_grad()
def _table(
    task: Task, rule: Rule, device: torch.device, dtype: torch.dtype = torch.bool
) -> sparse.csr_array:
    """Answers of a rule, of any dtype, as rows of a table; bool answers are remembered as the set chosen."""
    k, choices = task.num_sensors, task.num_choices
    # One key takes a history of (t_max + 1) K bools; blocks keep all of them from being there at once.
    at_once = max(1, _HISTORY_AT_ONCE // (choices * k))
    window, mask = Window.of(task, device), ActionMask(task, device)
    blocks = []
    for begin in range(0, task.num_keys, at_once):
        keys = torch.arange(begin, min(begin + at_once, task.num_keys), device=device)
        cells = task.keys.cell(keys)
        # [B, t_max+1, K] in row-major order is B * (t_max+1) rows of the table, in the table's order.
        on = _followed(rule, task, keys, dtype).reshape(-1, k)
        if window.is_local:
            on *= window.inside(cells).repeat_interleave(choices, dim=0).cpu().numpy()
        if mask.observed:
            on *= mask(cells).repeat_interleave(choices, dim=0).cpu().numpy()
        block = sparse.csr_array(on)  # without a window K = S, and columns are sensors
        if window.is_local:
            # A window's local numbers go through it row by row, as the cells do: columns stay in order.
            sensors = window.around(cells).cpu().numpy()[row_index(block) // choices, block.indices]
            parts, shape = (block.data, sensors, block.indptr), (len(on), task.total_sensors)
            block = sparse.csr_array(parts, shape=shape)
        blocks.append(block)
    return sparse.vstack(blocks, format="csr")


def _followed(rule: Rule, task: Task, keys: Tensor, dtype: torch.dtype) -> AnyArray:
    """`[B, t_max+1, K]` the answers at n = 0, 1, ... misses after detections that left `keys` `[B]`."""
    cells, choices, known = task.keys.cell(keys), task.num_choices, (keys,) if task.keyed else ()
    # Slot n is written after the call for n: at n misses the rule sees slots 0 ... n - 1, as in the environment.
    history = torch.zeros(len(cells), choices, task.num_sensors, dtype=dtype, device=cells.device)
    for n in range(choices):
        # Copies, for a rule may keep its arguments, or write to them.
        state = cells.clone(), torch.full_like(cells, n), history.to(torch.bool, copy=True)
        history[:, n] = rule(*state, *(key.clone() for key in known))
    return history.cpu().numpy()


def _generator_states() -> list[Tensor]:
    """States of torch's global generators, on the CPU and on all GPUs in use."""
    gpus = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
    return [torch.get_rng_state(), *gpus]
