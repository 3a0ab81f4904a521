"""The exact value of a policy that believes its reports where sensors also report targets that are not there.

Detections are no renewals then: what is believed after a report may be wrong. But what the policy does depends on the
cell it believes in alone, so pairs (believed cell, true cell) at reports are a Markov chain, and its value V(b, z)
solves a linear system as V(x) does without false alarms. The safe action confirms: it leads to pairs (z, z).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.prediction import followed
from trackmdp.solvers.renewal import IndexArray, RenewalSystem, per_row, row_index
from trackmdp.world.model import World
from trackmdp.world.tracks import Problem

_MOST_CELLS = 144
"""Of a grid with false alarms: M² pairs are unknown."""
_DIRECT = 2_000  # pairs; those of four coordinates fill the factors of a larger system (N = 12: 90 s in place of 5)


def believed(world: Problem, policy: PolicyTable, false_alarm: float) -> Evaluation:
    """What `policy` earns if each report is taken for the truth; r is earned where it is true.

    Of several reports the one is believed whose cell was the likeliest, given the misses since the last one.

    Args:
        world: the problem; `detection` is p_d.
        policy: deterministic.
        false_alarm: p_f, with which a sensor that is on reports the target in a step in which it is not there.

    Raises:
        UserError: there is no motion model, p_f is no probability below 1, the grid has more than 144 cells, episodes
            are truncated, the safe action may miss, or the policy draws its sets.
    """
    world = check_alarms(world, false_alarm)
    if not policy.deterministic:
        raise UserError(f"false_alarm={false_alarm}: expected a policy that does not draw its sets")
    m = world.num_cells
    believes = np.repeat(np.arange(m), m)
    # [M², M]: row b M + z is the pair at the last report, column y where the target is, nothing reported since.
    silent = sparse.csr_array(sparse.vstack([sparse.eye_array(m, format="csr")] * m))
    onward, gathered = sparse.csr_array((m * m, m * m)), np.zeros((m * m, 6))
    for n, ranked in enumerate(_ranked(world, policy)):
        before, moved = silent.sum(axis=1), sparse.csr_array(silent @ world.kernel)
        reports, silent = _reports(world, moved, believes, ranked, false_alarm)
        onward = onward + reports
        # True reports lead to pairs (y, y), whose numbers are multiples of M + 1.
        true = reports.data * (reports.indices % (m + 1) == 0)
        inside, right = moved.sum(axis=1), per_row(row_index(reports), true, m * m)
        reward = world.reward * right - policy.spent(n, world.cost)[believes] * inside
        sensors = policy.spent(n, np.ones(m))[believes] * inside
        gathered += np.stack([reward, inside, right, sensors, np.zeros(m * m), before], axis=1)
    before, moved = silent.sum(axis=1), sparse.csr_array(silent @ world.kernel)
    inside, nothing = moved.sum(axis=1), np.zeros(m * m)
    # located in y, and believed to be there: the pair y M + y
    confirmed = sparse.csr_array((moved.data, moved.indices * (m + 1), moved.indptr), shape=onward.shape)
    reward = (world.reward - world.safe_cost) * inside
    gathered += np.stack([reward, inside, inside, nothing, inside, before], axis=1)
    system = RenewalSystem(onward + confirmed, world.size, direct=_DIRECT)
    totals = system.solve(gathered)
    # As in `evaluate`: no more reports than steps, which the longest episode bounds.
    error = 0.0 if system.exact else float(np.abs(system.residual(gathered, totals)).max() * totals[:, 5].max())
    return pooled(totals[:: m + 1].T, error)  # episodes begin in pairs (z, z)


def check_alarms(world: Problem, false_alarm: float) -> World:
    """Return `world` if policies can be valued in it with false alarms.

    Raises:
        UserError: see `believed`.
    """
    if not isinstance(world, World):
        raise UserError(f"false_alarm={false_alarm}: needs a motion model; recorded tracks have none")
    if not 0.0 <= false_alarm < 1.0:
        raise UserError(f"false_alarm={false_alarm}: expected a probability below 1")
    if world.num_cells > _MOST_CELLS:
        raise UserError(f"false_alarm={false_alarm}: {world.num_cells} cells, expected at most {_MOST_CELLS}")
    if world.max_steps is not None or not world.safe:
        raise UserError(f"false_alarm={false_alarm}: expected whole episodes, and a safe action that always locates")
    if world.coverage is not None:
        raise UserError(f"false_alarm={false_alarm}: expected sensors that each cover one cell")
    return world


def _ranked(world: World, policy: PolicyTable) -> Iterator[tuple[IndexArray, IndexArray]]:
    """For each n the sets as (row pointer `[M + 1]`, cells), in each row the likeliest cell first."""
    m = world.num_cells
    rows, cells = np.divmod(np.arange(m * m), m)
    for seen in followed(world, policy):
        on = policy.on(seen.n, rows, cells) > 0
        mass = np.zeros((m, m))
        mass[seen.rows, seen.cells] = seen.mass
        entry = np.flatnonzero(on)
        order = entry[np.lexsort((cells[entry], -mass.ravel()[entry], rows[entry]))]
        pointer = np.concatenate([[0], np.cumsum(np.bincount(rows[entry], minlength=m))])
        yield pointer, cells[order]


def _reports(
    world: World,
    moved: sparse.csr_array,
    believes: IndexArray,
    ranked: tuple[IndexArray, IndexArray],
    false_alarm: float,
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """From `[M², M]` where the target has moved: `[M², M²]` the pair after the first report, `[M², M]` without one.

    Three sensors a b c in this order, the target in b: a is believed with p_f, b with (1 - p_f) p_d, c with
    (1 - p_f)(1 - p_d) p_f; nothing is reported with (1 - p_f)² (1 - p_d).
    """
    m, (pointer, cells) = world.num_cells, ranked
    pair = row_index(moved)
    count = np.diff(pointer)[believes[pair]]
    # Each entry (pair, y) of `moved` once for every sensor that is on: with counts 2 0 1, entries 0 0 2 and places
    # 0 1 0 in their sets.
    entry = np.repeat(np.arange(len(pair)), count)
    place = np.arange(len(entry)) - np.repeat(np.cumsum(count) - count, count)
    cell, target = cells[pointer[believes[pair[entry]]] + place], moved.indices[entry]
    # The place of the target's own sensor in the set, beyond its end where that is off.
    own = np.full(len(pair), np.iinfo(np.int64).max)
    own[entry[cell == target]] = place[cell == target]
    missed = 1.0 - world.detection[target]
    quiet = (1.0 - false_alarm) ** (place - (own[entry] < place)) * np.where(own[entry] < place, missed, 1.0)
    first = quiet * np.where(cell == target, world.detection[target], false_alarm)
    after = sparse.csr_array((moved.data[entry] * first, (pair[entry], cell * m + target)), shape=(m * m, m * m))
    seen = own < count
    none = (1.0 - false_alarm) ** (count - seen) * np.where(seen, 1.0 - world.detection[moved.indices], 1.0)
    # A copy: dropping its zeros in place would reorder the indices of `moved`.
    silent = sparse.csr_array((moved.data * none, moved.indices, moved.indptr), shape=moved.shape, copy=True)
    silent.eliminate_zeros()
    after.eliminate_zeros()
    return after, silent
