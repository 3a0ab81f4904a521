"""Peers beside ours: a script that only pretends to learn stands for one."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.solvers.worlds import paper_world
from trackmdp.app.bench.peers import Learned
from trackmdp.app.bench.process import Usage
from trackmdp.app.cli import main

SCRIPTS = Path(__file__).parents[3] / "scripts/peers"

PEER = """
import sys, numpy as np
instance, record, *words = sys.argv[1:]
assert dict(zip(words[::2], words[1::2])) == {"--seed": "3", "--seconds": "7.0"}
at = np.load(instance)
assert at["kernel"].shape == (25, 25) and (at["cost"] == 0.2).all() and at["t_max"] == 0
every, none = np.ones((25, 1, 25), bool), np.zeros((25, 1, 25), bool)
best = (at["kernel"] > 0)[:, None]
np.savez(record, seconds=[1.0, 2.0, 3.0], steps=[10, 20, 30], sets=[np.packbits(s) for s in (none, every, LAST)])
print("said to nobody")
"""


def peers(folder: Path) -> Path:
    folder.mkdir()
    (folder / "good_peer.py").write_text(PEER.replace("LAST", "best"))
    (folder / "lost_peer.py").write_text(PEER.replace("LAST", "none"))
    (folder / "common.py").write_text("raise SystemExit('not a peer')")
    return folder


def learned(*regrets: float) -> Learned:
    return Learned("a", 0, [(1.0 + at, 10 * at, regret) for at, regret in enumerate(regrets)], Usage(9.0, 9.0, 9.0))


def test_settled_is_when_the_regret_stays_at_the_goal_and_first_when_it_was_there_once() -> None:
    way = learned(0.5, 0.01, 0.3, 0.02, 0.01)
    assert (way.reached(settled=False), way.reached(settled=True)) == ((2.0, 10), (4.0, 30))
    assert learned(0.01, 0.03).reached(settled=True) == (None, None)
    assert learned(0.01, 0.03).reached(settled=False) == (1.0, 0)
    assert learned(0.4).reached(settled=False) == (None, None)


@pytest.mark.slow
def test_ours_and_the_peers_take_turns_and_are_timed_alike(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    world = ["kernel.support_size=4", "cost.sensor=0.2", "grid.t_max=0", "grid.size=5"]
    words = ["part=peers", "seeds=[3]", "peers_seconds=7", f"peers={peers(tmp_path / 'peers')}", *world]
    assert main(["benchmark", *words, f"hydra.run.dir={tmp_path}/run"]) == 0
    rows = json.loads((tmp_path / "run" / "benchmark.json").read_text())["rows"]
    assert [(row["learner"].split()[0], row["seed"]) for row in rows] == [("trackmdp", 3), ("good", 3), ("lost", 3)]
    ours, good, lost = rows
    assert ours["times_ours"] == 1
    assert ours["last_regret"] < 0.005 < ours["goal"] == 0.02
    assert ours["first_seconds"] <= ours["settled_seconds"] < ours["wall_seconds"]
    # its record ends 3 s after learning began, whatever its process took besides
    assert good["settled_seconds"] == good["first_seconds"] == good["curve"]["seconds"][2]
    assert np.diff(good["curve"]["seconds"]).tolist() == pytest.approx([1.0, 1.0])
    assert good["settled_steps"] == 30
    assert good["curve"]["seconds"][2] == pytest.approx(good["wall_seconds"])
    # Of 25 sensors at .2 a step all cost 5; with none, the safe action costs as much every other step.
    assert good["curve"]["regret"][1] > good["curve"]["regret"][0] > 0.5
    assert lost["settled_seconds"] is lost["settled_steps"] is lost["times_ours"] is None
    assert lost["last_regret"] == pytest.approx(good["curve"]["regret"][0])
    out = capfd.readouterr().out
    assert "said to nobody" not in out


def test_a_folder_without_peers_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["part=peers", f"peers={tmp_path}", f"hydra.run.dir={tmp_path}/run"]
    assert main(["benchmark", *words]) == 2
    assert f"peers={tmp_path}: expected a folder with scripts called <name>_peer.py" in capsys.readouterr().err


@pytest.fixture(scope="module")
def track() -> ModuleType:
    spec = importlib.util.spec_from_file_location("track", SCRIPTS / "track.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["track"] = module
    spec.loader.exec_module(module)
    return module


def test_the_peers_instance_moves_the_target_as_the_kernel_does(track: ModuleType, tmp_path: Path) -> None:
    world = paper_world(5, 0.22, 1)
    kernel = world.kernel.toarray()
    np.savez(tmp_path / "at.npz", kernel=kernel, cost=world.cost, safe_cost=world.safe_cost, reward=1.0, t_max=1)
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


def test_the_record_leaves_out_what_recording_takes(
    track: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = paper_world(5, 0.22, 1)
    kernel = world.kernel.toarray()
    np.savez(tmp_path / "at.npz", kernel=kernel, cost=world.cost, safe_cost=22.0, reward=1.0, t_max=1)
    now = [0.0]
    monkeypatch.setattr(track.time, "perf_counter", lambda: now[0])

    def slow(shown: np.ndarray) -> np.ndarray:
        now[0] += 50.0
        return np.zeros((len(shown), 100), bool)

    record = track.Record(track.Instance(str(tmp_path / "at.npz")), str(tmp_path / "record.npz"), seconds=2.5)
    steps = 0
    while record.keep(slow, steps):
        now[0] += 0.75
        steps += 1
    record.save()
    with np.load(tmp_path / "record.npz", allow_pickle=False) as stored:
        assert stored["seconds"].tolist() == [0.0, 1.5, 3.0]  # due every second, and at the end
        assert stored["steps"].tolist() == [0, 2, 4]
