"""Policies of trackmdp in Stone Soup: its sensors and platforms, its ground-truth paths, its GOSPA.

`trackmdp_stone_soup` beside this file is the adapter; it needs the extra `stonesoup`.
"""

from __future__ import annotations

import numpy as np
from trackmdp_stone_soup.following import follow, gospa
from trackmdp_stone_soup.places import Places, paths_of
from trackmdp_stone_soup.sensors import CellSensor, PolicySensorManager

import trackmdp as tm

EPISODES = 10


def main() -> None:
    """Print for each policy the figures of trackmdp's simulation and of Stone Soup on the same targets."""
    world = tm.make_world("random_walk", size=5, cost=0.25, t_max=1, exit_probability=0.05)
    places = Places.of(world, side=100.0)  # cells of 100 m
    policies = {
        "all off": tm.Policy.none(world),
        "Q_MDP": tm.solve(world, "qmdp").policy,
        "optimal": tm.solve(world).policy,
    }
    for name, policy in policies.items():
        ours = tm.simulate(world, policy, EPISODES, seed=0)
        platforms = set(CellSensor.grid(places))
        manager = PolicySensorManager(policy=policy, places=places, platforms=platforms)
        paths = paths_of(ours, places)
        theirs = [follow(manager, path) for path in paths]
        # One target at a time: together they would be one scene with ten targets.
        errors = [
            gospa([found.track], [path], c=300.0) for found, path in zip(theirs, paths, strict=True)
        ]
        steps = [len(path) for path in paths]
        distance = np.average([error["distance"] for error in errors], weights=steps)
        reward = np.concatenate([found.reward for found in theirs]).mean()
        located = np.concatenate([found.located for found in theirs]).mean()
        print(
            f"{name:8} reward per step {ours.reward.mean():.4f}, in Stone Soup {reward:.4f}; "
            f"located in {located:.3f} of steps, GOSPA {distance:.1f} m"
        )


if __name__ == "__main__":
    main()
