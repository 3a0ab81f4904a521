"""PPO and A2C of Stable-Baselines3 on `trackmdp/Track-v0`, valued exactly beside the optimum (extras: gym; and SB3)."""

from __future__ import annotations

import gymnasium
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env

import trackmdp as tm

STEPS = 16_000


def main(steps: int = STEPS) -> None:
    """Train both, then print the exact values of their modes beside sensing nothing and the optimum."""
    torch.set_num_threads(1)
    world = tm.make_world("random_walk", size=3, cost=0.1, exit_probability=0.1)
    none, best = tm.evaluate(world, "none").aihtr, tm.solve(world).upper
    print(gymnasium.make("trackmdp/Track-v0", world=world))
    envs = make_vec_env("trackmdp/Track-v0", n_envs=8, seed=0, env_kwargs={"world": world})
    common = {"gamma": 0.9, "policy_kwargs": {"net_arch": [32]}, "seed": 0, "device": "cpu"}
    ppo = PPO("MultiInputPolicy", envs, n_steps=64, batch_size=128, learning_rate=3e-3, **common)
    a2c = A2C("MultiInputPolicy", envs, n_steps=16, learning_rate=3e-3, **common)
    for name, model in {"PPO": ppo, "A2C": a2c}.items():
        model.learn(steps)
        value = tm.evaluate(world, model).aihtr
        print(f"{name} {value:.3f}, none {none:.3f}, optimum {best:.3f}")


if __name__ == "__main__":
    main()
