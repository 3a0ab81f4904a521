"""A policy of your own, as a plain function, valued exactly and simulated beside it."""

from __future__ import annotations

from torch import Tensor

import trackmdp as tm

world = tm.make_world(size=8, cost=0.16, t_max=2)
rows, columns = world.size


def square(last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor) -> Tensor:
    """Sense the square around the last located cell that grows with every miss: `[B, M]` bool."""
    cell = last_cell.new_tensor(range(world.num_cells))
    apart = (cell // columns - last_cell[:, None] // columns).abs()
    beside = (cell % columns - last_cell[:, None] % columns).abs()
    return apart.maximum(beside) <= 1 + steps_since_detection[:, None]


def main() -> None:
    """Print the exact value, the simulated one with its standard error, and the distance to the optimum."""
    exact = tm.evaluate(world, square)
    simulated = tm.simulate(world, square, 1000, seed=0).figures()
    best = tm.solve(world)
    print(f"exact     {exact.aihtr:9.3f}   sensors per step {exact.sensors_per_step:.2f}")
    print(f"simulated {simulated.aihtr.mean:9.3f} +- {simulated.aihtr.standard_error:.3f}")
    print(
        f"optimal   {best.lower:9.3f}   short by {(best.upper - exact.aihtr) / exact.expected_length:.3f} per step"
    )


if __name__ == "__main__":
    main()
