"""Networks of a Track-MDP: encoder of its state, subset policies with one Bernoulli per sensor, values, additive Q.

The encoder is a linear layer that never multiplies by the zeros of a one-hot. `CellClockNet` is over (last cell, steps
since detection), the state that a deterministic policy depends on: after a miss the next state is known in advance, so
along its own path the action history follows from these two. It is a table of chains, one per located cell, and a net
may be run on all of its rows at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch import distributions as dist
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import ProbabilisticActor, ValueOperator

from trackmdp.policies.few_sensors import FewSensors, greedy
from trackmdp.policies.forms import state_keys
from trackmdp.policies.joint_nets import last_clock, of_kinds
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

_PAIRS = 2**16  # of cells, with their displacements kept in memory; 16 x 16 cells have as many


class StateEncoder(nn.Module):
    """`[..., hidden]` features of (last_cell, steps_since_detection, action_history), and of `key` where there is one.

    Equal to a linear layer on the one-hot cell, the one-hot n, their product and the history bits, followed by ReLU.
    Sums of rows of one table stand for the one-hots, and the history is multiplied only where n > 0 (most rows have
    none). The contexts that a key shares with others (`KeySpace.contexts`), and the key, have each rows of the product
    with n: seldom seen keys are known by their cell and by their displacement or mode.
    """

    offset: Tensor

    def __init__(
        self, task: Task, hidden: int, *, scale: float = 0.1, history_scale: float = 0.1
    ) -> None:
        super().__init__()
        self.stages, self.keys = task.t_max + 2, task.keys
        self._parts = {
            "cell": task.num_cells,
            "stage": self.stages,
            "cell_and_stage": task.num_cells * self.stages,
        }
        # The first context is of all keys alike, as is `stage`.
        contexts = task.keys.contexts(torch.zeros(1))[1:] if task.keyed else []
        for k, (_, count) in enumerate(contexts):
            self._parts[f"known.{k}"] = count * self.stages
        # One table for all: one lookup adds the rows up, which takes a fifth of the time of one after the other.
        self.table = nn.Parameter(scale * torch.randn(sum(self._parts.values()), hidden))
        counts = torch.tensor([0, *self._parts.values()])
        self.register_buffer("offset", counts[:-1].cumsum(0), persistent=False)
        self.history = nn.Linear(task.num_choices * task.num_sensors, hidden)
        nn.init.normal_(self.history.weight, std=history_scale)
        nn.init.zeros_(self.history.bias)
        # Files hold the parts by their names: a run of another t_max or memory takes those that fit (`init_from`).
        self.register_state_dict_post_hook(_split)
        self.register_load_state_dict_pre_hook(_joined)

    def forward(
        self,
        last_cell: Tensor,
        steps_since_detection: Tensor,
        action_history: Tensor,
        key: Tensor | None = None,
    ) -> Tensor:
        """Features of a batch of any shape `[...]`; `action_history` is `[..., t_max+1, K]`."""
        shape = last_cell.shape
        cell, n = last_cell.reshape(-1), steps_since_detection.reshape(-1)
        rows = [cell, n, cell * self.stages + n]
        if key is not None:
            contexts = self.keys.contexts(key.reshape(-1))[1:]
            rows += [context * self.stages + n for context, _ in contexts]
        index = torch.stack(rows, -1) + self.offset
        features = nn.functional.embedding_bag(index, self.table, mode="sum")
        missed = n.nonzero().squeeze(-1)
        bits = action_history.reshape(len(cell), -1)[missed].to(features.dtype)
        features.index_add_(0, missed, bits @ self.history.weight.T)
        features += self.history.bias
        return features.relu_().reshape(*shape, -1)


def _split(encoder: StateEncoder, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Name the parts of the table in a state dict, views of it."""
    parts = state.pop(f"{prefix}table").split(list(encoder._parts.values()))
    for name, part in zip(encoder._parts, parts, strict=True):
        state[f"{prefix}{name}"] = part


def _joined(encoder: StateEncoder, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Join the parts of a state dict that has all of them."""
    if all(f"{prefix}{name}" in state for name in encoder._parts):
        parts = [state.pop(f"{prefix}{name}") for name in encoder._parts]
        state[f"{prefix}table"] = torch.cat(parts)


class StateNetwork(nn.Module):
    """A `StateEncoder` with a linear head on top."""

    def __init__(
        self, task: Task, hidden: int, head: nn.Linear, targets: Sequence[int] = ()
    ) -> None:
        super().__init__()
        self.encoder = of_kinds(partial(StateEncoder, task, hidden), targets)
        self.head = head

    def forward(self, *state: Tensor) -> Tensor:
        """`[..., head.out_features]` of a batch of states of shape `[...]`, the arguments those of the encoder."""
        return self.head(self.encoder(*state))


class RelativeBias(nn.Module):
    """A number per sensor by n and by where the sensor stands, as seen from the last located cell; zero at first.

    It is shared by all cells: that sensors far away are of no use is learned once, not once per cell. (The name is that
    of the relative position bias of Shaw et al. 2018.) Where a policy knows more than the cell, each class of keys has
    numbers of its own: that a target with this heading goes there is learned once as well.

    With `grid.window` the K sensors of the window are the displacements, and the table is `[C (t_max+2), K]`. Without
    one there are (2 rows - 1)(2 columns - 1) displacements, of which each cell sees M.
    """

    _code: Tensor | None
    _index: Tensor | None

    def __init__(self, task: Task) -> None:
        super().__init__()
        side, places = 2 * task.columns - 1, (2 * task.rows - 1) * (2 * task.columns - 1)
        # Sensors with footprints stand at no cell: each has a number of its own, the same for every cell.
        self._whole = task.numbered is None and task.coverage is None
        self.classes, self.stages = task.keys.num_classes, task.t_max + 2
        self.table = nn.Parameter(
            torch.zeros(self.classes * self.stages, places if self._whole else task.num_sensors)
        )
        # Displacements (row, column) from (1 - rows, 1 - columns) to (rows - 1, columns - 1), row by row; (0, 0) is the
        # one in the middle. On 3 x 3, side 5, from cell 4 (code 6) to cell 5 (code 7): 7 - 6 + 12, right of the middle.
        cell = torch.arange(task.num_cells if self._whole else 0)
        code = cell // task.columns * side + cell % task.columns
        # On a small grid the places of all pairs of cells are kept: where a batch has more states than there are rows
        # (class, n, cell), all rows are written out, and a state looks up one of them.
        few = self._whole and len(code) ** 2 <= _PAIRS
        kept = code - code.unsqueeze(-1) + places // 2 if few else None
        self.register_buffer("_index", kept, persistent=False)
        self.register_buffer("_code", code if self._whole else None, persistent=False)

    def forward(
        self, last_cell: Tensor, steps_since_detection: Tensor, key: Tensor | None = None
    ) -> Tensor:
        """`[..., K]` of a batch of any shape `[...]`."""
        row = (
            steps_since_detection
            if key is None
            else key % self.classes * self.stages + steps_since_detection
        )
        if self._code is None:
            return nn.functional.embedding(row, self.table)
        m = len(self._code)
        if self._index is not None and len(self.table) * m <= row.numel():
            rows = self.table[:, self._index].view(-1, m)
            return nn.functional.embedding(row * m + last_cell, rows)
        places = self.table.shape[1]
        middle = row * places + places // 2 - self._code[last_cell]
        return self.table.view(-1)[middle.unsqueeze(-1) + self._code]


# A logit with a sigmoid of 0 in float32: no draw from [0, 1) is below it, and log-probability and entropy are 0.
_NEVER = -200.0


class SubsetDistribution(dist.Independent):  # type: ignore[type-arg]
    """Independent sensors, each on with probability sigmoid(logit); samples are `[..., K]` bool."""

    def __init__(self, logits: Tensor) -> None:
        super().__init__(dist.Bernoulli(logits=logits, validate_args=False), 1, validate_args=False)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """A subset; compares uniform draws, which is three times as fast as torch.bernoulli."""
        shape = self._extended_shape(torch.Size(sample_shape))
        probability = torch.sigmoid(self.base_dist.logits.detach()).expand(shape)
        return torch.rand(shape, device=probability.device) < probability

    def log_prob(self, value: Tensor) -> Tensor:
        """`[...]` log-probability of the subset `value` `[..., K]`: Σ_j log σ(±z_j)."""
        logits = self.base_dist.logits
        return nn.functional.logsigmoid(torch.where(value, logits, -logits)).sum(-1)

    def entropy(self) -> Tensor:
        """`[...]` Σ_j [softplus(z_j) - z_j σ(z_j)]."""
        logits = self.base_dist.logits
        return (nn.functional.softplus(logits) - logits * torch.sigmoid(logits)).sum(-1)

    @property
    def mode(self) -> Tensor:
        """The most likely subset: sensors with a positive logit."""
        return self.base_dist.logits > 0

    deterministic_sample = mode


def make_actor(
    task: Task, hidden: int, initial_logit: float, targets: Sequence[int] = ()
) -> ProbabilisticActor:
    """State -> `logits` `[B, K]` -> `action` `[B, K]` bool, with `action_log_prob` `[B]`.

    K = M, or with `grid.window` the sensors around `last_cell`; those outside the grid are never on. With a budget no
    more are on than it allows. `targets` are the kinds of several targets (`OverTargets`).
    """
    head = nn.Linear(hidden, task.num_sensors)
    nn.init.orthogonal_(head.weight, gain=0.01)
    nn.init.constant_(head.bias, initial_logit)
    window = None if task.numbered is None else Window.of(task)
    shared = of_kinds(partial(RelativeBias, task), targets)
    network = _Logits(StateNetwork(task, hidden, head, targets), shared, window)
    few = task.budget is not None and task.budget < task.num_sensors
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=state_keys(task, targets), out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=FewSensors if few else SubsetDistribution,
        distribution_kwargs={"budget": task.budget} if few else {},
        return_log_prob=True,
    )


class _Logits(nn.Module):
    """A network's logits on top of the logits that all cells share."""

    def __init__(self, network: StateNetwork, shared: nn.Module, window: Window | None) -> None:
        super().__init__()
        self.network, self.shared, self.window = network, shared, window

    def forward(
        self, last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor, *key: Tensor
    ) -> Tensor:
        own = self.network(last_cell, steps_since_detection, action_history, *key)
        logits = own + self.shared(last_cell, steps_since_detection, *key)
        if self.window is None:
            return logits
        inside = self.window.inside(last_cell.reshape(-1)).view(logits.shape)
        return logits.masked_fill(~inside, _NEVER)


def make_critic(task: Task, hidden: int, targets: Sequence[int] = ()) -> ValueOperator:
    """State -> `state_value` `[B, 1]`; `targets` as of `make_actor`."""
    head = nn.Linear(hidden, 1)
    nn.init.orthogonal_(head.weight)
    nn.init.zeros_(head.bias)
    network = StateNetwork(task, hidden, head, targets)
    return ValueOperator(network, in_keys=state_keys(task, targets))


_ALL_ON = (
    0.5  # sensors start a little above zero: the needless ones are learned, not the needed ones
)


class AdditiveQ(nn.Module):
    """Q(s, a) = V(s) + Σ_j (a_j - 1[q_j(s) > 0]) q_j(s): a dueling network over sensors.

    V(s) is the value of the best subset {j : q_j > 0}, and only sensors that differ from it contribute, so that the
    targets' noise reaches q_j through the few sensors flipped for exploration alone (after Wang et al. 2016).
    q_j counts in units of the sensor's price.
    """

    def __init__(self, task: Task, hidden: int, scale: float, targets: Sequence[int] = ()) -> None:
        super().__init__()
        self.t_max, self.targets = task.t_max, targets
        encoder = partial(StateEncoder, task, hidden, scale=1.0, history_scale=0.03)
        self.encoder = of_kinds(encoder, targets)
        self.base, self.sensor = nn.Linear(hidden, 1), nn.Linear(hidden, task.num_sensors)
        self.shared = of_kinds(partial(RelativeBias, task), targets)
        for head, start in ((self.base, 0.0), (self.sensor, _ALL_ON)):
            nn.init.orthogonal_(head.weight, gain=0.01)
            nn.init.constant_(head.bias, start)
        price = torch.as_tensor(task.paid, dtype=torch.float32).clamp_min(0.01 * task.reward)
        self.window = Window.of(task) if task.numbered is not None else None
        # Cell M, outside the grid, has no price: there q_j is 0, and the sensor off.
        unit = price if self.window is None else nn.functional.pad(price, (0, 1))
        self.unit = nn.Buffer(scale * unit)

    def forward(
        self, last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor, *key: Tensor
    ) -> tuple[Tensor, Tensor]:
        """V `[..., 1]` and q `[..., K]`, the latter 0 where the safe action is forced and outside the grid."""
        features = self.encoder(last_cell, steps_since_detection, action_history, *key)
        free = (last_clock(steps_since_detection, self.targets) <= self.t_max).unsqueeze(-1)
        unit = self.units(last_cell)
        worth = self.sensor(features) + self.shared(last_cell, steps_since_detection, *key)
        return self.base(features), unit * worth * free

    def units(self, last_cell: Tensor) -> Tensor:
        """Prices `[K]`, or in a window `[..., K]`, of the sensors that can be chosen, scaled as rewards are."""
        return self.unit if self.window is None else self.unit[self.window.around(last_cell)]


def joint_value(base: Tensor, sensor: Tensor, action: Tensor, budget: int | None = None) -> Tensor:
    """`[...]` Q(s, a) of `action` `[..., K]` from a network's `base` `[..., 1]` and `sensor_value` `[..., K]`."""
    flipped = action.to(sensor.dtype) - greedy(sensor, budget).to(sensor.dtype)
    return base.squeeze(-1) + (sensor * flipped).sum(-1)


class EpsilonFlip(TensorDictModuleBase):
    """The greedy subset {j : q_j > 0}; while exploring, sensor j is flipped with probability ε / max(1, |q_j| / c_j).

    A flip costs |q_j|, so that exploring costs at most ε c_j for each sensor. With ε for all, a sensor of use is left
    out as often as a useless one is on; these misses are dear, and their noise hides the prices of the others.
    Sensors without a value stay off: those outside the grid, and all where the safe action is forced.

    Args:
        epsilon: ε.
        units: gives the c_j at `last_cell`, in the units of the values; None for a constant probability.
        budget: sensors that may be on; of more those that were flipped stay, and then the best.
    """

    in_keys: ClassVar = ["sensor_value", "last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(
        self,
        epsilon: float,
        units: Callable[[Tensor], Tensor] | None = None,
        budget: int | None = None,
    ) -> None:
        super().__init__()
        self.epsilon, self._units = nn.Buffer(torch.tensor(epsilon)), units
        self._budget = budget

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`."""
        value = tensordict["sensor_value"]
        chosen = greedy(value, self._budget)
        if exploration_type() is ExplorationType.RANDOM:
            chance = self.epsilon * (value != 0)
            if self._units is not None:
                # Outside the grid unit and value are 0, and so is the chance.
                unit = self._units(tensordict["last_cell"])
                chance = chance * unit / torch.maximum(unit, value.abs()).clamp_min(1e-30)
            flipped = torch.rand(value.shape, device=value.device) < chance
            chosen = chosen ^ flipped
            if self._budget is not None:
                # Ranks in (0, 2]: flipped ones above 1, the others by their value.
                rank = (value - value.amin(-1, keepdim=True)).tanh() + flipped + 1e-6
                chosen = greedy(rank * chosen, self._budget)
        return tensordict.set("action", chosen)


def make_qvalue(
    task: Task, hidden: int, scale: float, targets: Sequence[int] = ()
) -> TensorDictModule:
    """State -> `base` `[B, 1]`, `sensor_value` `[B, K]`, for rewards multiplied by `scale`; see `make_actor`."""
    network = AdditiveQ(task, hidden, scale, targets)
    keys = state_keys(task, targets)
    return TensorDictModule(network, in_keys=keys, out_keys=["base", "sensor_value"])


class CellClockNet(nn.Module):
    """One hidden layer over embeddings of the cell, of the clock and of the pair, added up; or a plain table.

    A hidden layer's decoder learns common patterns from all rows; a table of outputs has a number for each row
    and output, and takes a hundredth of the time.

    With `classes` a cell has as many rows, numbered cell · C + class as keys are (`KeySpace`). Then cell and class have
    each an embedding of their own with the clock, beside the key's: rare keys are known by these.

    Args:
        num_cells: M; with classes M · C.
        num_clocks: values the clock takes, 0 ... num_clocks - 1.
        hidden: hidden units; 0: a table.
        outputs: numbers per row.
        bias: value of the outputs' bias at the start.
        generator: draws the initial weights, on its device.
        groups: int64 `[M]`, the group of each cell, numbered from 0; cells of one group share all weights. None: each
            cell is its own.
        classes: C.
    """

    groups: Tensor | None

    def __init__(
        self,
        num_cells: int,
        num_clocks: int,
        *,
        hidden: int,
        outputs: int,
        generator: torch.Generator,
        bias: float = 0.0,
        groups: Tensor | None = None,
        classes: int = 1,
    ) -> None:
        super().__init__()
        self.register_buffer("groups", groups, persistent=False)
        if groups is not None:
            num_cells = int(groups.max()) + 1

        if not hidden:
            shape = (num_cells, num_clocks, outputs)
            self.table = nn.Parameter(torch.full(shape, bias, device=generator.device))
            return

        def normal(*shape: int, std: float) -> nn.Parameter:
            return nn.Parameter(
                std * torch.randn(shape, generator=generator, device=generator.device)
            )

        # [M, 1, H] + [C, H] + [M, C, H] broadcast to [M, C, H]: cell and clock share the common part, the pair
        # learns the rest.
        self.cell = normal(num_cells, 1, hidden, std=0.3)
        self.clock = normal(num_clocks, hidden, std=0.3)
        self.pair = normal(num_cells, num_clocks, hidden, std=0.3)
        # Std 1 / sqrt(H) keeps the outputs' size independent of the width.
        self.weight = normal(hidden, outputs, std=hidden**-0.5)
        self.bias = nn.Parameter(torch.full((outputs,), bias, device=generator.device))
        if classes > 1:
            self.located = normal(num_cells // classes, 1, num_clocks, hidden, std=0.3)
            self.known = normal(classes, num_clocks, hidden, std=0.3)

    def forward(self, cells: slice = slice(None)) -> Tensor:
        """`[M, num_clocks, outputs]`, the outputs of every row, or of the rows of some `cells` alone."""
        if hasattr(self, "table"):
            return self.table[cells] if self.groups is None else self.table[self.groups[cells]]
        embedding = self.cell + self.clock + self.pair
        if hasattr(self, "known"):
            embedding = embedding + (self.located + self.known).flatten(0, 1)
        # With groups the embedding has a row per group and not per cell; the wanted cells are picked at the end.
        if self.groups is None and cells != slice(None):
            embedding = embedding[cells]
        rows = embedding.relu() @ self.weight + self.bias
        return rows if self.groups is None else rows.index_select(0, self.groups[cells])
