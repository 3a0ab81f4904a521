"""Keys: by hand, and as the environment keeps them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from tests.tracks import by_hand, recorded
from trackmdp.config.world import MEMORIES
from trackmdp.environment.env import TrackEnv
from trackmdp.errors import UserError
from trackmdp.memory.keys import KeySpace
from trackmdp.sensing.task import Task

SIZE = (4, 5)  # cell = 5 row + column


def space(memory: str, clip: int = 1, modes: int = 1) -> KeySpace:
    return KeySpace(SIZE, 1, memory, clip, modes)


def test_keys_by_hand() -> None:
    """From cell 6 (1, 1) to 13 (2, 3): one down, two right, clipped to (1, 1), number 8 of 9; then up to 8 (1, 3)."""
    cell = space("cell")
    assert (cell.num_keys, cell.start(6), cell.next(6, 1, 13), cell.cell(13)) == (20, 6, 13, 13)
    last = space("displacement")
    assert last.num_keys == 20 * 10
    assert last.start(6) == 60
    assert last.next(np.int64(60), 1, np.int64(13)) == 13 * 10 + 1 + 8
    # Straight up is (-1, 0), number 1.
    assert last.next(np.int64(139), 0, np.int64(8)) == 8 * 10 + 1 + 1
    gap = space("displacement_gap")
    assert gap.num_classes == 1 + 3 * 9
    assert gap.next(np.int64(6 * 28), 1, np.int64(13)) == 13 * 28 + 1 + 9 + 8
    two = space("two_displacements")
    assert two.num_classes == 10 * 10
    first = two.next(np.int64(600), 0, np.int64(13))
    assert first == 13 * 100 + (1 + 8) * 10  # there is no earlier displacement: 0
    assert two.next(first, 1, np.int64(8)) == 8 * 100 + (1 + 1) * 10 + 1 + 8


def test_a_larger_clip_tells_displacements_apart_and_their_direction_stays() -> None:
    two = space("two_displacements", clip=2)
    assert two.num_classes == 26 * 10
    first = two.next(two.start(np.int64(6)), 0, np.int64(13))  # (1, 2): (1 + 2) 5 + (2 + 2) = 19
    assert first % two.num_classes == 20 * 10
    assert (
        two.next(first, 0, np.int64(13)) % two.num_classes == (12 + 1) * 10 + 1 + 8
    )  # stays: (0, 0); before (1, 1)


@pytest.mark.parametrize("keys", [*(space(each, 2) for each in MEMORIES), space("cell", modes=3)])
def test_its_recipe_makes_the_same_keys(keys: KeySpace) -> None:
    recipe, rng = keys.recipe(), np.random.default_rng(0)
    for key in rng.integers(keys.num_keys, size=500):
        cell, misses, mode = (int(rng.integers(count)) for count in (20, 3, keys.modes))
        known = {"key": int(key), "cell": cell, "misses": misses, "mode": mode}
        for name, made in (
            ("key_start", keys.start(np.int64(cell), mode)),
            ("key_next", keys.next(key, misses, np.int64(cell), mode)),
        ):
            found = dict(known)
            exec(recipe[name], {"max": max, "min": min}, found)
            assert found["key"] == made, name


@pytest.mark.parametrize("memory", MEMORIES)
def test_arrays_and_tensors_agree_and_keys_hold_their_cell(memory: str) -> None:
    keys, rng = space(memory, 2), np.random.default_rng(0)
    known, cells, misses = (
        rng.integers(keys.num_keys, size=500),
        rng.integers(20, size=500),
        rng.integers(3, size=500),
    )
    following = keys.next(known, misses, cells)
    assert (keys.cell(following) == cells).all()
    assert (following < keys.num_keys).all()
    assert (following >= 0).all()
    assert (keys.next(*map(torch.as_tensor, (known, misses, cells))).numpy() == following).all()


@pytest.mark.parametrize("memory", MEMORIES)
def test_contexts_leave_out_more_and_more(memory: str) -> None:
    """Keys that share a finer context share every coarser one."""
    keys = space(memory)
    contexts = keys.contexts(np.arange(keys.num_keys))
    assert (contexts[-1][0] == np.arange(keys.num_keys)).all()
    for (coarse, count), (fine, _) in itertools.pairwise(contexts):
        assert coarse.max() < count
        pairs = np.unique(np.stack([fine, coarse]), axis=1)
        assert len(np.unique(pairs[0])) == pairs.shape[1]


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_environment_keeps_the_key(memory: str) -> None:
    """Sensors on at random: the key changes at detections alone, to that of where and after what they were."""
    tracks = by_hand([0, 1, 4, 7, 8, 5, 2, 1, 0, 3], [4, 4, 5, 8, 7, 6])
    task = recorded(tracks, memory=memory, clip=1)
    env, generator = TrackEnv(task, 16, seed=3), torch.Generator().manual_seed(0)
    assert ("key" in env.observation_spec) == (memory != "cell")
    state = env.reset()
    key = task.keys.start(state["last_cell"])
    for _ in range(40):
        state["action"] = torch.rand(16, 9, generator=generator) < 0.4
        n = state["steps_since_detection"]
        frame, state = env.step_and_maybe_reset(state)
        after, ended = frame["next"], frame["next", "done"].squeeze(-1)
        located = (after["steps_since_detection"] == 0) & ~after["terminated"].squeeze(-1)
        key = torch.where(located, task.keys.next(key, n, after["last_cell"]), key)
        key = torch.where(ended, task.keys.start(state["last_cell"]), key)
        if memory != "cell":
            assert torch.equal(state["key"], key)


def test_a_task_of_an_unknown_memory_is_refused() -> None:
    with pytest.raises(UserError, match="memory=all: expected one of cell, displacement"):
        Task(3, cost=0.1, t_max=1, memory="all")
    for clip in (0, 9, 2**62):  # so many keys that their numbers would be no int64
        with pytest.raises(UserError, match=f"clip={clip}: expected an integer from 1 to 8"):
            Task(3, cost=0.1, t_max=1, memory="displacement", clip=clip)
