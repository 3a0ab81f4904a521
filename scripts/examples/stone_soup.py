"""Our policies in Stone Soup: its sensors and platforms, its ground-truth paths, its GOSPA beside our figures."""

from __future__ import annotations

import numpy as np

import trackmdp as tm
from trackmdp.episodes.stone_soup import CellSensor, Places, PolicySensorManager, follow, gospa, paths_of
from trackmdp.policies.policy import Policy

EPISODES = 10


def main() -> None:
    """Print for each policy what our simulation and Stone Soup make of the same targets."""
    world = tm.make_world("random_walk", size=5, cost=0.25, t_max=1, exit_probability=0.05)
    places = Places.of(world, side=100.0)  # cells of 100 m
    policies = {
        "all off": Policy(world, probability=0.0),
        "Q_MDP": tm.solve(world, "qmdp").policy,
        "optimal": tm.solve(world).policy,
    }
    for name, policy in policies.items():
        ours = tm.simulate(world, policy, EPISODES, seed=0)
        platforms = set(CellSensor.grid(places))  # a platform with one sensor in the middle of every cell
        manager = PolicySensorManager(policy=policy, places=places, platforms=platforms)
        paths = paths_of(ours, places)  # their true paths, as Stone Soup has them
        theirs = [follow(manager, path) for path in paths]
        # Target by target: at the same times they would be taken for one scene with ten targets.
        errors = [gospa([found.track], [path], c=300.0) for found, path in zip(theirs, paths, strict=True)]
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
