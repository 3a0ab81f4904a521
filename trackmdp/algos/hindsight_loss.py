"""The losses of hindsight learning, from fully sensed paths."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from trackmdp.algos.actor_loss import ActorLoss, SensorCredit, decision_loss
from trackmdp.algos.gains import Credit, clocked_advantage, scatter_add
from trackmdp.algos.in_view import SensorsInView
from trackmdp.algos.path_replay import Replay, Replayed
from trackmdp.arrays.types import IndexArray
from trackmdp.policies.cell_clock import CellClockNet
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

# Weights of the clocks (`_weights`): the running mean gain moves a tenth of the way at each update; a clock with fewer
# than 20 rows, or a mean gain under .2 r, is not magnified any further, or a handful of rows would rule the step.
_GAIN_SCALE_RATE = 0.1
_FEWEST_ROWS = 20
_LEAST_GAIN = 0.2
_EXPLORING_AT_END = 1 / 16
"""Share of exploring starts (`Replay.begin`) at λ = 1; at λ = 0 it is a half."""


class HindsightLoss(nn.Module):
    """Losses of the actor, the critic V and the clocked actor and critic, from fully sensed paths.

    Rewards and costs are in units of r. Rows are deduplicated: located cells and clocks can be enumerated, so each net
    is run once on every (x, n), and a batch of any size enters as sums over its paths.

    Where a policy knows more at a detection than the cell, its keys stand for located cells, M being their number; a
    key is cell · H + class, and the windows around it are those of its cell.

    Args:
        task: grid, rewards and costs.
        actor_loss: of the actor; the clocked actor always has the decision loss.
        reach: rows and columns that the target moves in one step, at most.
        hidden: hidden units of each net.
        discount: γ of the credit.
        generator: draws the initial weights.
        classes: `[M]`, the target moves alike from all cells of one class away from the border; None: no two cells
            share estimates or sets.
        max_entries: entries (x, n, sensor) of a table at most, where that leaves one cell; larger tables are worked
            through in parts, a few cells at a time. The losses are the same, up to rounding.
    """

    def __init__(
        self,
        task: Task,
        actor_loss: ActorLoss,
        *,
        reach: int,
        hidden: int,
        discount: float,
        generator: torch.Generator,
        classes: IndexArray | None = None,
        max_entries: int = 2**62,
    ) -> None:
        super().__init__()
        # Shapes below: M cells, T + 1 = t_max + 1 clocks, B paths, C cells of a window around the located cell, and K
        # sensors that may see them, one in each where none has a footprint.
        choices, device = task.num_choices, generator.device
        self._task, self._generator, self._keys, self.reach = task, generator, task.keys, reach
        # One move takes the target to a cell that is near; t_max + 1 of them, to one in view.
        self.nearby = SensorsInView(task, Window.reaching(task, reach, device))
        self.sensors = SensorsInView(task, _in_view(task, choices * reach, device))
        self._make_nets(hidden, classes)
        actor_loss.allocate((task.num_keys, choices, self.sensors.width), device)
        self.actor_loss = actor_loss
        entries = max(self.sensors.entries, self.nearby.window.width * self._keys.modes)
        self._keys_at_once = max(1, max_entries // (choices * entries))
        self.credit = Credit.of(task, discount, device)
        self._clocked = ClockedLoss(task, self.nearby, self.clocked_actor, self.credit, reach)
        # Row 0 for the clocked actor, row 1 for the actor.
        self.gain_scale = nn.Buffer(torch.ones(2, choices, device=device))

    def _make_nets(self, hidden: int, classes: IndexArray | None) -> None:
        task, generator, choices = self._task, self._generator, self._task.num_choices
        own_classes = self._keys.num_classes
        # The border looks alike from two cells where it is equally far, or out of reach until the safe action; and so
        # must all classes of cells do that the target may come to before it.
        # The sets are then learned once for both; values stay each cell's own. Keys of one group are of one class.
        groups = None
        if classes is not None:
            window = Window(task, choices * self.reach, generator.device)
            alike = window.groups(torch.as_tensor(classes, device=generator.device))
            own = torch.arange(own_classes, device=alike.device)
            groups = (alike.unsqueeze(1) * own_classes + own).flatten()
        net = partial(
            CellClockNet, task.num_keys, hidden=hidden, generator=generator, classes=own_classes
        )

        def decisions(sensors: SensorsInView) -> CellClockNet:
            # Where the window is the whole grid an output stands for a cell, and cannot be shared. Bias -1 starts all
            # sensors off (z > 0 is on).
            shared = groups if sensors.window.is_local else None
            return net(choices, outputs=sensors.width, bias=-1.0, groups=shared)

        # U has T + 2 clocks: also n = T + 1, where the safe action is forced. V has a second one, L, only where that
        # may have to be repeated.
        self.actor = decisions(self.sensors)
        self.critic = net(1 if task.safe else 2, outputs=1)
        self.clocked_actor = decisions(self.nearby)
        self.clocked_critic = net(choices + 1, outputs=1)

    def parts(self, cells: Tensor, on: Tensor, blend: float) -> Iterator[dict[str, Tensor]]:
        """The losses, a few located cells at a time; the critics' come with the last part.

        The parts share no graph: the caller may call `backward` on each and free it before asking for the next one.

        Args:
            cells: int64 `[T+3, B]`, paths: the located cell, then the cells sensed next, M once outside; longer ones
                where a policy remembers detections (`path_replay`).
            on: bool `[M, T+1, K]`, the sensors that the replayed policy switches on, as the actor's outputs.
            blend: λ of the gain.
        """
        slices = self.slices()
        found = torch.cat([self.sensors.reports(on[rows], rows) for rows in slices])
        # C(A) [M, T + 1] of all sets.
        prices = [(on[rows] * self.sensors.prices[rows].unsqueeze(1)).sum(-1) for rows in slices]
        view, paid = self.sensors.window, torch.cat(prices)
        replay = Replay(self._task, view, self.credit, found, paid, self._generator)
        cells, own = replay.begin(cells, max(_EXPLORING_AT_END, (1.0 - blend) / 2))
        clocked, value = self._values()
        # [T + 1, M + 1], nothing gained by sensing an exited target. Detached: decisions do not train the values.
        advantage = pad(clocked_advantage(clocked.detach()), (0, 1))
        plans = replay.followed(cells, own, advantage, value.detach(), blend)
        weights = (
            self._weights(0, *self._clocked.first_gains(cells[1], advantage)),
            self._weights(1, plans.alive.sum(1), plans.gain.abs().sum(1)),
        )
        # [M + 1, T + 2], U = 0 once exited.
        known, targets = pad(clocked.detach(), (0, 0, 0, 1)), []
        for rows in slices:
            chosen = self._paths_from(cells[0], rows)
            loss, target = self._clocked.of(cells[:2, chosen], rows, advantage, known)
            actor_loss = self._own(plans, rows, self._paths_from(own[0], rows))
            targets.append(target)
            # The actor's rows are those of the policy's own plans, the clocked actor's every (x, n) that a move was
            # seen from.
            losses = {
                "actor": (actor_loss * weights[1]).sum(),
                "clocked_actor": (loss * weights[0]).sum(),
            }
            if rows is slices[-1]:
                losses["critic"] = _squared_error(value, own[0], plans.target)
                losses["clocked_critic"] = _squared_error(clocked, cells[0], torch.cat(targets))
            yield losses

    def _values(self) -> tuple[Tensor, Tensor]:
        """U `[M, T+2]` and V `[M, 1]`, or V and L `[M, 2]`."""
        clocked, value = self.clocked_critic().squeeze(-1), self.critic().squeeze(-1)
        # U(x, T+1) holds r - D for certain; the net learns the rest.
        clocked = torch.cat([clocked[:, :-1], clocked[:, -1:] + self.credit.forced], dim=1)
        return clocked, torch.cat([value[:, :1], value[:, 1:] + self.credit.forced], dim=1)

    def slices(self) -> list[slice]:
        """The located cells, as many at once as `max_entries` allows."""
        m, step = self._keys.num_keys, self._keys_at_once
        return [slice(begin, min(begin + step, m)) for begin in range(0, m, step)]

    def _paths_from(self, start: Tensor, rows: slice) -> slice | Tensor:
        """Which paths start in the cells `rows`."""
        if self._keys_at_once >= self._keys.num_keys:
            return slice(None)
        return ((start >= rows.start) & (start < rows.stop)).nonzero().squeeze(1)

    def _own(self, replayed: Replayed, rows: slice, chosen: slice | Tensor) -> Tensor:
        """`[T+1]`, the actor's losses per clock, on the `chosen` paths, those from the cells `rows`."""
        logits, width = self.actor(rows), self.sensors.window.width
        count, choices, _ = logits.shape
        row, entry = replayed.row[:, chosen], replayed.entry[:, chosen]
        if first := rows.start * choices:
            row, entry = row - first, entry - first * width
        alive = replayed.alive[:, chosen]
        # Paths that reach each (x, n); every sensor on costs c on each of them, the one the target moves to included.
        arrivals = scatter_add(alive, row, count * choices).view(count, choices)
        price = arrivals.unsqueeze(-1) * self.sensors.prices[rows].unsqueeze(1)

        def of_sensors(gain: Tensor) -> Tensor:
            on = self.actor_loss.acting(logits.detach()) if self.sensors.shared else logits
            return self.sensors.gains(gain, on, rows)

        credit = SensorCredit(
            entry, replayed.gain[:, chosen], arrivals, price, rows, of_sensors, width
        )
        return self.actor_loss(logits, credit).sum((0, 2))

    def _weights(self, which: int, count: Tensor, gain: Tensor) -> Tensor:
        """`[T+1]`: each clock by its own number of rows and its running mean gain, so that rare clocks count."""
        # Few paths are missed twice, and late gains differ in size: each clock's loss is scaled to order 1.
        self.gain_scale[which].lerp_(gain / count.clamp(min=1), _GAIN_SCALE_RATE)
        return 1.0 / (count.clamp(min=_FEWEST_ROWS) * self.gain_scale[which].clamp(min=_LEAST_GAIN))


class ClockedLoss:
    """Losses of the clocked actor and critic: the position is revealed after every action, so single moves are enough.

    These are counted by their two ends.

    Args:
        task: its keys, and its window.
        sensors: of the cells that one move may lead to.
        actor: the clocked actor.
        credit: its discount, and the safe action.
        reach: rows and columns that the target moves in one step, at most.
    """

    def __init__(
        self,
        task: Task,
        sensors: SensorsInView,
        actor: CellClockNet,
        credit: Credit,
        reach: int,
    ) -> None:
        self._keys, self._sensors, self._actor, near = task.keys, sensors, actor, sensors.window
        self._near, self._credit, self._safe = near, credit, task.safe
        # [M, C], the cells that are near each located one.
        self._near_cells = near.cells.repeat_interleave(task.keys.num_classes, dim=0)
        # [M, C] bool, which of the sensors there the task's window lets choose; None: all.
        self._allowed: Tensor | None = None
        if task.numbered is not None and task.numbered < reach:
            start = torch.arange(task.num_keys, device=near.cells.device).unsqueeze(1)
            start = task.keys.cell(start).expand_as(self._near_cells)
            self._allowed = Window.of(task, start.device).contains(start, self._near_cells)

    def first_gains(self, end: Tensor, advantage: Tensor) -> tuple[Tensor, Tensor]:
        """How many paths stay in the grid for a move, and the sum of the gains of sensing there, `[T+1]`."""
        # The gain depends on the end y and the clock alone, so moves are counted by y: [T + 1, M] @ [M].
        arrived = torch.bincount(end, minlength=advantage.shape[1])[:-1].float()
        return arrived.sum(), self._credit.gain(advantage[:, :-1]).abs() @ arrived

    def of(
        self, moves: Tensor, rows: slice, advantage: Tensor, known: Tensor
    ) -> tuple[Tensor, Tensor]:
        """From the moves `[2, B]` out of the cells `rows`, at every clock: the position is revealed after every action.

        Returns:
            The clocked actor's losses summed per clock, `[T+1]`, and the clocked critic's targets `[rows, T+2]`.
        """
        nearby, logits = self._near_cells[rows], self._actor(rows)
        k, h = nearby.shape[1], self._keys.modes
        ends = self._ends(nearby, rows)
        moved, visits = self._counted(moves, rows, len(nearby))
        stays = moved.sum(-1)
        # advantage[:, ends] is [T + 1, x, C H]: transposed to the layout [x, T + 1, C H].
        gain = moved * self._credit.gain(advantage[:, ends].transpose(0, 1))
        # All moves to a key have the same gain, so its sign makes it a part of its cell's G⁺ or G⁻.
        plus, minus = (
            part.unflatten(-1, (k, h)).sum(-1)
            for part in (gain.clamp(min=0), gain.clamp(max=0).neg())
        )
        chosen, cost = logits.detach() > 0, self._sensors.prices[rows].unsqueeze(1)
        if self._allowed is not None:
            # Sensors outside the window cannot be chosen: they neither gain nor cost, nor are they learned about.
            allowed = self._allowed[rows].unsqueeze(1)
            chosen, cost = chosen & allowed, cost * allowed
            plus, minus = plus * allowed, minus * allowed
        # Each sensor on adds its gain, which turns gamma U(j, n + 1) into r + gamma U(j, 0), and takes its cost away.
        found = ((plus - minus) * self._sensors.reports(chosen, rows)).sum(-1)
        sensed = found, stays * (chosen * cost).sum(-1)
        target = self._returns(moved, known[ends], ends, sensed) / visits.clamp(min=1)
        # The price is c for every move that stays in the grid.
        plus, minus = (self._sensors.gains(each, chosen, rows) for each in (plus, minus))
        loss = decision_loss(logits, plus, minus, stays.unsqueeze(-1) * cost)
        return loss.sum((0, 2)), target

    def _ends(self, cells: Tensor, rows: slice) -> Tensor:
        """`[x, C H]`, the keys after moves from the keys `rows` to `cells` `[x, C]`, in H modes; M outside."""
        keys, device = self._keys, cells.device
        start = torch.arange(keys.num_keys, device=device)[rows, None, None]
        modes = torch.arange(keys.modes, device=device)
        ends: Tensor = keys.next(start, 0, cells.unsqueeze(-1), modes)
        return ends.flatten(1).clamp_max(keys.num_keys)

    def _counted(self, moves: Tensor, rows: slice, count: int) -> tuple[Tensor, Tensor]:
        """`[x, 1, C H]`, the moves from each of `count` keys by their end, and `[x, 1]` all, exits included.

        Their quotient is the empirical kernel P_xj.
        """
        k, h, m = self._near.width, self._keys.modes, self._keys.num_keys
        (start, end), first = moves, rows.start
        near = self._near.index(self._keys.cell(start), self._keys.cell(end))
        # Flat place in [rows, C H] of a move: with C = 9, H = 1, from cell 7 to its local cell 5 is 7 * 9 + 5 = 68;
        # where the slice begins at cell 4, 68 - 36 = 32. Exits have weight 0, wherever `index` puts them.
        place = (start * k + near - first * k) * h + end % h
        moved = scatter_add((end < m).float(), place, count * k * h).view(count, 1, k * h)
        return moved, torch.bincount(start - first, minlength=count).unsqueeze(-1)

    def _returns(
        self, moved: Tensor, known: Tensor, ends: Tensor, sensed: tuple[Tensor, Tensor]
    ) -> Tensor:
        """`[x, T+2]`, sums over the moves from x of r, gamma U and prices; `sensed`: gains and prices, `[x, T+1]`.

        U(x, n) = sum_j P_xj gamma U(j, n + 1), if nothing is sensed. At n = T + 1 all are located: r - D + gamma U(j,
        0).
        """
        # [x, 1, C H] @ [x, C H, T + 2]: gamma sum_j moved_j U(j, n), for all n by one product.
        credit, stays = self._credit, moved.sum(-1)
        following = credit.discount * torch.bmm(moved, known).squeeze(1)
        if self._safe:
            forced = following[:, :1] + (1.0 - credit.safe_cost) * stays
        else:  # a missed target goes on at n = T + 1
            located = moved.squeeze(1) * credit.safe_detection[ends]
            after = located * (1.0 + credit.discount * known[..., 0])
            missed = (moved.squeeze(1) - located) * credit.discount * known[..., -1]
            forced = (after + missed).sum(-1, keepdim=True) - credit.safe_cost * stays
        found, spent = sensed
        return torch.cat([following[:, 1:] + found - spent, forced], dim=1)


def _in_view(task: Task, radius: int, device: torch.device) -> Window:
    """The sensors that are of use from a located cell until the safe action: in reach, and in the task's window."""
    if task.numbered is None:
        return Window.reaching(task, radius, device)
    return Window(task, min(radius, task.numbered), device)


def _squared_error(values: Tensor, start: Tensor, targets: Tensor) -> Tensor:
    """Of the values `[M, n]` of the keys that the paths start in, to the mean returns of these paths."""
    # The squared error per cell times its number of paths is, up to a constant, the sum over paths of (V - return)^2.
    visits = torch.bincount(start, minlength=len(values))
    # No path is left where all end before the policy locates a target.
    return (visits.unsqueeze(-1) * (values - targets).square()).sum() / max(len(start), 1)
