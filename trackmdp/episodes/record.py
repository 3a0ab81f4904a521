"""Recording episodes: many at once, each from its own generator, so that any of them replays alone."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from trackmdp.episodes.episode import Episode
from trackmdp.policies.fixed import ChainPolicy
from trackmdp.seeding import derive
from trackmdp.world.belief import BeliefFilter
from trackmdp.world.env import TrackEnv
from trackmdp.world.model import BoolArray, World
from trackmdp.world.motion import Motion

__all__ = ["Acting", "Chains", "Issued", "RandomSets", "record"]

_BLOCK = 256  # draws taken from an episode's generator at a time
_STEPS_AT_ONCE = 64  # taken before the rows that have ended are dropped from them
_CELLS_AT_ONCE = 25_600  # rows x cells stepped together: memory stays bounded on large grids


class Acting(Protocol):
    """A policy as it is recorded: a pure function of state and draws."""

    @property
    def draws(self) -> int:
        """Uniform draws one decision takes."""
        ...

    @property
    def facts(self) -> dict[str, str]:
        """What a log says of it: its `kind` and what else it takes to act again."""
        ...

    def act(self, state: dict[str, Tensor], step: int, draws: Tensor) -> tuple[Tensor, Tensor | None]:
        """What is done in a state.

        Args:
            state: the keys of `TrackEnv`, `[B, ...]`.
            step: of the episode.
            draws: `[B, draws]`, uniform.

        Returns:
            `action` `[B, M]`, and the probability `[B, M]` with which each sensor was to be on (None: the action).
        """
        ...


class Chains:
    """A deterministic policy by its chains `[M, t_max+1, M]`."""

    draws = 0
    facts: ClassVar = {"kind": "chains"}

    def __init__(self, chains: BoolArray) -> None:
        self.chains = chains
        self._policy = ChainPolicy(chains)

    def act(self, state: dict[str, Tensor], step: int, draws: Tensor) -> tuple[Tensor, Tensor | None]:  # noqa: ARG002
        """See `Acting`."""
        n = state["steps_since_detection"].clamp_max(self._policy.chains.shape[1] - 1)
        return self._policy.chains[state["last_cell"], n], None


@dataclass
class RandomSets:
    """k of M sensors drawn anew at every step."""

    num_cells: int
    k: int

    @property
    def draws(self) -> int:
        """One for each cell."""
        return self.num_cells

    @property
    def facts(self) -> dict[str, str]:
        """See `Acting`."""
        return {"kind": "random_k", "k": str(self.k)}

    def act(self, state: dict[str, Tensor], step: int, draws: Tensor) -> tuple[Tensor, Tensor | None]:  # noqa: ARG002
        """See `Acting`."""
        action = torch.zeros(draws.shape, dtype=torch.bool)
        action.scatter_(-1, draws.topk(self.k, dim=-1).indices, value=True)
        return action, torch.full(draws.shape, self.k / self.num_cells)


class Issued:
    """The actions `[T, M]` of a logged episode, in their order; no sensor on after the last."""

    draws = 0
    facts: ClassVar = {"kind": "playback"}

    def __init__(self, actions: BoolArray) -> None:
        self._actions = torch.as_tensor(actions)

    def act(self, state: dict[str, Tensor], step: int, draws: Tensor) -> tuple[Tensor, Tensor | None]:  # noqa: ARG002
        """See `Acting`."""
        shape = (len(state["target"]), self._actions.shape[1])
        if step >= len(self._actions):
            return torch.zeros(shape, dtype=torch.bool), None
        return self._actions[step].expand(shape), None


def record(
    world: World,
    acting: Acting,
    seeds: Sequence[int],
    *,
    first: int = 0,
    policy: int = 0,
) -> Iterator[Episode]:
    """One episode for each of `seeds`, in their order; the same whatever the others are.

    Args:
        world: the task and the motion.
        acting: the policy.
        seeds: seed of each episode.
        first: number of the first.
        policy: number of the policy in the log.
    """
    rows = max(1, min(256, _CELLS_AT_ONCE // world.num_cells))
    for begin in range(0, len(seeds), rows):
        batch = _Batch(world, acting, seeds[begin : begin + rows])
        yield from batch.run(first + begin, policy)


class _Draws:
    """Uniform draws of many episodes, each from generators of its own."""

    def __init__(self, motion: Motion, seeds: Sequence[int], per_action: int) -> None:
        self._motion, self._per_action = motion, per_action
        self._moves = [torch.Generator().manual_seed(seed) for seed in seeds]
        self._choices = [torch.Generator().manual_seed(derive(seed, "policy")) for seed in seeds]
        self._of_moves = torch.zeros(len(seeds), _BLOCK, dtype=torch.float64)
        self._of_choices = torch.zeros(len(seeds), _BLOCK, per_action)

    def starts(self, cells: int) -> Tensor:
        """`[B]` uniform start cells; taken before any move."""
        return torch.cat([torch.randint(cells, (1,), generator=rng) for rng in self._moves])

    def at(self, step: int, running: Tensor) -> tuple[Tensor, Tensor]:
        """Draws of the moves `[B]` and of the actions `[B, per_action]` at a step; fresh ones only where `running`."""
        place = step % _BLOCK
        if place == 0:
            for row in running.nonzero().squeeze(-1).tolist():
                self._of_moves[row] = self._motion.draw(_BLOCK, self._moves[row])
                if self._per_action:
                    self._of_choices[row] = torch.rand(_BLOCK, self._per_action, generator=self._choices[row])
        return self._of_moves[:, place], self._of_choices[:, place]


class _Batch:
    """Episodes stepped together, each to its own end."""

    def __init__(self, world: World, acting: Acting, seeds: Sequence[int]) -> None:
        self._acting, self._seeds = acting, seeds
        self._env = TrackEnv(world, len(seeds))
        self._filter = BeliefFilter(world.kernel)
        self._into = world.kernel.T.tocsr()
        self._draws = _Draws(Motion(world.kernel), seeds, acting.draws)

    @torch.no_grad()
    def run(self, first: int, policy: int) -> Iterator[Episode]:
        """Step to the end of the last episode, then give them out in order."""
        start = self._draws.starts(self._env.num_cells)
        state = self._env.reset().select(*self._env.state_keys_of_step).to_dict()
        state |= {"target": start, "last_cell": start}
        running = torch.ones(len(start), dtype=torch.bool)
        belief, steps, taken = self._filter.detect(start), [], []
        for step in itertools.count():
            moves, choices = self._draws.at(step, running)
            action, probability = self._acting.act(state, step, choices)
            predicted = self._predict(belief)
            following = self._env.advance(state | {"action": action}, moves)
            steps.append(_step(running, state, action, probability, predicted, following))
            running = running & ~following["done"].squeeze(-1)
            over = not running.any()
            if over or len(steps) == _STEPS_AT_ONCE:
                taken.append(_kept(steps))
                steps = []
            if over:
                break
            belief = self._updated(predicted, action, following)
            state = {key: following[key] for key in state}
        columns = {name: np.concatenate([each[name] for each in taken]) for name in taken[0]}
        yield from self._split(columns, start.tolist(), first, policy)

    def _predict(self, belief: Tensor) -> Tensor:
        """`BeliefFilter.predict`, with sums whose order does not depend on how many rows there are."""
        return torch.from_numpy(np.ascontiguousarray((self._into @ np.ascontiguousarray(belief.numpy().T)).T))

    def _updated(self, predicted: Tensor, action: Tensor, following: dict[str, Tensor]) -> Tensor:
        """The belief after the step's observation."""
        located = following["steps_since_detection"] == 0
        return torch.where(
            located[:, None], self._filter.detect(following["last_cell"]), self._filter.miss(predicted, action)
        )

    def _split(self, columns: dict[str, Any], start: list[int], first: int, policy: int) -> Iterator[Episode]:
        """The steps of all episodes, as they were taken, as one `Episode` each."""
        rows = columns.pop("row")
        ends = columns.pop("terminated"), columns.pop("truncated")
        for row, seed in enumerate(self._seeds):
            mine = np.flatnonzero(rows == row)
            terminated, truncated = (bool(flag[mine[-1]]) for flag in ends)
            steps = {name: column[mine] for name, column in columns.items()}
            yield Episode(first + row, seed, policy, start[row], terminated=terminated, truncated=truncated, **steps)


def _step(
    running: Tensor,
    state: dict[str, Tensor],
    action: Tensor,
    probability: Tensor | None,
    predicted: Tensor,
    following: dict[str, Tensor],
) -> dict[str, Tensor]:
    """One step of all rows, `[B, ...]`."""
    step = {
        "running": running,
        "misses": state["steps_since_detection"],
        "action": action,
        "belief": predicted,
        "target": following["target"],
        "after": following["steps_since_detection"],
        "reward": following["reward"],
        "terminated": following["terminated"],
        "truncated": following["truncated"],
    }
    return step if probability is None else step | {"probability": probability}


def _kept(steps: list[dict[str, Tensor]]) -> dict[str, Any]:
    """What an `Episode` holds of some steps, for the rows that were running; step after step."""
    running = torch.stack([step["running"] for step in steps])
    kept = {name: torch.stack([step[name] for step in steps])[running] for name in steps[0] if name != "running"}
    exited = kept["terminated"].squeeze(-1)
    kept["row"] = running.nonzero()[:, 1]
    kept["located"] = (kept.pop("after") == 0) & ~exited
    kept["belief"] = kept["belief"].float()
    kept.setdefault("probability", kept["action"].float())
    kept |= {"terminated": exited, "truncated": kept["truncated"].squeeze(-1), "reward": kept["reward"].squeeze(-1)}
    return {name: value.numpy() for name, value in kept.items()}
