"""Steps of the environment with random sets of sensors, resets included, also beside another checkout's.

The sets are drawn before the clock starts: to draw them takes a third of the time of a step of 1,024 environments.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import cycle

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

import trackmdp as tm
from benchmarks.clock import beside_checkout, rate
from benchmarks.words import Row, as_words, world_of

STEPS = 32
"""Steps a call, so that reading the clock does not count."""


def rows(
    words: Mapping[str, str],
    batch_sizes: tuple[int, ...] = (1, 64, 1024, 8192),
    seconds: float = 2.0,
    seed: int = 0,
    device: str = "cpu",
    beside: str = "",
    repeat: int = 5,
) -> Iterator[Row]:
    """One row for each number of environments stepped together; `frame_bytes` are those of a step of one.

    `cpu_share` is the CPU time over that of the checkout `beside`, the least of `repeat` turns each.

    Raises:
        UserError: the checkout has no package.
    """
    world = world_of(words)
    for envs in batch_sizes:
        env = tm.TrackEnv(world, envs, seed=seed, device=device)
        steps = Steps(env, DrawnBefore(env, RandomSubset(env, seed)))
        figures = rate(steps, seconds, device)
        figures["cpu_us_step"] = envs * figures["cpu_us_each"]
        row = {"envs": envs, **figures, "frame_bytes": steps.frame.bytes() / envs}
        if beside:
            own = {"batch_sizes": f"[{envs}]", "seconds": seconds, "seed": seed, "device": device}
            typed = ("part=env", *as_words(dict(words) | own))
            here, there = beside_checkout(beside, typed, "cpu_us_each", repeat)
            row["cpu_share"] = here / there
        yield row


class RandomSubset(TensorDictModuleBase):
    """Each sensor on with probability 1/2, from a generator of its own; 8 sensors take one draw."""

    def __init__(self, env: tm.TrackEnv, seed: int) -> None:
        self.in_keys, self.out_keys = [], ["action"]
        super().__init__()
        self.shape, self.device = env.action_spec.shape, env.device
        self.generator = torch.Generator(self.device).manual_seed(seed)

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        """`state` with an action for each row."""
        count = self.shape.numel()
        words = torch.empty(-(-count // 8), dtype=torch.int64, device=self.device)
        drawn = words.random_(-(2**63), 2**63 - 1, generator=self.generator).view(torch.int8)
        return state.set("action", (drawn[:count] < 0).view(self.shape))


class DrawnBefore(TensorDictModuleBase):
    """The actions of `policy` at `STEPS` steps, in turn and again from the first."""

    def __init__(self, env: tm.TrackEnv, policy: TensorDictModuleBase) -> None:
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        super().__init__()
        state = env.reset()
        self.actions = cycle([policy(state)["action"].clone() for _ in range(STEPS)])

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        """`state` with an action for each row."""
        return state.set("action", next(self.actions))


class Steps:
    """A call makes `STEPS` steps, put together in one batch with `store`, and returns their number in all rows."""

    def __init__(
        self, env: tm.TrackEnv, policy: TensorDictModuleBase, *, store: bool = False
    ) -> None:
        self.env, self.policy, self.store = env, policy, store
        self.state = self.frame = env.reset()

    def __call__(self) -> int:
        frames = []
        for _ in range(STEPS):
            self.frame, self.state = self.env.step_and_maybe_reset(self.policy(self.state))
            if self.store:
                frames.append(self.frame)
        if self.store:
            torch.stack(frames, -1)
        return STEPS * self.env.num_envs
