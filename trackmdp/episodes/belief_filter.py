"""The POMDP's exact belief filter (paper, eq. belief_up, with the indices of the process as it runs).

The belief along episodes is computed after the simulation, for displays and logs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.episodes.episode import Episode, Floats
from trackmdp.world.coverage import reported
from trackmdp.world.model import Task, World


class BeliefFilter:
    """Belief over the cells of a target known to be in the grid: `[B, M]` float64 rows that sum to 1.

    One step is `predict`, then `detect` or `miss`. All methods are pure.
    """

    def __init__(self, kernel: sparse.csr_array) -> None:
        self.num_cells: int = kernel.shape[0]
        self._into = kernel.T.tocsr()  # entry (y, x): from x into y

    def detect(self, cell: Tensor) -> Tensor:
        """Certainty after a detection in `cell` `[B]`."""
        return torch.nn.functional.one_hot(cell, self.num_cells).double()

    def predict(self, belief: Tensor) -> Tensor:
        """`[B, M]` predicted probability of each cell after one move; a row sums to the probability of no exit."""
        return summed(self._into, belief)

    def miss(self, predicted: Tensor, action: Tensor) -> Tensor:
        """Condition `predicted` `[B, M]` on no detection under `action` `[B, M]` and no exit.

        `action` is bool, or the probability of a report from each cell: p_d where a sensor is on that may miss.
        Where that event has probability zero the prediction itself is returned, normalised over the grid: the
        observation cannot have happened, and the belief stays finite.
        """
        # Bayes with a perfect sensor: a miss has likelihood 0 where a sensor is on and 1 elsewhere.
        unseen = predicted * (~action if action.dtype == torch.bool else 1.0 - action)
        mass = unseen.sum(-1, keepdim=True)
        grid = predicted / predicted.sum(-1, keepdim=True).clamp_min(
            torch.finfo(predicted.dtype).tiny
        )
        # `where` evaluates both sides; the clamps keep 0 / 0 out of the one that is not taken.
        return torch.where(
            mass > 0, unseen / mass.clamp_min(torch.finfo(predicted.dtype).tiny), grid
        )


def summed(into: sparse.csr_array, belief: Tensor) -> Tensor:
    """`into` `[Y, X]` times each row of `belief` `[B, X]`, with sums in an order that does not depend on B.

    A product of dense matrices may add up in another order for one row than for many, which would make an episode
    differ in the last bit when it is simulated again alone; a sparse one adds up each result entry by entry.
    """
    return torch.from_numpy(np.ascontiguousarray((into @ np.ascontiguousarray(belief.numpy().T)).T))


def beliefs(world: World, episodes: Sequence[Episode]) -> list[Floats]:
    """For each episode `[T, M]`, the probability of each cell after a step's move, given the observations before it.

    A row sums to the probability of no exit. Each is the same to the bit for any other episodes. Targets with a mode
    are followed as (cell, mode), also through detections that do not reveal it.
    """
    exact = BeliefFilter(world.kernel)
    modes = world.modes
    cell = torch.arange(exact.num_cells) // modes  # of each hidden state
    cells = sparse.csr_array((np.ones(len(cell)), (cell.numpy(), np.arange(len(cell)))))
    told = world.tells_all
    lengths = torch.tensor([len(episode) for episode in episodes])
    first = lengths.cumsum(0) - lengths
    chance = _reports(world)
    action = _stacked(episode.action for episode in episodes)
    misses = _stacked(episode.misses for episode in episodes)
    target = _stacked(episode.target for episode in episodes)
    located = _stacked(episode.located for episode in episodes)
    # 0 where targets have none
    mode = _stacked(0 * each.target if each.mode is None else each.mode for each in episodes)
    found = torch.zeros(len(target), world.num_cells)
    start = torch.tensor([each.start for each in episodes])
    if told:
        belief = exact.detect(start * modes + torch.tensor([each.start_mode for each in episodes]))
    else:  # any mode of the cell is as likely at the start
        belief = (cell == start[:, None]).double() / modes
    rows = torch.arange(len(episodes))
    for t in range(int(lengths.max())):
        # Episodes that have ended leave the batch, `rows` says which ones the rows of `belief` belong to.
        going_on = lengths[rows] > t
        rows, belief = rows[going_on], belief[going_on]
        step = first[rows] + t
        predicted = exact.predict(belief)
        found[step] = (predicted if modes == 1 else summed(cells, predicted)).float()
        # An exit ends the episode; its cell M has no belief, and cell 0 stands in, unused.
        at = target[step] * located[step]
        if told:
            seen = exact.detect(at * modes + mode[step] * located[step])
        else:  # the predicted modes of the cell
            seen = exact.miss(predicted, cell != at[:, None])
        report = chance(action[step], misses[step])
        missed = exact.miss(predicted, report.repeat_interleave(modes, -1))
        belief = torch.where(located[step, None], seen, missed)
    return [part.numpy() for part in found.split(lengths.tolist())]


def _stacked(parts: Iterable[npt.NDArray[Any]]) -> Tensor:
    return torch.as_tensor(np.concatenate([*parts]))


def _reports(world: Task) -> Callable[[Tensor, Tensor], Tensor]:
    """Of actions `[B, S]` and n `[B]` the probability `[B, M]` that a step reports a target in each cell.

    Where reports are certain it is the action itself, a bool. It is asked for step by step: of all steps at once it
    would take 8 bytes for each step and cell, 3 GB for 400 steps on a million cells.
    """
    if world.perfect and world.safe:
        return lambda action, _: torch.from_numpy(world.covered(action.numpy()))
    seen_by, safe = sparse.csr_array(world.sees_by_cell.T), torch.as_tensor(world.safe_detection)

    def chance(action: Tensor, misses: Tensor) -> Tensor:
        seen = reported(sparse.csr_array(action.double().numpy()), seen_by).toarray()
        return torch.where(misses[:, None] > world.t_max, safe, torch.from_numpy(seen))

    return chance
