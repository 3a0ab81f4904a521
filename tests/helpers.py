"""All kernels, algorithms and baselines, so that a new one is tested by existing; small worlds built by hand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from omegaconf import OmegaConf
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from trackmdp.algos.common import make_algorithm
from trackmdp.arrays.types import Array
from trackmdp.config import GROUPS, EvaluateConfig, TrainConfig, options
from trackmdp.config.compose import compose
from trackmdp.config.registry import read_values
from trackmdp.config.world import BORDERS
from trackmdp.environment.dynamics import Dynamics
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.paths import RESOLUTION, path_sampler
from trackmdp.motion.modes import heading_kernel
from trackmdp.world.model import World


def _without_files(group: str) -> list[str]:
    """Choices of a group that need no file of the user's."""
    return [name for name in GROUPS[group] if "???" not in read_values(f"{group}/{name}").values()]


KERNELS = [name for name in _without_files("kernel") if not GROUPS["kernel"][name].hides]
ALGORITHMS = _without_files("algo")
BASELINES = _without_files("baseline")

__all__ = [
    "ALGORITHMS",
    "BASELINES",
    "BORDERS",
    "KERNELS",
    "advanced",
    "algorithm",
    "collect",
    "configured",
    "evaluate_config",
    "headings",
    "hop_world",
    "later",
    "random_kernel",
    "random_state",
    "small_world",
    "train_config",
    "worlds",
]


def later(cases: Iterable[Any]) -> list[Any]:
    """Of these cases the first of each four is left to the slow tests, and the others to the long ones."""
    marks = [pytest.mark.slow, *[pytest.mark.long] * 3]
    listed = (case if isinstance(case, tuple) else (case,) for case in cases)
    return [pytest.param(*case, marks=marks[place % 4]) for place, case in enumerate(listed)]


def configured(command: str, *overrides: str) -> Any:
    """The checked config of `trackmdp command overrides...`."""
    typed = OmegaConf.from_dotlist(
        []
    )  # reads values as the command line does: numbers, null, lists
    given = {}
    for key, _, value in (word.partition("=") for word in overrides):
        typed.merge_with_dotlist([f"value={value}"])
        given[key] = OmegaConf.to_container(typed)["value"]
    return compose(command, given)


def train_config(*overrides: str) -> TrainConfig:
    cfg = configured("train", *overrides)
    assert isinstance(cfg, TrainConfig)
    return cfg


def evaluate_config(*overrides: str) -> EvaluateConfig:
    cfg = configured("evaluate", *overrides)
    assert isinstance(cfg, EvaluateConfig)
    return cfg


def hop_world(t_max: int = 1, *, safe_cost: float = 0.9) -> World:
    """A 2x2 grid: the target hops 0 -> 1 -> 2 -> 3 -> 0, staying in the grid with probability 3/4; r = 2."""
    kernel = np.zeros((4, 4))
    kernel[[0, 1, 2, 3], [1, 2, 3, 0]] = 0.75
    return World(
        kernel, 2, cost=np.array([0.1, 0.2, 0.3, 0.4]), safe_cost=safe_cost, t_max=t_max, reward=2.0
    )


def headings(
    size: int = 3, keep: float = 0.8, *, cost: float = 0.2, t_max: int = 1, **more: Any
) -> World:
    kernel, modes = heading_kernel(size, keep=keep, go=0.9, exit_probability=0.05)
    return World(kernel, size, modes=modes, cost=cost, t_max=t_max, **{"clip": 1, **more})


def small_world(
    size: int = 3,
    t_max: int = 1,
    *,
    exit_probability: float = 0.1,
    seed: int = 0,
    max_steps: int | None = None,
) -> World:
    """A dense random kernel that leaves soon; the safe action costs what all sensors do."""
    m = size**2
    kernel = random_kernel(np.random.default_rng(seed), m, exit_probability)
    return World(kernel, size, cost=0.2, safe_cost=m * 0.2, t_max=t_max, max_steps=max_steps)


def limited(problem: Any, max_steps: int | None) -> Any:
    """The same problem, its episodes cut after so many steps."""
    same = getattr(problem, "max_steps", None) == max_steps
    return problem if same else replace(problem, max_steps=max_steps)


def random_kernel(
    rng: np.random.Generator, m: int, exit_probability: float, density: float = 0.7
) -> Array:
    """`[m, m]` with empty cells in most rows, each summing to 1 - exit_probability."""
    table = rng.random((m, m)) ** 3 * (rng.random((m, m)) < density)
    table[np.arange(m), rng.integers(m, size=m)] += 0.2
    return table / table.sum(axis=1, keepdims=True) * (1.0 - exit_probability)


@st.composite
def worlds(draw: st.DrawFn) -> World:
    """2x2 and 3x3 worlds, T_max 0 to 3, one cost or one per cell."""
    size, t_max = draw(st.sampled_from([2, 3])), draw(st.integers(0, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m = size**2
    cost = rng.random(m) if draw(st.booleans()) else np.full(m, rng.random())
    kernel = random_kernel(rng, m, draw(st.sampled_from([1e-6, 0.1, 0.5])))
    return World(
        kernel,
        size,
        cost=cost,
        reward=float(1 + rng.random()),
        safe_cost=float(3 * rng.random()),
        t_max=t_max,
    )


def random_state(world: World, rows: int, seed: int) -> TensorDict:
    """States an episode can be in: n misses, and the n actions since the detection."""
    rng = torch.Generator().manual_seed(seed)
    m, k, choices = world.num_cells, world.num_sensors, world.num_choices
    n = torch.randint(choices + 1, (rows,), generator=rng)
    history = torch.rand(rows, choices, k, generator=rng) < 0.4
    history &= (torch.arange(choices) < n.unsqueeze(-1)).unsqueeze(-1)
    state = {
        "place": torch.randint(m, (rows,), generator=rng),
        "last_cell": torch.randint(m, (rows,), generator=rng),
        "steps_since_detection": n,
        "action_history": history,
        "action": torch.rand(rows, k, generator=rng) < 0.4,
    }
    return TensorDict(state, [rows])


def advanced(problem: Any, state: Any, draws: Any, reports: Any = None) -> dict[str, torch.Tensor]:
    """A step of the dynamics from a state with its `action`, for uniform draws `[B]` in [0, 1)."""
    dynamics = Dynamics(problem, path_sampler(problem))
    numbers = (torch.as_tensor(draws, dtype=torch.float64) * RESOLUTION).long()
    before = {key: state[key] for key in state.keys() if key != "action"}  # noqa: SIM118 (tensordicts)
    return dynamics.advance(before, state["action"], numbers, reports)


class Watched(TrackEnv):
    """Says after each step of `step_and_maybe_reset` where the targets were and came to: under `target`."""

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        before = self.target
        frame, rows = super()._step_and_maybe_reset(tensordict)
        frame["target"], frame["next", "target"] = before, self.reached
        return frame, rows

    def _stepped(self, action: torch.Tensor) -> dict[str, torch.Tensor]:
        following = super()._stepped(action)
        self.reached = self.target
        return following


@torch.no_grad()
def collect(
    world: World, policy: Any, envs: int, time: int, *, seed: int = 0, max_steps: int | None = None
) -> Any:
    """Frames `[envs, time]` of `policy`, as a collector would hand them over."""
    env = TrackEnv(limited(world, max_steps), envs, seed=seed)
    rows, frames = env.reset(), []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(time):
            frame, rows = env.step_and_maybe_reset(policy(rows))
            frames.append(frame.clone())
    return torch.stack(frames, dim=1)


def algorithm(name: str, world: World, *overrides: str) -> Any:
    """The learner `name` for `world` on a small budget, its other options as in conf/ but for `overrides`."""
    small = {
        "hidden": 32,
        "batch_size": 64,
        "buffer_size": 4096,
        "updates": 2,
        "rounds": 2,
        "rounds_at_end": 2,
    }
    mine = [
        f"algo.{key}={value}"
        for key, value in small.items()
        if key in options(GROUPS["algo"][name])
    ]
    budget = ("algo.total_frames=4096", "algo.frames_per_batch=256", "algo.envs=32")
    cfg = train_config(f"algo={name}", *budget, *mine, *overrides)
    return make_algorithm(cfg, world, torch.device("cpu"))
