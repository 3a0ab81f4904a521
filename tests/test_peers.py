"""Peers beside our learners: a script that only pretends to learn stands for one."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from benchmarks.clock import Usage
from benchmarks.peers import Learned
from benchmarks.words import main

from tests.solvers.worlds import paper_world

SCRIPTS = Path(__file__).parents[1] / "scripts"

PEER = """
import sys, numpy as np
instance, record, *words = sys.argv[1:]
assert dict(zip(words[::2], words[1::2])) == {"--seed": "3", "--seconds": "7.0"}
at = np.load(instance)
assert at["kernel"].shape == (25, 25) and (at["cost"] == 0.2).all() and at["t_max"] == 0
every, none = np.ones((25, 1, 25), bool), np.zeros((25, 1, 25), bool)
best = (at["kernel"] > 0)[:, None]
sets = [np.packbits(s) for s in (none, every, LAST)]
np.savez(record, seconds=[1.0, 2.0, 3.0], steps=[10, 20, 30], sets=sets)
print("said to nobody")
"""


def peers(folder: Path) -> Path:
    folder.mkdir()
    (folder / "good_peer.py").write_text(PEER.replace("LAST", "best"))
    (folder / "lost_peer.py").write_text(PEER.replace("LAST", "none"))
    (folder / "common.py").write_text("raise SystemExit('not a peer')")
    return folder


def learned(*regrets: float) -> Learned:
    return Learned(
        "a",
        0,
        [(1.0 + at, 10 * at, regret) for at, regret in enumerate(regrets)],
        Usage(9.0, 9.0, 9.0),
    )


def test_settled_is_when_the_regret_stays_at_the_goal_and_first_when_it_was_there_once() -> None:
    way = learned(0.5, 0.01, 0.3, 0.02, 0.01)
    assert (way.reached(settled=False), way.reached(settled=True)) == ((2.0, 10), (4.0, 30))
    assert learned(0.01, 0.03).reached(settled=True) == (None, None)
    assert learned(0.01, 0.03).reached(settled=False) == (1.0, 0)
    assert learned(0.4).reached(settled=False) == (None, None)


@pytest.mark.slow
def test_ours_and_the_peers_take_turns_and_are_timed_alike(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    world = ["kernel.support_size=4", "cost.sensor=0.2", "grid.t_max=0", "grid.size=5"]
    out = tmp_path / "out.json"
    words = [
        "part=peers",
        "seeds=[3]",
        "peers_seconds=7",
        "algos=[hindsight]",
        f"peers={peers(tmp_path / 'peers')}",
        f"out={out}",
        *world,
    ]
    assert main(words) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [(row["learner"].split()[0], row["seed"]) for row in rows] == [
        ("trackmdp", 3),
        ("good", 3),
        ("lost", 3),
    ]
    ours, good, lost = rows
    assert ours["times_first"] == 1
    assert ours["settled_steps"] > 0
    assert ours["last_regret"] < 0.005 < ours["goal"] == 0.02
    # Learning begins with the first record, after the imports.
    assert 0 < ours["learning_seconds"] < ours["settled_seconds"] <= ours["cpu_seconds"]
    assert good["curve"]["seconds"] == [1.0, 2.0, 3.0]
    assert good["settled_seconds"] == good["first_seconds"] == 3.0
    assert (good["first_steps"], good["settled_steps"], good["learning_seconds"]) == (30, 30, 2.0)
    # Of 25 sensors at .2 a step all cost 5; with none, the safe action costs as much every other step.
    assert good["curve"]["regret"][1] > good["curve"]["regret"][0] > 0.5
    assert lost["settled_seconds"] is lost["settled_steps"] is lost["times_first"] is None
    assert lost["last_regret"] == pytest.approx(good["curve"]["regret"][0])
    out = capfd.readouterr().out
    assert "said to nobody" not in out


@pytest.fixture(scope="module")
def track() -> ModuleType:
    spec = importlib.util.spec_from_file_location("track", SCRIPTS / "peers/track.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["track"] = module
    spec.loader.exec_module(module)
    return module


def test_the_peers_instance_moves_the_target_as_the_kernel_does(
    track: ModuleType, tmp_path: Path
) -> None:
    world = paper_world(5, 0.22, 1)
    kernel = world.kernel.toarray()
    np.savez(
        tmp_path / "at.npz",
        kernel=kernel,
        cost=world.cost,
        safe_cost=world.safe_cost,
        reward=1.0,
        t_max=1,
    )
    at = track.Instance(str(tmp_path / "at.npz"))
    grid = (np.arange(20_000) + 0.5) / 20_000  # in place of uniform draws
    for cell in (0, 44, 99):
        number = (grid[:, None] > at.cumulated[cell]).sum(axis=1)
        inside = number < at.cumulated.shape[1]
        found = np.bincount(at.cells[cell, number[inside]], minlength=100) / len(grid)
        assert found == pytest.approx(kernel[cell], abs=1e-3)

    def greedy(shown: np.ndarray) -> np.ndarray:
        assert shown.shape == (100, 100 + 3 + 200)
        rows, missed = shown[:, :100].argmax(axis=1), shown[:, 100:103].argmax(axis=1)
        first = shown[:, 103:203].astype(bool)
        near = kernel[rows] > 0
        return np.where(missed[:, None] == 0, near, ~first)

    sets = at.table(greedy)
    assert (sets[:, 0] == (kernel > 0)).all()
    assert (sets[:, 1] == ~sets[:, 0]).all()


def test_the_record_is_in_cpu_seconds_without_those_of_recording(
    track: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [20.0]  # of imports
    monkeypatch.setattr(track.time, "process_time", lambda: now[0])

    def slow() -> np.ndarray:
        now[0] += 50.0
        return np.zeros((100, 2, 100), bool)

    def recorded(last: int) -> tuple[list[float], list[int]]:
        record = track.Record(str(tmp_path / "record.npz"), seconds=2.5, every=1.0)
        for steps in range(last + 1):
            if not record.keep(slow, steps, last=steps == last):
                break
            now[0] += 0.75
        record.save()
        with np.load(tmp_path / "record.npz", allow_pickle=False) as stored:
            return stored["seconds"].tolist(), stored["steps"].tolist()

    # Due every second, and at the end of the time.
    assert recorded(9) == ([20.0, 21.5, 23.0], [0, 2, 4])
    now[0] = 20.0
    assert recorded(3) == ([20.0, 21.5, 22.25], [0, 2, 3])
