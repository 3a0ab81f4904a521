"""A motion of your own: a sparse table, solved to the certified optimum and learned without the table."""

from __future__ import annotations

import numpy as np
from scipy import sparse

import trackmdp as tm

ROWS, COLUMNS = 4, 6


def circling(stay: float = 0.1, leave: float = 0.02) -> sparse.csr_array:
    """`[M, M]` a target that runs round the grid clockwise; row i sums to 1 - `leave`, the rest is the exit."""
    row, column = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
    up, down = column < COLUMNS // 2, column >= COLUMNS // 2
    top, bottom = row == 0, row == ROWS - 1
    # Right along the top, down on the right, left along the bottom, up on the left.
    step_row = np.where(up & ~top, -1, np.where(down & ~bottom, 1, 0))
    step_column = np.where(up & top, 1, np.where(down & bottom, -1, 0))
    cells = np.arange(ROWS * COLUMNS)
    following = (row + step_row) * COLUMNS + column + step_column
    weights = np.concatenate([np.full(cells.size, stay), np.full(cells.size, 1 - stay)]) * (
        1 - leave
    )
    entries = (np.concatenate([cells, cells]), np.concatenate([cells, following]))
    return sparse.csr_array((weights, entries), shape=(cells.size, cells.size))


def main() -> None:
    """Print the value of Q_MDP, of a learned policy, and the optimum."""
    world = tm.World(circling(), (ROWS, COLUMNS), cost=0.2, t_max=2)
    best = tm.solve(world)
    run = tm.train(world, "hindsight", seed=0, total_frames=20_000)
    for name, policy in (
        ("Q_MDP", tm.solve(world, "qmdp").policy),
        ("learned", run.policy),
        ("optimal", best.policy),
    ):
        figures = tm.evaluate(world, policy)
        print(f"{name:8} {figures.aihtr:8.4f}   located in {figures.accuracy:.1%} of the steps")
    print(f"proved: no policy earns more than {best.upper:.4f} (certified: {best.certified})")


if __name__ == "__main__":
    main()
