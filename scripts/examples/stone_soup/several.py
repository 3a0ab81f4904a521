"""Several targets judged by Stone Soup's GOSPA: what two policies know of the same targets, side by side.

`trackmdp_stone_soup` beside this file is the adapter; it needs the extra `stonesoup`.
"""

from __future__ import annotations

import numpy as np
from trackmdp_stone_soup.following import gospa, seen_of
from trackmdp_stone_soup.places import Places, paths_of

import trackmdp as tm

EPISODES = 10


def main() -> None:
    """Print for each policy how many sensors it takes, and how far its tracks are from three targets."""
    options = {"size": 5, "cost": 0.25, "t_max": 1, "exit_probability": 0.05}
    targets = tm.make_world("random_walk", targets=3, **options)
    places = Places.of(targets.task, side=100.0)  # cells of 100 m
    # The union of no sensors is none; gains would switch some on.
    policies = {
        "all off": (tm.Policy.none(targets.task), "union"),
        "merged optimum": (tm.solve(targets), "gains"),
    }
    for name, (policy, merge) in policies.items():
        episodes = tm.simulate(targets, policy, EPISODES, seed=0, merge=merge)
        errors = [
            gospa(seen_of(each, places), paths_of(each.singles(), places), c=300.0)["distance"]
            for each in episodes
        ]
        distance = np.average(errors, weights=[len(each) for each in episodes])
        found = episodes.figures()
        print(
            f"{name:14} sensors per step {found.sensors_per_step.mean:.3f}, "
            f"located in {found.accuracy.mean:.3f} of steps, GOSPA {distance:.1f} m"
        )


if __name__ == "__main__":
    main()
