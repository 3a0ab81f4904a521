"""Evaluating a policy: exactly, by its chains, and by simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from trackmdp.seeding import preserved_global_rng
from trackmdp.world.env import TrackEnv
from trackmdp.world.model import BoolArray, Task, World

__all__ = ["Estimate", "Simulation", "chains_of", "simulate"]


@torch.no_grad()
def chains_of(actor: TensorDictModuleBase, task: Task, device: torch.device | str = "cpu") -> BoolArray:
    """`[M, t_max+1, M]`, the sets a deterministic policy senses from each located cell, followed until detection.

    After a miss the next state is known in advance, so M · (t_max + 1) calls of the policy say all there is to say
    about it; `trackmdp.solvers.evaluate` turns them into exact values.
    """
    m, choices = task.num_cells, task.num_choices
    history = torch.zeros(m, choices, m, dtype=torch.bool, device=device)
    cells = torch.arange(m, device=device)
    with preserved_global_rng(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for n in range(choices):
            state = {
                "last_cell": cells,
                "steps_since_detection": torch.full_like(cells, n),
                "action_history": history.clone(),
            }
            history[:, n] = actor(TensorDict(state, [m], device=device))["action"]
    return history.cpu().numpy()


@dataclass(frozen=True)
class Estimate:
    """A mean over simulated episodes with its standard error (nan for a single episode)."""

    mean: float
    standard_error: float


@dataclass(frozen=True)
class Simulation:
    """Figures of simulated episodes; `accuracy` is pooled, as the exact one, `episode_accuracy` the mean over episodes.

    Figures per step are ratios of sums over all episodes; their standard errors are those of a ratio estimate.
    """

    episodes: int
    aihtr: Estimate
    accuracy: Estimate
    episode_accuracy: Estimate
    sensors_per_step: Estimate
    safe_per_episode: Estimate
    expected_length: Estimate


@torch.no_grad()
def simulate(
    world: World,
    policy: TensorDictModuleBase,
    *,
    episodes: int,
    seed: int,
    device: torch.device | str = "cpu",
) -> Simulation:
    """Run `episodes` independent episodes, one per row, each until its own end.

    Every row is followed to its first end and then ignored: keeping the first episodes to finish would favour short
    ones. Training is not disturbed: environment and generator are the evaluation's own.

    Args:
        world: the task and the motion.
        policy: reads the state keys and writes `action`; run deterministically.
        episodes: how many, all stepped together.
        seed: seed of the run; the stream is "evaluation".
        device: where to run.
    """
    env = TrackEnv(world, episodes, seed=seed, stream="evaluation", device=device)
    totals = torch.zeros(6, episodes, dtype=torch.float64, device=device)
    running = torch.ones(episodes, dtype=torch.bool, device=device)
    with preserved_global_rng(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        while running.any():
            state = policy(state)
            totals += _figures(env, state, following := env.step(state)["next"]) * running
            running &= ~following["done"].squeeze(-1)
            state = following.select(*env.state_keys_of_step)
    return _summary(totals.cpu())


def _figures(env: TrackEnv, state: TensorDict, following: TensorDict) -> Tensor:
    """`[6, B]` reward, step in the grid, detection, sensors on by choice, forced action, step of one step."""
    in_grid = ~following["terminated"].squeeze(-1)
    forced = (state["steps_since_detection"] > env.t_max) & in_grid
    detected = (following["steps_since_detection"] == 0) & in_grid
    chosen = state["action"].sum(-1) * (in_grid & ~forced)
    every = torch.ones_like(in_grid)
    return torch.stack([following["reward"].squeeze(-1).double(), in_grid, detected, chosen, forced, every])


def _summary(totals: Tensor) -> Simulation:
    reward, steps, detections, sensors, forced, length = totals
    some = steps > 0
    return Simulation(
        episodes=len(reward),
        aihtr=_mean(reward),
        accuracy=_ratio(detections, steps),
        episode_accuracy=_mean(detections[some] / steps[some]),
        sensors_per_step=_ratio(sensors, steps),
        safe_per_episode=_mean(forced),
        expected_length=_mean(length),
    )


def _mean(values: Tensor) -> Estimate:
    if len(values) == 0:
        return Estimate(math.nan, math.nan)
    error = values.std().item() / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return Estimate(values.mean().item(), error)


def _ratio(part: Tensor, whole: Tensor) -> Estimate:
    """Σ part / Σ whole with its standard error by the delta method."""
    if not whole.any():
        return Estimate(math.nan, math.nan)
    ratio = (part.sum() / whole.sum()).item()
    residual = part - ratio * whole
    error = residual.std().item() / (whole.mean().item() * math.sqrt(len(part))) if len(part) > 1 else math.nan
    return Estimate(ratio, error)
