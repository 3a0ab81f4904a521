"""The one policy: which sensors are on n misses after the target was located in x, as a table or as one number.

After a miss the next state is known in advance (theory: `solvers/chains.py`), so a deterministic policy of a Track-MDP
is one open-loop plan per located cell: the sets sensed at n = 0 ... t_max misses, followed until the next detection.
All plans together are a sparse matrix with a row per pair (x, n) and a column per sensor.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from trackmdp.errors import UserError
from trackmdp.policies.lookup import DenseTable, SparseTable
from trackmdp.policies.unroll import STATE_KEYS, Rule, draws, function_rule, module_rule, unrolled
from trackmdp.world.model import Array, BoolArray, Task

__all__ = ["Policy", "PolicyLike", "as_policy"]

PolicyLike: TypeAlias = "Policy | TensorDictModuleBase | Callable[..., Any]"
"""A policy, a TensorDict module, or a function as `Policy.from_function` takes it."""

_DENSE = 2**24  # entries; a table of no more is looked up dense, the faster of the two ways to act


class Policy(TensorDictModuleBase):
    """A policy of a Track-MDP, and a TensorDict module that acts it out.

    Either `sets` or `probability` is given. What a policy learned, solved, recorded or written by hand has in common is
    this table; an actor net or a function becomes one with `from_module` or `from_function`.

    Args:
        task: grid, costs and limits.
        sets: `[M * (t_max + 1), M]` sparse; row `x * (t_max + 1) + n` is the set at n misses after locating the target
            in x. Bool entries are sensors on; entries in (0, 1] are the probabilities of switching them on,
            independently of each other and of the history.
        probability: the same for every sensor in every state, instead of `sets`.
        k: with `probability` k / M: exactly k sensors are on, each such subset equally likely.

    Attributes:
        deterministic: whether the policy is the same function of the state each time.
        generator: what `forward` draws from where the policy is not deterministic; None for torch's global one.

    Raises:
        UserError: the shape is not that of the task's states, or an entry is no probability.
    """

    in_keys: ClassVar = list(STATE_KEYS)
    out_keys: ClassVar = ["action"]

    def __init__(
        self,
        task: Task,
        sets: sparse.csr_array | None = None,
        *,
        probability: float | None = None,
        k: int | None = None,
    ) -> None:
        super().__init__()
        if (sets is None) == (probability is None):
            raise UserError("policy: expected either sets or one probability for all sensors")
        if probability is not None and not 0.0 <= probability <= 1.0:
            raise UserError(f"policy: expected a probability between 0 and 1, got {probability}")
        self.task, self.probability, self.k = task.task, probability, k
        self.sets = None if sets is None else _checked(task, sets)
        self.deterministic = probability in (0.0, 1.0) if self.sets is None else self.sets.dtype == np.bool_
        self.generator: torch.Generator | None = None
        self._lookup: DenseTable | SparseTable | None = None

    @classmethod
    def all_on(cls, task: Task) -> Policy:
        """Every sensor on at every step."""
        return cls(task, probability=1.0)

    @classmethod
    def none(cls, task: Task) -> Policy:
        """No sensor ever on: the target is located by the safe action alone."""
        return cls(task, probability=0.0)

    @classmethod
    def random_k(cls, task: Task, k: int) -> Policy:
        """Of the M sensors k, drawn anew at every step, each subset of that size equally likely."""
        return cls(task, probability=k / task.num_cells, k=k)

    @classmethod
    def from_dense(cls, task: Task, table: npt.NDArray[np.generic]) -> Policy:
        """A policy from `[M, t_max + 1, M]`, bool or probabilities."""
        expected = (task.num_cells, task.num_choices, task.num_cells)
        if table.shape != expected:
            raise UserError(f"policy: expected shape {expected} (M, t_max + 1, M), got {table.shape}")
        return cls(task, sparse.csr_array(np.ascontiguousarray(table).reshape(-1, task.num_cells)))

    @classmethod
    def from_function(
        cls, task: Task, function: Callable[..., Any], *, device: torch.device | str = "cpu", check: bool = True
    ) -> Policy:
        """The table of `function(last_cell [B], steps_since_detection [B], action_history [B, t_max+1, M])`.

        It returns bool `[B, M]`, a tensor or an array, and is called for all M * (t_max + 1) states, a few blocks of
        located cells at a time, so that its memory stays bounded.

        Args:
            task: grid, costs and limits.
            function: must not draw.
            device: where its arguments live.
            check: ask everything twice, to find out whether it draws.

        Raises:
            UserError: it draws, or it returns something else.
        """
        return cls._unrolled(task, function_rule(task, function), device, check=check)

    @classmethod
    def from_module(
        cls, task: Task, module: TensorDictModuleBase, *, device: torch.device | str = "cpu", check: bool = True
    ) -> Policy:
        """The table of a TensorDict module that reads the keys of a state and writes `action`; see `from_function`.

        The module is run with TorchRL's exploration type DETERMINISTIC: a stochastic actor is taken at its mode.
        """
        return cls._unrolled(task, module_rule(task, module), device, check=check)

    @classmethod
    def _unrolled(cls, task: Task, rule: Rule, device: torch.device | str, *, check: bool) -> Policy:
        sets = unrolled(task, rule, torch.device(device))
        if check and draws(task, rule, torch.device(device), sets):
            raise UserError("policy: draws at random, so that it has no exact value; simulate it, or take its mode")
        return cls(task, sets)

    # What exact evaluation reads, for arrays of any E.

    def on(self, n: int, rows: npt.NDArray[Any], cells: npt.NDArray[Any]) -> Array:
        """`[E]` probability that sensor `cells` `[E]` is on, n misses after the target was located in `rows` `[E]`."""
        if self.sets is None:
            assert self.probability is not None
            return np.full(len(rows), self.probability)
        # Entry (row r, column j) of the table has the number r * M + j; the numbers of those stored are in order.
        # With M = 4 and t_max = 1: located in 2, after 1 miss, sensor 3 is entry (2 * 2 + 1) * 4 + 3 = 23.
        wanted = (np.asarray(rows, dtype=np.int64) * self.task.num_choices + n) * self.task.num_cells + cells
        place = np.searchsorted(self._entries, wanted)
        found: BoolArray = self._entries[place] == wanted
        if self.deterministic:
            return found.astype(np.float64)
        return np.where(found, np.append(self.sets.data, 0.0)[place], 0.0)

    def spent(self, n: int, price: Array) -> Array:
        """`[M]` expected price of the sensors on, n misses after each located cell; `price` `[M]` is per sensor."""
        if self.sets is None:
            assert self.probability is not None
            return np.full(self.task.num_cells, self.probability * price.sum())
        rows = self.sets[n :: self.task.num_choices]
        return rows.astype(np.float64) @ price

    @cached_property
    def _entries(self) -> npt.NDArray[np.int64]:
        """`[nnz + 1]` numbers of the entries stored, in order; after them one that is larger than any."""
        assert self.sets is not None
        row = np.repeat(np.arange(self.sets.shape[0], dtype=np.int64), np.diff(self.sets.indptr))
        return np.append(row * self.task.num_cells + self.sets.indices, np.iinfo(np.int64).max)

    def dense(self) -> BoolArray:
        """`[M, t_max + 1, M]`, the sets of a deterministic policy; M² (t_max + 1) bytes, so for small worlds alone.

        Raises:
            UserError: the policy draws its sets.
        """
        if not self.deterministic:
            raise UserError("policy: draws its sets at random, so that there is no table of them")
        shape = (self.task.num_cells, self.task.num_choices, self.task.num_cells)
        if self.sets is None:
            return np.full(shape, self.probability == 1.0)
        return self.sets.toarray().reshape(shape)

    def as_lists(self) -> dict[str, Any]:
        """Plain lists, as `sets.json` has them: for each located cell the sensed cells at n = 0 ... t_max."""
        m, choices = self.task.num_cells, self.task.num_choices
        if self.sets is None:
            each = list(range(m)) if self.probability == 1.0 else []
            return {"t_max": self.task.t_max, "sets": {str(cell): [each] * choices for cell in range(m)}}
        lists = [part.tolist() for part in np.split(self.sets.indices, self.sets.indptr[1:-1])]
        sets = {str(cell): lists[cell * choices : (cell + 1) * choices] for cell in range(m)}
        return {"t_max": self.task.t_max, "sets": sets}

    # Acting.

    @property
    def num_draws(self) -> int:
        """Uniform draws that one decision takes: none, or one per sensor."""
        return 0 if self.deterministic else self.task.num_cells

    def act(self, last_cell: Tensor, steps_since_detection: Tensor, draws: Tensor | None = None) -> Tensor:
        """`[*B, M]` bool, the sensors on, as a function of state and draws.

        Args:
            last_cell: `[*B]` int64.
            steps_since_detection: `[*B]` int64; where the safe action is forced the last set stands in, unused.
            draws: `[*B, num_draws]` uniform in [0, 1), where the policy is not deterministic.
        """
        probability = self.probabilities(last_cell, steps_since_detection)
        if self.deterministic:
            return probability
        assert draws is not None
        if self.k is None:
            return draws < probability
        on = torch.zeros_like(draws, dtype=torch.bool)
        return on.scatter_(-1, draws.topk(self.k, dim=-1).indices, value=True)

    def probabilities(self, last_cell: Tensor, steps_since_detection: Tensor) -> Tensor:
        """`[*B, M]` with which each sensor is switched on: bool for a deterministic policy, else float32."""
        device, shape = last_cell.device, (*last_cell.shape, self.task.num_cells)
        if self.sets is None:
            assert self.probability is not None
            dtype = torch.bool if self.deterministic else torch.float32
            return torch.full(shape, self.probability, dtype=dtype, device=device)
        if self._lookup is None or self._lookup.device != device:
            form = DenseTable if self.sets.shape[0] * self.sets.shape[1] <= _DENSE else SparseTable
            self._lookup = form(self.sets, device)
        n = steps_since_detection.clamp_max(self.task.t_max)
        return self._lookup(last_cell * self.task.num_choices + n)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, M]`."""
        last_cell, n = tensordict["last_cell"], tensordict["steps_since_detection"]
        if self.deterministic:
            return tensordict.set("action", self.act(last_cell, n))
        device = last_cell.device if self.generator is None else self.generator.device
        draws = torch.rand((*last_cell.shape, self.num_draws), generator=self.generator, device=device)
        return tensordict.set("action", self.act(last_cell, n, draws))


def as_policy(task: Task, policy: PolicyLike, *, device: torch.device | str | None = None) -> Policy:
    """Anything that acts as a `Policy`.

    Args:
        task: what it acts in.
        policy: a `Policy`, a TensorDict module, or a function.
        device: where to ask a module or function; None for where the module's first weight is, or the CPU.

    Raises:
        UserError: it draws at random, belongs to another grid, or is not of these forms.
    """
    if isinstance(policy, Policy):
        if (policy.task.num_cells, policy.task.t_max) != (task.num_cells, task.t_max):
            theirs, ours = (f"{each.num_cells} cells, t_max {each.t_max}" for each in (policy.task, task))
            raise UserError(f"policy: made for {theirs}; expected {ours}")
        return policy
    if isinstance(policy, TensorDictModuleBase):
        weights = itertools.chain(policy.parameters(), policy.buffers())
        first = next(weights, None)
        place = device or (torch.device("cpu") if first is None else first.device)
        return Policy.from_module(task, policy, device=place)
    if callable(policy):
        return Policy.from_function(task, policy, device=device or "cpu")
    raise UserError(f"policy: expected a Policy, a TensorDict module or a function, got {type(policy).__name__}")


def _checked(task: Task, sets: sparse.csr_array) -> sparse.csr_array:
    """The sets in canonical form: sorted, no entries of zero, bool where all entries are 0 or 1.

    Raises:
        UserError: another shape, or entries that are no probabilities.
    """
    expected = (task.num_cells * task.num_choices, task.num_cells)
    if sets.shape != expected:
        raise UserError(f"policy: expected sets of shape {expected} (M (t_max + 1), M), got {sets.shape}")
    sets = sparse.csr_array(sets, copy=True)
    if sets.dtype != np.bool_:
        if not ((sets.data >= 0) & (sets.data <= 1)).all():
            raise UserError("policy: expected probabilities between 0 and 1")
        sets = sets.astype(np.bool_ if np.isin(sets.data, (0, 1)).all() else np.float64)
    sets.sum_duplicates()  # sorts the columns of each row as well
    sets.eliminate_zeros()
    return sets
