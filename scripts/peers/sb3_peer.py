"""PPO of Stable-Baselines3: an MlpPolicy over M on/off actions, on a VecEnv in numpy that steps its rows at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import track
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

ENVS, STEPS, HIDDEN = 256, 16, 128
FALL = 2_000_000
"""Env steps over which the step size falls to a twentieth."""
SCALE = 0.1
"""Of the rewards that the learner sees."""


class Envs(VecEnv):
    """Independent episodes, each begun anew when its target exits."""

    def __init__(self, instance: track.Instance, seed: int) -> None:
        self.at, self.rng, self.rows = instance, np.random.default_rng(seed), np.arange(ENVS)
        seen = spaces.Box(0.0, 1.0, (instance.width,), np.float32)
        super().__init__(ENVS, seen, spaces.MultiBinary(instance.num_cells))
        self.target = np.zeros(ENVS, np.int64)
        self.last, self.misses = np.zeros(ENVS, np.int64), np.zeros(ENVS, np.int64)
        self.history = np.zeros((ENVS, instance.choices, instance.num_cells), np.float32)

    def reset(self) -> np.ndarray:
        self.target = self.rng.integers(self.at.num_cells, size=ENVS)
        self._locate(self.rows)
        return self._shown()

    def step_async(self, actions: np.ndarray) -> None:
        self.action = actions.astype(bool)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        at = self.at
        number = (self.rng.random(ENVS)[:, None] > at.cumulated[self.target]).sum(axis=1)
        exited, moved = number == at.cumulated.shape[1], at.cells[self.target, number]
        forced = self.misses == at.choices  # the safe action: it locates whatever is sensed
        sensed = self.action[self.rows, moved]
        earned = np.where(
            forced, at.reward - at.safe_cost, at.reward * sensed - self.action @ at.cost
        )
        missed = np.flatnonzero(~(exited | forced | sensed))
        self.history[missed, self.misses[missed]] = self.action[missed]
        self.misses[missed] += 1
        infos: list[dict[str, Any]] = [{} for _ in range(ENVS)]
        for row, shown in zip(np.flatnonzero(exited), self._shown()[exited], strict=True):
            infos[row] = {"terminal_observation": shown, "TimeLimit.truncated": False}
        self.target = np.where(exited, self.rng.integers(at.num_cells, size=ENVS), moved)
        self._locate(np.flatnonzero(exited | forced | sensed))
        return (
            self._shown(),
            np.where(exited, 0.0, SCALE * earned).astype(np.float32),
            exited,
            infos,
        )

    def _locate(self, rows: np.ndarray) -> None:
        self.last[rows], self.misses[rows], self.history[rows] = self.target[rows], 0, 0.0

    def _shown(self) -> np.ndarray:
        return self.at.observe(self.last, self.misses, self.history)

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * ENVS

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """There is nothing to be set."""

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        return [None] * ENVS

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * ENVS


class Keep(BaseCallback):
    """Records the greedy policy between updates, and ends the run in time."""

    def __init__(self, record: track.Record, instance: track.Instance) -> None:
        super().__init__()
        self.record, self.instance, self.goes_on = record, instance, True

    def _on_rollout_start(self) -> None:
        self.goes_on = self.record.keep(
            lambda: self.instance.table(self._greedy), self.num_timesteps
        )

    def _on_step(self) -> bool:
        return self.goes_on

    def _greedy(self, shown: np.ndarray) -> np.ndarray:
        return self.model.predict(shown, deterministic=True)[0].astype(bool)


def main() -> None:
    """Learn until the time is up."""
    words = track.arguments(__doc__).parse_args()
    torch.set_num_threads(1)
    instance = track.Instance(words.instance)
    updates = FALL / (ENVS * STEPS)
    done = 0

    def rate(_progress: float) -> float:
        nonlocal done
        done += 1
        return 5e-3 * max(0.05, 1.0 - 0.95 * done / updates)

    model = PPO(
        "MlpPolicy",
        Envs(instance, words.seed),
        learning_rate=rate,
        n_steps=STEPS,
        batch_size=ENVS * STEPS // 4,
        n_epochs=4,
        gamma=0.7,
        gae_lambda=0.5,
        ent_coef=0.01,
        policy_kwargs={"net_arch": [HIDDEN], "activation_fn": torch.nn.ReLU},
        seed=words.seed,
        device="cpu",
    )
    record = track.Record(words.record, words.seconds)
    model.learn(10**12, callback=Keep(record, instance))
    record.save()


if __name__ == "__main__":
    main()
