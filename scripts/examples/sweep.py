"""A sweep from Python: prices against T_max, each policy learned blind and held against the proved optimum."""

from __future__ import annotations

import trackmdp as tm


def main(frames: int = 100_000) -> None:
    """Print one line per world; regret is per step, to a bound that no policy exceeds."""
    print("cost   T_max   learned   optimum   regret per step")
    for cost in (0.1, 0.2):
        for t_max in (0, 1, 2):
            world = tm.make_world("random_support", size=6, cost=cost, t_max=t_max)
            run = tm.train(world, "hindsight", seed=0, total_frames=frames)
            best = tm.solve(world)
            regret = (best.upper - run.evaluation.aihtr) / run.evaluation.expected_length
            print(f"{cost:4.2f} {t_max:7d} {run.evaluation.aihtr:9.3f} {best.upper:9.3f} {regret:14.5f}")


if __name__ == "__main__":
    main()
