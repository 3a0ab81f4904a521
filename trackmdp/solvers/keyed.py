"""Policies that remember a key, against targets with a hidden mode: exact values, and improvements of plans.

At a detection the pair (key, hidden state) is a Markov chain, whatever the key forgets: V = (I - K)^-1 b over all
pairs, where b is what the key's plan earns until the next detection and K where that is (theory-extensions, section
0). A plan belongs to a key, so that it is improved against the modes as the policy's own visits distribute them. An
improvement may be a loss for some of the modes: it is kept only if the exact value rises.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.machine import free_bytes, gib
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.layers import Layer, reachable
from trackmdp.solvers.renewal import IndexArray, RenewalSystem, check_length, per_row
from trackmdp.world.model import Array, BoolArray, World
from trackmdp.world.modes import HiddenWorld

_DIRECT = 1_000
"""Pairs up to which systems are factorised: each leads to all cells in reach, so that the factors soon fill up."""


class KeyedPairs:
    """Where the target may be 1 ... t_max + 2 moves after each pair (key, mode): B pairs, numbered key · H + mode.

    Where a detection tells the mode the key is (cell, mode), the hidden state itself, and B the number of keys.

    Entries are as in `layers`, with a row for each pair and hidden states for cells; layer t_max + 2 is the forced
    step's. Plans are of keys and sensors of cells, so that entries with one key and one cell are decided together: they
    are a group.
    """

    def __init__(self, world: HiddenWorld) -> None:
        if (needed := world.pair_bytes) > (free := free_bytes()):
            raise UserError(f"task.memory={world.memory}: needs about {gib(needed)}, {gib(free)} are available")
        self.world, keys, h = world, world.keys, world.modes
        of_key = 1 if world.revealed > 1 else h  # pairs of each key
        self.key = np.repeat(np.arange(keys.num_keys), of_key)
        self.count = len(self.key)
        known = self.key % h if of_key == 1 else np.tile(np.arange(h), keys.num_keys)
        self.state = keys.cell(self.key) * h + known  # the hidden state of each pair
        layers = reachable(world.kernel, self.state, world.num_choices + 1)
        self.layers: list[Layer] = layers[1:]
        self.stay = [world.stay_probability[layer.cells] for layer in layers]
        self.rows = [layer.rows for layer in layers]
        self.cells, self.following = [], []
        for n, layer in enumerate(self.layers):
            self.cells.append(layer.cells // h)
            self.following.append(self.after(self.key[layer.rows], n, layer.cells))
        codes = [self.key[layer.rows] * world.num_cells + cell for layer, cell in zip(self.layers, self.cells)]  # noqa: B905
        self.groups, self.group = zip(*(np.unique(code, return_inverse=True) for code in codes[:-1]), strict=True)
        modes, cells = np.arange(h), np.arange(world.num_cells)[:, None]
        # [M, H], the pairs in which episodes start: any cell and mode alike
        self.first = keys.start(cells, modes) if of_key == 1 else keys.start(cells) * h + modes
        self.start = np.zeros(self.count)
        self.start[self.first.ravel()] = 1.0 / world.num_states

    def after(self, key: IndexArray, misses: int, state: IndexArray) -> IndexArray:
        """`[E]` pairs after a detection of `state` `[E]`, `misses` after the one that left `key` `[E]`."""
        h, told = self.world.modes, self.world.revealed > 1
        following: IndexArray = self.world.keys.next(key, misses, state // h, state % h)
        return following if told else following * h + state % h

    @cached_property
    def chance(self) -> list[Array]:
        """Per layer `[E]`, p_d of the entry's sensor."""
        return [self.world.detection[cell] for cell in self.cells]

    def run(self, seen: list[Array], spent: list[Array], sensors: list[Array]) -> tuple[sparse.csr_array, Array]:
        """K `[B, B]`, and `[B, 6]` what happens until the next detection: reward, steps in the grid, detections, ...

        Args:
            seen: per free choice `[E]`, probability that the target is reported there.
            spent: per free choice `[B]`, price of the set.
            sensors: per free choice `[B]`, sensors in it.
        """
        world, b, mass = self.world, self.count, np.ones(self.count)
        gathered, hits = np.zeros((b, 6)), []
        for n, layer in enumerate(self.layers):
            forced = n == world.num_choices
            gathered[:, 5] += per_row(self.rows[n], mass, b)
            mass = mass @ layer.moves
            inside = per_row(layer.rows, mass, b)
            found = mass if forced else mass * seen[n]
            located = per_row(layer.rows, found, b)
            price = world.safe_cost if forced else spent[n]
            gathered[:, 0] += world.reward * located - price * inside
            gathered[:, 1] += inside
            gathered[:, 2] += located
            gathered[:, 4 if forced else 3] += inside if forced else sensors[n] * inside
            hits.append((found, layer.rows, self.following[n]))
            mass = mass - found
        data, rows, columns = (np.concatenate(part) for part in zip(*hits, strict=True))
        return sparse.csr_array((data, (rows, columns)), shape=(b, b)), gathered

    def of_policy(self, policy: PolicyTable) -> tuple[list[Array], list[Array], list[Array]]:
        """A policy as arguments of `run`."""
        free, one = range(self.world.num_choices), np.ones(self.world.num_cells)
        key = [self.key[layer.rows] for layer in self.layers]
        seen = [policy.on(n, key[n], self.cells[n]) * self.chance[n] for n in free]
        spent, sensors = ([policy.spent(n, each)[self.key] for n in free] for each in (self.world.cost, one))
        return seen, spent, sensors

    def value(self, sets: list[BoolArray]) -> tuple[Array, Array, float]:
        """`[B]` V, `[B]` visits of an episode, and the AIHTR."""
        located, gathered = self.run(*self.of_policy(self.table(sets)))
        value = _solved(located, gathered[:, 0])[0]
        # Begun after some detections: no key is come by a second time where it stands for an episode's start, so that
        # all that is left of the start at first would be orthogonal to what follows, and BiCGSTAB would break down.
        into, guess = sparse.csr_array(located.T), self.start
        for _ in range(4):
            guess = self.start + into @ guess
        visits = _solved(into, self.start, guess)[0]
        return value, visits, float(self.start @ value)

    def improved(
        self, sets: list[BoolArray], value: Array, visits: Array, bound: Array, optimism: float
    ) -> list[BoolArray]:
        """Of every step the best set given the others, forward and backward, as in `search`.

        Args:
            sets: now.
            value: `[B]`.
            visits: `[B]`, which weigh the modes of a key; a key that is never visited takes them for equally likely.
            bound: `[M · H, t_max + 2]`, whose credit counts with `optimism` against the exact one.
            optimism: 0 ... 1.
        """
        world, later, chosen = self.world, self._undetected(sets, value), []
        total = per_row(self.key, visits, world.num_keys)[self.key]
        mass = np.where(total > 1e-12, visits / np.maximum(total, 1e-300), world.num_keys / self.count)
        for n in range(world.num_choices):
            layer, z = self.layers[n], self.layers[n].cells
            mass = mass @ layer.moves
            gain = world.reward + value[self.following[n]] - later[n]
            gain = (1.0 - optimism) * gain + optimism * (world.reward + bound[z, 0] - bound[z, n + 1])
            key, cell = np.divmod(self.groups[n], world.num_cells)
            inside = per_row(self.key[layer.rows], mass, world.num_keys)
            gains = per_row(self.group[n], mass * gain * self.chance[n], len(cell))
            on = gains > world.cost[cell] * inside[key]
            chosen.append(on)
            mass = mass * (1.0 - on[self.group[n]] * self.chance[n])
        return chosen

    def _undetected(self, sets: list[BoolArray], value: Array) -> list[Array]:
        """Per free choice `[E]` W: what follows when the target is there, undetected, and `sets` go on."""
        world, (seen, spent, _) = self.world, self.of_policy(self.table(sets))
        last = world.num_choices
        worth = world.reward + value[self.following[last]]
        later = [self.layers[last].moves @ worth - world.safe_cost * self.stay[last]]
        for n in range(last - 1, 0, -1):
            worth = seen[n] * (world.reward + value[self.following[n]]) + (1.0 - seen[n]) * later[0]
            later.insert(0, self.layers[n].moves @ worth - spent[n][self.rows[n]] * self.stay[n])
        return later

    def sets(self, policy: PolicyTable) -> list[BoolArray]:
        """A deterministic policy as a bool for each group, per step."""
        of_groups = (np.divmod(groups, self.world.num_cells) for groups in self.groups)
        return [policy.on(n, key, cell) > 0 for n, (key, cell) in enumerate(of_groups)]

    def table(self, sets: list[BoolArray]) -> PolicyTable:
        """The policy of sets."""
        on_groups = (groups[on] for on, groups in zip(sets, self.groups, strict=True))
        return PolicyTable.from_sensed(self.world, [np.divmod(each, self.world.num_cells) for each in on_groups])


def evaluate_keys(world: HiddenWorld, policy: PolicyTable) -> Evaluation:
    """Exact figures of a policy, whatever it remembers; episodes start in any cell and mode alike."""
    remembered = {name: getattr(policy.task, name) for name in ("memory", "clip", "revealed")}
    pairs = KeyedPairs(world.but(**remembered))
    located, gathered = pairs.run(*pairs.of_policy(policy))
    totals, left = _solved(located, gathered)
    check_length(totals[:, 5])
    # The value of a start cell is the mean over its modes.
    of_cell = totals[pairs.first].mean(axis=1)
    # |V - V̂| <= (steps of an episode) · max |residual|, as an episode has no more renewals than steps.
    return pooled(of_cell.T, left * float(totals[:, 5].max()))


def visits_of_keys(problem: World | HiddenWorld, policy: PolicyTable) -> Array:
    """`[keys]`, how often an episode's start or a detection leaves each key of a deterministic policy, expected."""
    hidden = problem if isinstance(problem, HiddenWorld) else HiddenWorld(problem.kernel, modes=1, **problem.given)
    pairs = KeyedPairs(hidden.but(**{name: getattr(policy.task, name) for name in ("memory", "clip", "revealed")}))
    visits = pairs.value(pairs.sets(policy))[1]
    return per_row(pairs.key, visits, pairs.world.num_keys)


def _solved(transition: sparse.csr_array, gathered: Array, guess: Array | None = None) -> tuple[Array, float]:
    """The solution of v = gathered + transition v, and its largest residual, 0 where it was factorised."""
    system = RenewalSystem(transition, direct=_DIRECT)
    found = system.solve(gathered, guess)
    if system.exact:
        return found, 0.0
    left = float(np.abs(system.residual(gathered, found)).max())
    if left <= 1e-10 * max(1.0, float(np.abs(found).max())):
        return found, left
    return RenewalSystem(transition, direct=len(found)).solve(gathered), 0.0


def averaged(world: HiddenWorld) -> World:
    """The target as it looks to who knows of no mode: each cell's moves, averaged over its modes as they occur.

    Sensing does not move the target, so that the expected visits (I - Q^T)^-1 s of an episode are those of any policy.
    """
    visits = RenewalSystem(sparse.csr_array(world.kernel.T)).solve(np.full(world.num_states, 1.0 / world.num_states))
    of_cell = visits.reshape(world.num_cells, world.modes)
    share = (of_cell / of_cell.sum(axis=1, keepdims=True)).ravel()  # episodes start anywhere: no cell is unvisited
    state = np.arange(world.num_states)
    into = sparse.csr_array((np.ones(len(state)), (state, state // world.modes)))
    out = sparse.csr_array((share, (state // world.modes, state)))
    return World.of(world, out @ world.kernel @ into, memory="cell", revealed=1)
