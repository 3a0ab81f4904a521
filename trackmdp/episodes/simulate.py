"""Simulating episodes in batches, each from its own generators, so that any one can be simulated again by itself.

The log, the web page, the picture and the simulated figures of an evaluation are all made of this module's `Episodes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

import numpy as np
import torch
from torch import Tensor

from trackmdp.arrays.numbers import whole_number
from trackmdp.environment.paths import PathSampler, path_sampler
from trackmdp.episodes.actors import Actor, States, actor_of
from trackmdp.episodes.batch import Episodes
from trackmdp.episodes.episode_draws import Columns, Draws, joined, narrow, uniform
from trackmdp.episodes.group_episodes import GroupEpisodes, batches
from trackmdp.machine import check_free
from trackmdp.policies.acting import Playback
from trackmdp.policies.policy import PolicyLike
from trackmdp.seeding import derive, preserved_global_rng
from trackmdp.sensing.outcomes import Costs, Outcomes
from trackmdp.solvers.evaluate import group_rule, of_single
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.value import check_revealed
from trackmdp.world.group import Group, Subject, check_problem
from trackmdp.world.problem import Problem


@overload
def simulate(
    problem: Problem,
    policy: PolicyLike | Playback,
    episodes: int,
    *,
    seed: int = ...,
    names: Sequence[str | int] = ...,
) -> Episodes: ...
@overload
def simulate(
    problem: Group,
    policy: PolicyLike | Rule,
    episodes: int,
    *,
    seed: int = ...,
    names: Sequence[str | int] = ...,
    merge: str | None = ...,
) -> GroupEpisodes: ...


def simulate(
    problem: Subject,
    policy: PolicyLike | Playback | Rule,
    episodes: int,
    *,
    seed: int = 0,
    names: Sequence[str | int] = (),
    **of_group: Any,
) -> Episodes:
    """Independent episodes of a policy, each followed to its own end.

    Keeping the first ones to finish would favour short episodes; here every episode that is begun is kept.

    Args:
        problem: a world, in which targets start uniformly; recorded tracks, of which held-out ones are drawn; or a
            `Group` of targets.
        policy: as for `evaluate`; a function or module is asked at every step if it draws, and is then the only
            thing not reproduced by an episode's seed alone.
        episodes: how many.
        seed: seed of the run; episode i has the seed called ("episode", *names, i) of it.
        names: further names of the seeds, different for each simulation of a run.
        **of_group: of a `Group` alone: `merge`, "gains" or "union", as of `evaluate`.

    Raises:
        UserError: the policy is made for another grid, or is no policy; `episodes` or `seed` is no such number.
    """
    check_problem(problem, "simulate")
    whole_number("simulate: episodes", episodes, 0)
    if isinstance(problem, Group):
        policy = group_rule(problem, policy, **of_group)
    else:
        policy = of_single(problem, policy, **of_group)

    def first(count: int) -> Any:
        return resimulate(problem, policy, episode_seeds(seed, count, *names))

    if episodes > _MANY:
        tried = first(_TRIED)
        each = _COPIES * tried.nbytes / _TRIED + _SEED
        check_free(f"simulate: episodes={episodes}", episodes * each)
    return first(episodes)


_MANY, _TRIED = 2**16, 64
"""Episodes from which on the memory is looked at first; and simulated for that."""
_COPIES, _SEED = 2, 44
"""Times that the steps are held while their parts are joined; bytes of an episode's seed."""


def episode_seeds(seed: int, episodes: int, *names: str | int) -> list[int]:
    """The seeds of a run's episodes."""
    return [derive(seed, "episode", *names, number) for number in range(episodes)]


@torch.no_grad()
def resimulate(problem: Subject, policy: PolicyLike | Playback | Rule, seeds: Sequence[int]) -> Any:
    """`Episodes` or `GroupEpisodes`: one episode for each of `seeds`, in their order, each independent of the others.

    See `simulate`.
    """
    if isinstance(policy, Rule):
        # Of no episode one is simulated, as below.
        columns = [each.run() for each in batches(policy, seeds or [0])]
        return GroupEpisodes.of(policy.group, policy, seeds, columns)
    assert not isinstance(problem, Group)
    outcomes, sampler = Outcomes(problem), path_sampler(problem, held_out=True)
    actor = actor_of(problem.task, policy, Costs(problem))
    if actor.policy is not None:
        check_revealed(problem.motion, actor.policy)
    some = seeds or [0]  # of no episode one is simulated, for the types of its columns
    at_once = [
        some[begin : begin + actor.most_rows] for begin in range(0, len(some), actor.most_rows)
    ]
    with preserved_global_rng():
        # Draws of a function or module from torch's global generator are then the same in every call.
        torch.manual_seed(derive(some[0], "policy"))
        parts = [_Batch(problem, sampler, actor, outcomes, each).run() for each in at_once]
    return Episodes.of(problem, actor.policy, seeds, parts)


class _Batch:
    """Episodes stepped together; each leaves the batch with its end."""

    def __init__(
        self,
        problem: Problem,
        sampler: PathSampler,
        actor: Actor,
        outcomes: Outcomes,
        seeds: Sequence[int],
    ) -> None:
        self._task, self._sampler, self._actor = problem, sampler, actor
        self._outcomes = outcomes
        # A policy has keys of its own; all other actors know the cell.
        self._keys = (actor.policy.task if actor.policy else problem.remembering()).keys
        # Moves, choices and reports apart, so that two policies with one seed meet the same target.
        self._moves, self._choices, self._seen = Draws(seeds, sampler.draw), None, None
        if size := actor.num_draws:
            self._choices = uniform(seeds, "policy", size, dtype=torch.float32)
        if not outcomes.certain:
            self._seen = uniform(seeds, "report")
        self._taken: list[Columns] = []

    def run(self) -> Columns:
        """Step until the last episode has ended; the columns of `Episodes`, those of one episode after another's."""
        # Before any move.
        starts = [
            torch.randint(self._sampler.starts, (1,), generator=rng)
            for rng in self._moves.generators
        ]
        place = self._sampler.begin(torch.cat(starts))
        start, mode = self._sampler.cell(place), self._sampler.mode(place)
        key = self._keys.start(start, mode)
        at = States(torch.arange(len(start)), place, start, key, torch.zeros_like(start), step=0)
        while len(at.row):
            at = self._step(at)
        columns, length = joined(self._taken)
        start_mode = 0 * start if mode is None else mode
        begun = {"start": start.numpy(), "start_mode": start_mode.numpy()}
        return columns | begun | {"length": length}

    def _step(self, at: States) -> States:
        """One step of `TrackEnv`, of the episodes still running; the same order of events, the same arithmetic."""
        choice = self._actor.decide(
            at, None if self._choices is None else self._choices.at(at.row, at.step)
        )
        place = self._sampler.move(at.place, self._moves.at(at.row, at.step))
        target = self._sampler.cell(place)
        # A target that exited is at M, which is no column: it looks up the last cell, and the answer is not used.
        report = choice.report(target.clamp_max(self._task.num_cells - 1))
        seen = None if self._seen is None else self._seen.at(at.row, at.step)
        outcome = self._outcomes(report, choice.spent, at.misses, target, seen)
        in_grid, located = outcome.in_grid, outcome.located
        # An exit on the last step allowed is an exit (terminated), not a truncation.
        truncated = self._truncated(place, at.step) & in_grid
        mode = self._sampler.mode(place)
        columns = {"misses": at.misses, "target": target, "located": located}
        columns |= {"reward": outcome.reward, "row": at.row, "sensors": choice.count}
        columns |= {"truncated": truncated}
        if self._keys.num_classes > 1:
            columns["key"] = at.key
        if mode is not None:
            columns["mode"] = mode
        taken = {name: narrow(column.numpy()) for name, column in columns.items()}
        if choice.action is not None:
            taken["bits"] = np.packbits(choice.action.numpy(), axis=-1)
        self._taken.append(taken)
        # `[R']`, the positions of those still running: only they are carried over, so that a step's cost falls as
        # episodes end.
        going_on = (in_grid & ~truncated).nonzero().squeeze(-1)
        last_cell = torch.where(located, target, at.last_cell)
        known = self._keys.next(at.key, at.misses, target.clamp_max(self._task.num_cells - 1), mode)
        key = torch.where(located, known, at.key)
        misses = self._outcomes.misses_after(at.misses, outcome)
        return States(at.row, place, last_cell, key, misses, at.step + 1).kept(going_on)

    def _truncated(self, place: Tensor, step: int) -> Tensor:
        """`[R]` whether this step is the last one allowed, or the last one recorded."""
        last = self._task.max_steps is not None and step + 1 >= self._task.max_steps
        stops = self._sampler.stops(place)
        return torch.full_like(place, last, dtype=torch.bool) if stops is None else stops | last
