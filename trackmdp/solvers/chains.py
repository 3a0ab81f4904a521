"""A deterministic policy as one open-loop chain of sets per located cell, and its exact value.

After a miss the next state is known in advance, so a policy is, for each located cell x, the sets it would sense at
n = 0 ... t_max misses: ``chains[x, n, j]``, an array `[M, t_max + 1, M]`. Between 0 and 1, the entries are the
probabilities of switching the sensors on, independently of each other and of the history.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.solvers.renewal import IndexArray, accumulate, expected_steps, row_index, row_sums
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["Evaluation", "Prediction", "evaluate", "regret_per_step", "unroll"]


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
    chains = _check(world, chains)
    located = sparse.csr_array((world.num_cells, world.num_cells))
    mass = sparse.eye_array(world.num_cells, format="csr")
    reward, steps, detections, sensors, safe = gathered = np.zeros((5, world.num_cells))
    for n in range(world.num_choices):
        predicted = mass @ world.transition
        inside = row_sums(predicted)
        on = chains[:, n]
        sensed = on[row_index(predicted), predicted.indices]
        hit = _with_data(predicted, predicted.data * sensed)
        located = located + hit
        detections += row_sums(hit)
        sensors += on.sum(axis=1) * inside
        reward += world.reward * row_sums(hit) - (on @ world.cost) * inside
        steps += inside
        mass = _with_data(predicted, predicted.data * (1.0 - sensed))
    forced = mass @ world.transition
    safe += row_sums(forced)
    steps += safe
    detections += safe
    reward += (world.reward - world.safe_cost) * safe
    return _pool(world, accumulate(located + forced, gathered.T))


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
        predicted = mass @ world.transition
        rows = row_index(predicted)
        sensed = rule(Prediction(n, rows, predicted.indices, predicted.data, row_sums(mass), row_sums(predicted)))
        chains[rows, n, predicted.indices] = sensed
        mass = _with_data(predicted, predicted.data * ~sensed)
    return chains


def _check(world: World, chains: npt.NDArray[np.generic]) -> Array:
    expected = (world.num_cells, world.num_choices, world.num_cells)
    if chains.shape != expected:
        raise UserError(f"chains: expected shape {expected} (M, t_max + 1, M), got {chains.shape}")
    numbers = np.asarray(chains, dtype=np.float64)
    if not ((numbers >= 0) & (numbers <= 1)).all():
        raise UserError("chains: expected probabilities between 0 and 1")
    return numbers


def _with_data(matrix: sparse.csr_array, data: Array) -> sparse.csr_array:
    """`matrix` with other entries, those of zero dropped."""
    changed = sparse.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape, copy=True)
    changed.eliminate_zeros()
    return changed


def _pool(world: World, totals: Array) -> Evaluation:
    """`totals`: `[M, 5]` reward, steps in the grid, detections, sensors, safe actions per episode."""
    value, steps, detections, sensors, safe = totals.T
    in_grid = float(steps.mean())
    return Evaluation(
        aihtr=float(value.mean()),
        value=value,
        accuracy=float(detections.mean()) / in_grid if in_grid else 1.0,
        sensors_per_step=float(sensors.mean()) / in_grid if in_grid else 0.0,
        safe_per_episode=float(safe.mean()),
        expected_length=float(expected_steps(world).mean()),
        steps=steps,
        detections=detections,
        sensors=sensors,
        safe_actions=safe,
    )
