"""A deterministic policy as one open-loop chain of sets per located cell, and its exact value.

After a miss the next state is known in advance, so a policy is, for each located cell x, the sets it would sense at
n = 0 ... t_max misses: ``chains[x, n, j]``, an array `[M, t_max + 1, M]`. Between 0 and 1, the entries are the
probabilities of switching the sensors on, independently of each other and of the history.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.solvers.renewal import IndexArray, accumulate, expected_steps, row_index, row_sums
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["Evaluation", "Prediction", "evaluate", "pool", "regret_per_step", "sets_of", "renewal", "unroll"]


@dataclass(frozen=True)
class Evaluation:
    """What a policy earns, exactly; single figures are pooled over a uniform start.

    Attributes:
        aihtr: mean of `value` (paper, Section VII-A).
        value: `[M]`, V(x, 0, ∅), the expected reward of an episode that starts located in x.
        accuracy: detections per step in the grid, forced ones included (y_0 and the exit step do not count).
        sensors_per_step: sensors switched on by free choice per step in the grid; the safe action counts as none.
        safe_per_episode: forced safe actions per episode.
        expected_length: steps per episode, the exit step included.
        steps, detections, sensors, safe_actions: `[M]`, per episode from each start cell; `steps` in the grid.
    """

    aihtr: float
    value: Array
    accuracy: float
    sensors_per_step: float
    safe_per_episode: float
    expected_length: float
    steps: Array
    detections: Array
    sensors: Array
    safe_actions: Array


@dataclass(frozen=True)
class Prediction:
    """Where the target may be next, for all located cells at once, after n misses; entries of positive mass only.

    Attributes:
        n: misses so far.
        rows, cells: `[E]`, located cell and possible next cell of each entry.
        mass: `[E]`, joint probability of the misses so far and the target moving to `cells`.
        before: `[M]`, probability of the n misses.
        inside: `[M]`, probability of the misses and of still being in the grid after the move.
    """

    n: int
    rows: IndexArray
    cells: IndexArray
    mass: Array
    before: Array
    inside: Array


def evaluate(world: World, chains: npt.NDArray[np.generic]) -> Evaluation:
    """The exact value of the policy that follows `chains` (`[M, t_max + 1, M]`, bool or probabilities)."""
    located, gathered = sparse.csr_array((world.num_cells, world.num_cells)), np.zeros((world.num_cells, 5))
    for hit, earned in renewal(world, chains):
        located, gathered = located + hit, gathered + earned
    return pool(accumulate(located, gathered), expected_steps(world))


def renewal(world: World, chains: npt.NDArray[np.generic]) -> Iterator[tuple[sparse.csr_array, Array]]:
    """What happens at each step from one detection to the next, for all located cells at once.

    Yields:
        t_max + 2 pairs, the last of the forced step: `[M, M]` sparse, the probability of being located in j at this
        step, and `[M, 5]`, expected reward, step in the grid, detection, sensors on by choice, safe action.
    """
    chains = _check(world, chains)
    mass = sparse.eye_array(world.num_cells, format="csr")
    nothing = np.zeros(world.num_cells)
    for n in range(world.num_choices):
        predicted = mass @ world.kernel
        inside = row_sums(predicted)
        on = chains[:, n]
        sensed = on[row_index(predicted), predicted.indices]
        hit = _with_data(predicted, predicted.data * sensed)
        detected = row_sums(hit)
        reward = world.reward * detected - (on @ world.cost) * inside
        yield hit, np.stack([reward, inside, detected, on.sum(axis=1) * inside, nothing], axis=1)
        mass = _with_data(predicted, predicted.data * (1.0 - sensed))
    forced = mass @ world.kernel
    inside = row_sums(forced)
    yield forced, np.stack([(world.reward - world.safe_cost) * inside, inside, inside, nothing, inside], axis=1)


def regret_per_step(upper_aihtr: float, evaluation: Evaluation) -> float:
    """How far a policy is from `upper_aihtr`, per step of its episodes."""
    return (upper_aihtr - evaluation.aihtr) / evaluation.expected_length


def unroll(world: World, rule: Callable[[Prediction], BoolArray]) -> BoolArray:
    """The chains of a policy that decides from the prediction: `rule` returns `[E]`, which entries to sense.

    Cells of probability zero are never sensed, and after a miss that cannot happen nothing is.
    """
    chains = np.zeros((world.num_cells, world.num_choices, world.num_cells), dtype=bool)
    mass = sparse.eye_array(world.num_cells, format="csr")
    for n in range(world.num_choices):
        predicted = mass @ world.kernel
        rows = row_index(predicted)
        sensed = rule(Prediction(n, rows, predicted.indices, predicted.data, row_sums(mass), row_sums(predicted)))
        chains[rows, n, predicted.indices] = sensed
        mass = _with_data(predicted, predicted.data * ~sensed)
    return chains


def sets_of(chains: BoolArray) -> dict[str, Any]:
    """Plain lists, to be written: for each located cell the sensed cells at n = 0 ... t_max."""
    return {
        "t_max": chains.shape[1] - 1,
        "sets": {str(cell): [np.flatnonzero(on).tolist() for on in chain] for cell, chain in enumerate(chains)},
    }


def _check(world: World, chains: npt.NDArray[np.generic]) -> Array | BoolArray:
    expected = (world.num_cells, world.num_choices, world.num_cells)
    if chains.shape != expected:
        raise UserError(f"chains: expected shape {expected} (M, t_max + 1, M), got {chains.shape}")
    if chains.dtype == np.bool_:  # no copy as numbers, which would take eight times the memory
        return chains.astype(np.bool_, copy=False)
    numbers = np.asarray(chains, dtype=np.float64)
    if not ((numbers >= 0) & (numbers <= 1)).all():
        raise UserError("chains: expected probabilities between 0 and 1")
    return numbers


def _with_data(matrix: sparse.csr_array, data: Array) -> sparse.csr_array:
    """`matrix` with other entries, those of zero dropped."""
    changed = sparse.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape, copy=True)
    changed.eliminate_zeros()
    return changed


def pool(totals: Array, length: Array) -> Evaluation:
    """An evaluation from `[M, 5]` reward, steps in the grid, detections, sensors, safe actions per episode.

    `length` `[M]` is the expected number of steps of an episode, the exit step included.
    """
    value, steps, detections, sensors, safe = totals.T
    in_grid = float(steps.mean())
    return Evaluation(
        aihtr=float(value.mean()),
        value=value,
        accuracy=float(detections.mean()) / in_grid if in_grid else 1.0,
        sensors_per_step=float(sensors.mean()) / in_grid if in_grid else 0.0,
        safe_per_episode=float(safe.mean()),
        expected_length=float(length.mean()),
        steps=steps,
        detections=detections,
        sensors=sensors,
        safe_actions=safe,
    )
