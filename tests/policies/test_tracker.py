"""A tracker chooses as simulated episodes and the environment do, step by step."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import trackmdp as tm
from tests.episodes.logs import WORLD
from tests.helpers import headings, hop_world, later, small_world
from tests.solvers.worlds import footprint_world
from trackmdp.episodes.episode import Episode
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World
from trackmdp.world.problem import Problem


def missing(**more: Any) -> World:
    """Sensors that miss; with `safe_detection` the safe action does, too."""
    chances = {"detection": np.linspace(0.4, 1, 16), **more}
    return World.of(WORLD, WORLD.kernel, **chances)


WORLDS: dict[str, Problem] = {
    "paper": WORLD,
    "window": World.of(WORLD, WORLD.kernel, window=1),
    "misses": missing(safe_detection=0.6),
    "keys": headings(4, memory="two_displacements", t_max=2),
    "gaps": headings(4, memory="displacement_gap", t_max=2),
    "keys and misses": missing(memory="displacement_gap"),
    "mode": tm.make_world("heading", size=3, reveals=True, t_max=2),
    "footprints": footprint_world(3),
    # Each cell but the first two is seen by two sensors, which both miss.
    "faint cells": missing(coverage=np.eye(16) * 0.6),
    "faint footprints": missing(coverage=(np.eye(16) + np.eye(16, k=2)) * 0.6, safe_detection=0.6),
}


def some(world: Problem, seed: int = 5) -> Policy:
    """Some of the sensors that can be chosen."""
    task = world.task
    shape = (task.num_keys, task.num_choices, task.total_sensors)
    wanted = np.random.default_rng(seed).random(shape) < 0.4
    return Policy.from_dense(task, wanted & Policy.all_on(task).dense())


def followed(tracker: tm.Tracker, episode: Episode, world: Problem) -> None:
    """Drive a tracker through an episode, and compare each of its sets with the recorded one."""
    everything = list(range(world.total_sensors))
    told = episode.mode is not None and world.revealed > 1
    for t in range(len(episode)):
        assert tracker.misses == episode.misses[t]
        assert tracker.cell == episode.last_cell[t]
        assert tracker.safe == (episode.misses[t] > world.t_max)
        assert not any(tracker.sees(cell) for cell in range(world.num_cells))
        chosen = np.flatnonzero(episode.action[t]).tolist()
        assert tracker.sensors() == (everything if tracker.safe else chosen)
        seen = world.covered(episode.action[t]) | tracker.safe
        assert [tracker.sees(cell) for cell in range(world.num_cells)] == seen.tolist()
        if episode.target[t] == world.num_cells:
            tracker.exited()
        elif episode.located[t]:
            mode = int(episode.mode[t]) if told and episode.mode is not None else None
            tracker.report(int(episode.target[t]), mode=mode)
        else:
            tracker.report(None)


@pytest.mark.parametrize("name", WORLDS)
def test_it_chooses_as_simulated_episodes_do(name: str) -> None:
    world = WORLDS[name]
    policy = some(world)
    episodes = tm.simulate(world, policy, 40, seed=1)
    assert len({int(n) for n in episodes.misses}) > 1
    for episode in episodes:
        mode = episode.start_mode if world.revealed > 1 else None
        followed(policy.tracker(episode.start, mode=mode), episode, world)


@pytest.mark.parametrize("name", ["paper", "misses", "gaps", "keys and misses"])
def test_its_memory_is_that_of_the_environment(name: str) -> None:
    world = WORLDS[name]
    policy, env = some(world), tm.TrackEnv(world, seed=4)
    for _ in range(10):
        state = env.reset()
        tracker, done = policy.tracker(int(state["last_cell"])), False
        while not done:
            assert tracker.misses == int(state["steps_since_detection"])
            assert tracker.key == int(state.get("key", state["last_cell"]))
            state = policy(state)
            on = tracker.sensors()
            assert tracker.safe or on == torch.nonzero(state["action"])[:, 0].tolist()
            state = env.step(state)["next"]
            done = bool(state["done"])
            found = int(state["steps_since_detection"]) == 0
            if not done:
                tracker.report(int(state["last_cell"]) if found else None)


def test_by_hand() -> None:
    """T_max 1: two misses in a row, then the safe action, which may be repeated, until a report."""
    tracker = Policy.from_dense(hop_world(), np.eye(4, dtype=bool)[:, None].repeat(2, 1)).tracker(2)
    for on, safe in ([2], False), ([2], False), ([0, 1, 2, 3], True), ([0, 1, 2, 3], True):
        assert (tracker.sensors(), tracker.safe) == (on, safe)
        assert tracker.sensors() == on  # asked twice: the same
        tracker.report(None)
    assert tracker.sensors() == [0, 1, 2, 3]
    tracker.report(1)
    assert (tracker.cell, tracker.misses, tracker.sensors()) == (1, 0, [1])


@given(st.integers(0, 10**6), st.integers(0, 39), st.integers(1, 30))
def test_a_tracker_goes_on_from_its_state(seed: int, number: int, at: int) -> None:
    """Whatever the policy draws, and whether the sensors are already on; the state is plain JSON."""
    world = WORLDS["keys and misses"]
    policy = Policy.from_dense(
        world, np.random.default_rng(seed).random((world.num_keys, 3, 16)) * 0.6
    )
    first = policy.tracker(number % 16, seed=seed)
    for step in range(at):
        on = first.sensors()
        first.report(on[0] if on and step % 3 else None)
    if seed % 2:
        first.sensors()
    again = tm.Tracker.restore(policy, json.loads(json.dumps(first.state())))
    for _ in range(5):
        assert again.sensors() == first.sensors()
        for each in (first, again):
            each.report(None)
    assert again.state() == first.state()


def test_exactly_k_sensors_of_the_window_are_drawn() -> None:
    world = WORLDS["window"]
    policy, near = Policy.random_k(world.task, 3), {0, 1, 2, 4, 5, 6, 8, 9, 10}
    drawn = [tuple(policy.tracker(5, seed=seed).sensors()) for seed in range(50)]
    assert all(len(set(each)) == 3 and set(each) <= near for each in drawn)
    assert len(set(drawn)) > 20


@pytest.mark.parametrize("probability", [0.0, 0.25, 1.0])
def test_each_step_draws_its_own_sensors(probability: float) -> None:
    """Of 1,600 sensors in 100 steps the share of the probability, up to four standard errors."""
    tracker, drawn = Policy(WORLD.task, probability=probability).tracker(3), []
    for _ in range(100):
        drawn.append(tuple(tracker.sensors()))
        tracker.report(drawn[-1][0] if drawn[-1] else None)
        if tracker.safe:
            tracker.sensors()
            tracker.report(3)
    share = sum(map(len, drawn)) / 1600
    assert abs(share - probability) <= 4 * (probability * (1 - probability) / 1600) ** 0.5
    assert len(set(drawn)) > 90 or probability in (0.0, 1.0)


def test_it_works_without_torch() -> None:
    from tests.test_front_door import after

    code = (
        "import sys, trackmdp as tm\n"
        "from trackmdp.policies.table import PolicyTable\n"
        "world = tm.make_world(size=3)\n"
        "on = tm.Tracker(PolicyTable.all_on(world), 4).sensors()\n"
        "found = [on, 'torch' in sys.modules]"
    )
    assert after(code) == [list(range(9)), False]


@pytest.mark.parametrize("name", ["paper", "mode", *later(["keys", "footprints", "faint cells"])])
def test_a_file_of_onnx_acts_as_the_policy_without_torch(name: str, tmp_path: Path) -> None:
    """Its whole episode: memory, modes, footprints and misses are the tracker's, the sets those of the file."""
    pytest.importorskip("onnxruntime")
    from tests.test_front_door import after

    world = WORLDS[name]
    policy, file = some(world), tmp_path / "policy.onnx"
    tm.export(policy, file)
    known = world.revealed > 1
    for episode in tm.simulate(world, policy, 5, seed=3):
        mode = episode.start_mode if known else None
        followed(tm.Tracker(file, episode.start, mode=mode, world=world), episode, world)
    cell, more = (3, {"mode": 1}) if known else (3, {})
    code = (
        "import sys, trackmdp as tm\n"
        f"tracker = tm.Tracker({str(file)!r}, {cell}, **{more})\n"
        "others = [name for name in ('torch', 'trackmdp.solvers', 'trackmdp.algos') if name in sys.modules]\n"
        "found = [tracker.sensors(), others]"
    )
    assert after(code) == [policy.tracker(cell, **more).sensors(), []]


@pytest.mark.parametrize("content", [b"", b"no model"])
def test_a_file_that_is_no_policy_is_one_line(content: bytes, tmp_path: Path) -> None:
    for name in ("policy.onnx", "policy.npz"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=name) as caught:
            tm.Tracker(tmp_path / name, 0)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fact", [{"rows": "6"}, {"modes": "2"}, {"clip": "10000000000"}])
def test_a_model_of_onnx_that_its_metadata_does_not_fit_is_refused_at_once(
    fact: dict[str, str], tmp_path: Path
) -> None:
    """Not at the first step after a detection that it has no row for."""
    pytest.importorskip("onnxruntime")
    import onnx

    file, world = tmp_path / "policy.onnx", WORLDS["keys"]
    tm.export(some(world), file)
    model = onnx.load(file)
    facts = {each.key: each.value for each in model.metadata_props}
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, facts | fact)
    onnx.save(model, file)
    with pytest.raises(UserError, match=r"policy\.onnx: "):
        tm.Tracker(file, 0)


@pytest.mark.parametrize(
    "name", ["paper", "misses", "keys", "mode", "footprints", "faint footprints"]
)
def test_its_belief_is_that_of_the_log(name: str) -> None:
    """The log holds the belief after the move, before its report; one step earlier this is the tracker's, moved on."""
    world = WORLDS[name]
    policy, modes = some(world), world.kernel.shape[0] // world.num_cells
    for episode in tm.simulate(world, policy, 6, seed=2).complete():
        known = world.revealed > 1
        start = episode.start_mode if known else None
        tracker = policy.tracker(episode.start, mode=start, world=world)
        for t in range(len(episode)):
            moved = world.kernel.T @ tracker._belief[0]
            assert episode.belief[t] == pytest.approx(moved.reshape(-1, modes).sum(1), abs=1e-6)
            assert tracker.belief().sum() == pytest.approx(1)
            tracker.sensors()
            if episode.target[t] == world.num_cells:
                break
            tracker = tm.Tracker.restore(policy, json.loads(json.dumps(tracker.state())), world)
            found = int(episode.target[t]) if episode.located[t] else None
            mode = int(episode.mode[t]) if known and found is not None else None
            tracker.report(found, mode=mode)
            if found is not None:
                assert tracker.belief()[found] == pytest.approx(1)


def test_belief_needs_a_motion() -> None:
    with pytest.raises(UserError, match=r"belief\(\): the motion is not known"):
        begun().belief()
    for footprints in (np.ones((2, 9)), np.eye(9)[::-1]):  # as many sensors as cells, and others
        with pytest.raises(UserError, match=r"World of 3 x 3 cells.* and 9 sensors"):
            begun(world=small_world().but(coverage=footprints, cost=0.1))
    for other in (WORLD, small_world().but(t_max=0)):
        with pytest.raises(UserError, match="expected a World of 3 x 3 cells"):
            begun(world=other)
    with pytest.raises(UserError, match="tracker: world: 1 modes, expected 8"):
        some(WORLDS["mode"]).tracker(0, mode=1, world=small_world().but(t_max=2))
    tracker = begun(world=small_world())
    for belief in ([1.0], ["x"] * 9, [[1 / 9]] * 9, [None] * 9, [float("nan")] * 9, [1e308] * 9, 3):
        state = tracker.state() | {"belief": belief}
        with pytest.raises(UserError, match="state: belief, expected 9 probabilities"):
            tm.Tracker.restore(Policy.all_on(small_world()), state, small_world())
    tracker.exited()
    with pytest.raises(UserError, match="the target has exited"):
        tracker.belief()


def test_what_cannot_happen_leaves_a_belief_that_is_finite() -> None:
    """A target that stays is reported elsewhere, and missed under its own sensor."""
    world = World(np.eye(4) * 0.5, 2, cost=0.1, t_max=1)
    tracker = Policy.all_on(world).tracker(0, world=world)
    tracker.sensors()
    tracker.report(3)
    assert tracker.belief().tolist() == [0, 0, 0, 1]
    tracker.sensors()
    tracker.report(None)
    assert tracker.belief().tolist() == [0, 0, 0, 1]


def test_a_target_that_must_have_left_is_followed_from_a_state() -> None:
    """It is in the last of two cells and moves on, yet it is said to be missed: no cell is left to it."""
    world = World(np.eye(2, k=1), (1, 2), cost=0.1)
    policy = Policy.none(world)
    tracker = policy.tracker(1, world=world)
    tracker.sensors()
    tracker.report(None)
    again = tm.Tracker.restore(policy, json.loads(json.dumps(tracker.state())), world)
    assert again.belief().tolist() == [0, 0]


def test_positions_are_those_of_the_cells_sensed() -> None:
    world = tm.make_world("drift", size=4, cell=10.0, origin=(0, 0))
    tracker = tm.solve(world).policy.tracker(at=(15, 15))
    assert tracker.positions() == [world.place_of(cell) for cell in tracker.sensors()]
    with pytest.raises(UserError, match="the place of the grid is not known"):
        begun().positions()


def begun(**more: Any) -> tm.Tracker:
    """In cell 4 of 3 x 3 cells, of whose sensors those of cells 0 and 4 are on."""
    table = np.zeros((9, 2, 9), dtype=bool)
    table[..., [0, 4]] = True
    tracker = Policy.from_dense(small_world(), table).tracker(4, **more)
    tracker.sensors()
    return tracker
