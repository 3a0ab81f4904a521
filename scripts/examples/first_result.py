"""The first result: a policy learned without knowing the motion, valued exactly, beside the best there is."""

from __future__ import annotations

import trackmdp as tm
from trackmdp.episodes.player import draw_picture


def main() -> None:
    """Print what an episode earns on average, what the best policy earns, and three steps of an episode."""
    world = tm.make_world("random_support", size=10, support_size=5, cost=0.16, t_max=1)
    run = tm.train(world, seed=0)  # gets the task, never the motion
    best = tm.solve(world)
    figures = run.evaluation
    print(
        f"learned {figures.aihtr:.3f}, the best possible {best.upper:.3f} (proved: {best.certified})"
    )
    print(
        f"sensors on per step {figures.sensors_per_step:.2f} of {world.num_cells}, located {figures.accuracy:.1%}"
    )
    print(draw_picture(tm.simulate(world, run.policy, 16, seed=0), world, steps=3))


if __name__ == "__main__":
    main()
