"""Probabilities of moves from counts, by empirical Bayes: the common distribution of all moves corrects each of them.

A move seen k times in n from its cell has the share k / n; its error is largest where a plan depends on it most: at
moves near the price of a sensor. So each count is read as a draw from Binomial(n, p), p itself from one mixture of Beta
distributions for all moves of the grid, with the weights that make all counts together likeliest
(expectation-maximisation; Robbins 1956, Efron 2010), even ones where there are few. The posterior means shrink towards
the modes of the mixture: where all have .15 or .21, towards these two; where probabilities spread, hardly at all.

A move of probability p was seen with probability s = 1 - (1 - p)^n. So each move seen stands for 1 / s moves of the
grid, seen or not, of p each (Horvitz & Thompson 1952), of which n moves out of a cell leave the share (1 - p)^n unseen:
the sum over the cells is the probability of a move that is new after n. By the cell's own moves alone, a cell left nine
times, always alike, would never be left otherwise. The new moves are divided among the cells not yet
reached as the displacements of the moves that account for it, in the whole grid.

With k = 1 twice and k = 8 of n = 10 from the only cell, and those shares taken as the truth, the two stand for .1 /
.651 = .154 each, of which .054 is not seen: a new move is made with probability .107 / 1.107 = .097. With a second cell
that was left ten times, always alike, it is .054 / 1.054 = .051 for both.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse
from scipy.special import betaln

from trackmdp.arrays.entries import per_row, row_index, with_data
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.sensing.task import Task

PRECISIONS = (30.0, 300.0, 3000.0)
"""a + b of the Beta(a, b) of the mixture: broad and narrow groups of probabilities."""
ROUNDS = 50
UNDECIDED = 100.0
"""Moves' worth of even weights of all components: some 60 moves, as of 3 x 3 cells, cannot separate 120 of them."""
MOST_PAIRS = 2**14
"""Different counts (k, n) that the mixture is fitted to, and that are worked on at once: 16 MB an array."""
SHARE_OF_PRICE = 0.01


def posterior_mean(count: Array, moves: Array) -> Array:
    """`[E]` the probability of each move.

    Args:
        count: `[E]`, k > 0, how often it was seen; a fraction where it was inferred.
        moves: `[E]`, n >= k, all moves seen out of its cell.
    """
    if not len(count):
        return np.zeros(0)
    # Equal counts have equal estimates: of 2,000 moves with 300 each, some 200 pairs (k, n) differ.
    pairs, place, copies = np.unique(
        np.stack([count, moves]), axis=1, return_inverse=True, return_counts=True
    )
    alpha, beta = _components()
    # They are sorted, so that every 2nd or 3rd of very many is a fair sample of them.
    step = -(-pairs.shape[1] // MOST_PAIRS)
    likelihood, times = _likelihood(pairs[:, ::step], alpha, beta), step * copies[::step]
    weight = np.full(len(alpha), 1.0 / len(alpha))
    for _ in range(ROUNDS):
        # A pair's shares are likelihood * weight over their sum: sums over pairs need no array of all shares.
        share = weight * ((times / (likelihood @ weight)) @ likelihood)
        weight = (share + UNDECIDED / len(alpha)) / (times.sum() + UNDECIDED)
    mean = np.zeros(pairs.shape[1])
    for first in range(0, len(mean), MOST_PAIRS):
        part = pairs[:, first : first + MOST_PAIRS]
        share = (likelihood if step == 1 else _likelihood(part, alpha, beta)) * weight
        # The posterior of one component is Beta(a + k, b + n - k), of mean (a + k) / (a + b + n).
        means = (part[0][:, None] + alpha) / (part[1][:, None] + alpha + beta)
        mean[first : first + MOST_PAIRS] = (share * means).sum(axis=1) / share.sum(axis=1)
    return mean[place.ravel()]


def _components() -> tuple[Array, Array]:
    """`[C]`, a and b of each Beta: means as far apart as two standard deviations of one of them."""
    alpha, beta = [], []
    for precision in PRECISIONS:
        number = math.ceil(1.6 * math.sqrt(precision))
        # Of Beta(s m, s (1 - m)) the angle arcsin sqrt p has a standard deviation of 1 / (2 sqrt s), for any m:
        # equal steps in the angle, pi / 2 in 1.6 sqrt s parts.
        mean = np.sin(np.pi / 2 * (np.arange(number) + 0.5) / number) ** 2
        alpha.append(precision * mean)
        beta.append(precision * (1.0 - mean))
    return np.concatenate(alpha), np.concatenate(beta)


def _likelihood(pairs: Array, alpha: Array, beta: Array) -> Array:
    """`[P, C]` of k in n moves under each component, up to a factor for each pair."""
    count, rest = pairs[0][:, None], (pairs[1] - pairs[0])[:, None]
    log = betaln(count + alpha, rest + beta) - betaln(alpha, beta)
    return np.exp(log - log.max(axis=1, keepdims=True))


def unseen(rows: IndexArray, probability: Array, moves: Array, cells: int) -> tuple[Array, Array]:
    """Unseen moves: the probability of a new move from each cell, and its parts by the moves seen.

    Args:
        rows: `[E]`, cell that each move seen starts from.
        probability: `[E]`, its own.
        moves: `[E]`, moves seen out of its cell.
        cells: M.

    Returns:
        `[M]` the probability that the next move from a cell is one not seen from there, 1 where none was; `[E]` the
        probability of unseen moves that each one seen stands for.
    """
    not_made = np.log1p(-np.minimum(probability, 1.0 - 1e-12))
    mass = probability / -np.expm1(moves * not_made)
    # Moves with p within 3 % of each other are taken together: some hundred, instead of up to M Z.
    place = np.unique(np.round(32.0 * np.log(probability)), return_inverse=True)[1]
    together = np.bincount(place, mass)
    exponent = np.bincount(place, mass * not_made) / together
    out = np.zeros(cells)
    out[rows] = moves
    number, back = np.unique(out[out > 0], return_inverse=True)
    missing = np.exp(number[:, None] * exponent) @ together / max(1, len(back))
    # Seen moves have the odds 1 to `missing` against unseen ones.
    new = np.ones(cells)
    new[out > 0] = (missing / (1.0 + missing))[back]
    return new, mass * np.exp(moves * not_made)


def least_worth_planning(task: Task) -> float:
    """The probability of a move below which it is planned without.

    Missing it is worth no more than r + D; that is below a hundredth of the cheapest sensor's price. With c = .16 and
    D = 16 that is .0001, with D = 1000 it is 1.6e-6: a target that is dear to miss is looked for.
    """
    paid = task.cost[task.cost > 0]
    return SHARE_OF_PRICE * float(paid.min(initial=task.reward)) / (task.reward + task.safe_cost)


def without(moves: sparse.csr_array, least: float) -> sparse.csr_array:
    """`moves` `[M, M]` without entries below `least`; their probability goes to the others of their row."""
    rows, kept = row_index(moves), moves.data >= least
    before = per_row(rows, moves.data, moves.shape[0])
    after = per_row(rows, moves.data * kept, moves.shape[0])
    kept |= (after == 0)[rows]  # a row of nothing else stays as it is
    share = np.divide(before, after, out=np.ones_like(before), where=after > 0)
    found = with_data(moves, moves.data * kept * share[rows])
    found.eliminate_zeros()
    return found
