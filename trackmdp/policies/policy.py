"""The one policy: which sensors are on n misses after the target was located in x, as a table or as one number.

After a miss the next state is known in advance (`solvers/value.py`), so a deterministic policy of a Track-MDP
is one open-loop plan per located cell: the sets sensed at n = 0 ... t_max misses, followed until the next detection.
All plans together are a sparse matrix with a row per pair (x, n) and a column per sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from trackmdp.arrays.entries import with_data
from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError, output_of, path_of
from trackmdp.policies.forms import (
    STATE_KEYS,
    acting,
    adapted,
    known_task,
    rule_of,
    transformed,
)
from trackmdp.policies.lookup import Lookup, in_window
from trackmdp.policies.saved import load_policy, save_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.policies.tracker import Tracker
from trackmdp.policies.unroll import mixture, unrolled
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

PolicyLike: TypeAlias = Any
"""A policy or its table, a TensorDict module, a function as `Policy.from_function` takes it, or an object that holds a
policy: a `Run`, a `Solution`, a dense table, a model of Stable-Baselines3."""


class Policy(TensorDictModuleBase, PolicyTable):
    """A policy of a Track-MDP, and a TensorDict module that acts it out.

    Either `sets` or `probability` is given. This table is common to policies that are learned, solved, recorded or
    written by hand; an actor net or a function becomes one with `from_module` or `from_function`.

    Args:
        task: grid, costs and limits.
        sets: `[keys * (t_max + 1), S]` sparse; row `key * (t_max + 1) + n` is the set at n misses after the detection
            that left `key`: the located cell, or more where the task's memory holds more. Bool entries are sensors on;
            entries in (0, 1] are the probabilities of switching them on, independently of each other and of the
            history.
        probability: the same for every sensor in every state, instead of `sets`.
        k: exactly k sensors are on, each such subset equally likely; `probability` is then k / S.

    Attributes:
        deterministic: whether the policy is the same function of the state each time.
        generator: of the draws of `forward`, where the policy is not deterministic; None for torch's global one.

    Raises:
        UserError: the shape does not fit the task's states, or an entry is no probability.
    """

    in_keys: list[str] = list(STATE_KEYS)  # noqa: RUF012 (each policy may have its own)
    out_keys: ClassVar = ["action"]

    def __init__(
        self,
        task: Task,
        sets: sparse.csr_array | None = None,
        *,
        probability: float | None = None,
        k: int | None = None,
    ) -> None:
        TensorDictModuleBase.__init__(self)
        PolicyTable.__init__(self, task, sets, probability=probability, k=k)
        if task.keyed:
            self.in_keys = ["last_cell", "key", "steps_since_detection"]
        self.generator: torch.Generator | None = None
        self._lookups: dict[tuple[torch.device, bool], Lookup] = {}

    def __repr__(self) -> str:
        # The card, not the list of parts that torch shows of a module.
        return PolicyTable.__repr__(self)

    @classmethod
    def from_table(cls, table: PolicyTable) -> Policy:
        """The policy that acts by a table."""
        return cls(table.task, table.sets, k=table.k)

    @classmethod
    def random_k(cls, task: Task, k: int) -> Policy:
        """Of the sensors that can be chosen k, drawn anew at every step, each subset of that size equally likely.

        Where fewer than k can be chosen, as in a window at the border, all of them are on.
        """
        near = PolicyTable.all_on(task).sets
        k = whole_number("policy: k", k, 0, task.total_sensors)
        count = np.diff(near.indptr)
        # Each sensor's own probability of being among the k of its window.
        share = np.minimum(k / np.repeat(count, count), 1.0)
        return cls(task, with_data(near, share), k=k)

    @classmethod
    def from_function(
        cls, task: Task, function: Callable[..., Any], *, check: bool = True
    ) -> Policy:
        """The table of `function(last_cell [B], steps_since_detection [B], action_history [B, t_max+1, K])`.

        It returns bool `[B, K]`, a tensor or an array, and is called for all M * (t_max + 1) states, a few blocks of
        located cells at a time, so that its memory stays bounded.

        Args:
            task: grid, costs and limits.
            function: must not draw; its arguments live on the CPU.
            check: ask everything twice, to find out whether it draws.

        Raises:
            UserError: it draws, or it returns something else; or `task` is no task.
        """
        return cls.from_module(task, function, check=check)

    @classmethod
    def from_module(
        cls,
        task: Task,
        module: TensorDictModuleBase | Callable[..., Any],
        *,
        transform: Transform | None = None,
        device: torch.device | str = "cpu",
        check: bool = True,
    ) -> Policy:
        """The table of a TensorDict module that reads the keys of a state and writes `action`; see `from_function`.

        A module that does not read `key` knows the cell alone; one that reads `observation` is given the
        `ObservationVector`. The module is run with TorchRL's exploration type DETERMINISTIC: a stochastic actor is
        taken at its mode.

        Args:
            task: grid, costs and limits.
            module: the actor.
            transform: of the `TransformedEnv` that it acts in, such as
                ``Compose(ObservationVector(), ObservationNorm(...))``.
            device: device of the module.
            check: see `from_function`.
        """
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            module = module if transform is None else transformed(module, transform)
            known = known_task(task, module)
            return cls(known, unrolled(known, rule_of(known, module), device, check=check))

    # Acting.

    def act(
        self, key: Tensor, steps_since_detection: Tensor, draws: Tensor | None = None
    ) -> Tensor:
        """`[*B, S]` bool, the sensors on, as a function of state and draws.

        Args:
            key: `[*B]` int64, the memory of the last detection; the cell, where that is all.
            steps_since_detection: `[*B]` int64; where the safe action is forced the last set stands in, unused.
            draws: `[*B, S]` uniform in [0, 1), where the policy is not deterministic.
        """
        probability = self.probabilities(key, steps_since_detection)
        if self.deterministic:
            return probability
        assert draws is not None
        if self.k is None:
            return draws < probability
        # The k largest of independent uniforms are a uniformly random subset of size k. Sensors that cannot be chosen
        # get -1 and come last; where fewer than k can, some of those are among the k all the same, and are taken out.
        largest = draws.masked_fill(probability == 0, -1.0).topk(self.k, dim=-1).indices
        on = torch.zeros_like(draws, dtype=torch.bool)
        return on.scatter_(-1, largest, value=True) & (probability > 0)

    def probabilities(self, key: Tensor, steps_since_detection: Tensor) -> Tensor:
        """`[*B, S]` with which each sensor is switched on: bool for a deterministic policy, else float32."""
        return self.lookup(key.device)(self.row(key, steps_since_detection))

    def seeing(self, key: Tensor, steps_since_detection: Tensor) -> Tensor:
        """`[*B, M]` with which a sensor that is on sees each cell: `probabilities`, but for footprints."""
        if self.task.coverage is None:
            return self.probabilities(key, steps_since_detection)
        return Lookup(self.seen, key.device)(self.row(key, steps_since_detection))

    def row(self, key: Tensor, steps_since_detection: Tensor) -> Tensor:
        """`[*B]`, the row of `sets` for a state; where the safe action is forced, the row of the last free choice."""
        if self.alike:
            return torch.zeros_like(key)
        return key * self.task.num_choices + steps_since_detection.clamp_max(self.task.t_max)

    def lookup(self, device: torch.device, *, local: bool = False) -> Lookup:
        """The rows of `sets` on a device, of all sensors or of those of the window alone."""
        local &= self.task.numbered is not None
        if (device, local) not in self._lookups:
            table = in_window(self.task, self.sets) if local else self.sets
            self._lookups[device, local] = Lookup(table, device)
        return self._lookups[device, local]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`: over all cells, or in the local numbers of the window around `last_cell`.

        Raises:
            UserError: a cell, a key or a number of misses is none of this policy's task, or there are no keys.
        """
        last_cell, n = tensordict["last_cell"], tensordict["steps_since_detection"]
        name = "key" if self.task.keyed else "last_cell"
        key = tensordict.get(name, None)
        if key is None:
            expected = f"a world with memory={self.task.memory}, revealed={self.task.revealed}"
            raise UserError(f"policy: reads key, which is not observed here; expected {expected}")
        _check_range(name, key, self.task.num_keys)
        _check_range("steps_since_detection", n, self.task.num_choices + 1)
        if self.deterministic:
            action = self.lookup(key.device, local=True)(self.row(key, n))
            return tensordict.set("action", action)
        # A generator draws on its own device only.
        device = last_cell.device if self.generator is None else self.generator.device
        shape = *last_cell.shape, self.task.total_sensors
        draws = torch.rand(shape, generator=self.generator, device=device)
        action = self.act(key, n, draws)
        if self.task.numbered is not None:
            action = Window.of(self.task, last_cell.device).to_local(last_cell, action)
        return tensordict.set("action", action)

    def tracker(
        self,
        cell: int | None = None,
        *,
        at: tuple[float, float] | None = None,
        mode: int | None = None,
        seed: int = 0,
        world: Any = None,
    ) -> Tracker:
        """A tracker that follows one target with this policy from its detection in `cell` on; see `Tracker`."""
        return Tracker(self, cell, at=at, mode=mode, seed=seed, world=world)

    # Files.

    def save(self, file: str | Path, value: Array | None = None) -> None:
        """Write `policy.npz`; see `trackmdp.policies.saved`.

        Raises:
            UserError: the file cannot be written there.
        """
        save_policy(output_of(file, "save"), self, value)

    @classmethod
    def load(cls, file: str | Path) -> Policy:
        """Read a `policy.npz`.

        Raises:
            UserError: the file is missing or damaged, or holds something else.
        """
        return cls.from_table(load_policy(path_of(file, "load"))[0])


def as_policy(task: Task, policy: PolicyLike) -> Policy:
    """Anything that acts as a `Policy`.

    A stochastic actor of TorchRL is the mixture that it draws from, unless `set_exploration_type` chooses its mode.

    Args:
        task: in which it acts.
        policy: a `Policy`, an object that holds one (`trackmdp.policies.forms.adapted`), a TensorDict module, which is
            asked on the device of its first weight, or a function.

    Raises:
        DrawsError: a module or function draws at random with probabilities that are not known, or depend on its
            earlier draws; `Policy.random_k` and tables of probabilities may draw.
        UserError: it belongs to another grid, or is not of these forms.
    """
    policy = adapted(task, policy)
    if isinstance(policy, PolicyTable):
        policy.check_fits(task)
        return policy if isinstance(policy, Policy) else Policy.from_table(policy)
    tensors = policy.parameters() if isinstance(policy, torch.nn.Module) else ()
    where = next((weight.device for weight in tensors), torch.device("cpu"))
    with acting():
        known = known_task(task, policy)
        sets = mixture(known, policy, where)
        if sets is None:
            sets = unrolled(known, rule_of(known, policy), where, check=True)
    return Policy(known, sets)


def _check_range(name: str, values: Tensor, count: int) -> None:
    """See that all entries are of 0 ... `count` - 1; a negative one would count from the end.

    Raises:
        UserError: one is not.
    """
    # On another device the look would wait for all work under way there; in a graph it cannot be.
    if values.device.type != "cpu" or torch.compiler.is_compiling() or not values.numel():
        return
    for value in torch.stack(torch.aminmax(values)).tolist():
        if not 0 <= value < count:
            raise UserError(f"policy: {name}={value}, expected 0 to {count - 1}")
