"""An exported policy acts as the policy does, in every state that can be reached, and without this package."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.training.runs import train
from trackmdp import machine
from trackmdp.app.cli import main
from trackmdp.arrays.types import BoolArray
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import read_sets
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task
from trackmdp.training.run import trained

INPUTS = """
import sys, numpy as np
states = np.load("states.npz")
cells, steps, first = states["cells"], states["steps"], str(states["first"])
"""
PROGRAMS = {
    "onnx": """
import onnxruntime
session = onnxruntime.InferenceSession("policy.onnx", providers=["CPUExecutionProvider"])
actions, = session.run(["action"], {first: cells, "steps_since_detection": steps})
about = session.get_modelmeta().custom_metadata_map
""",
    "pt2": """
import torch
files = {"about.txt": ""}
program = torch.export.load("policy.pt2", extra_files=files)
assert program.graph_signature.user_inputs == (first, "steps_since_detection")
actions = program.module()(torch.as_tensor(cells), torch.as_tensor(steps)).numpy()
about = dict(line.split(": ", 1) for line in files["about.txt"].splitlines())
""",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "run"
    train(folder, "grid.t_max=2", algo="hindsight")
    return folder


def reachable(chains: BoolArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every cell, every number of steps since a detection there, and the action: all sensors once it is forced."""
    m, choices, _ = chains.shape
    cells, steps = (
        grid.ravel() for grid in np.meshgrid(np.arange(m), np.arange(choices + 2), indexing="ij")
    )
    forced = (steps >= choices)[:, None]
    return cells, steps, chains[cells, np.minimum(steps, choices - 1)] | forced


FORMS = ["onnx", pytest.param("pt2", marks=pytest.mark.slow)]


def asked(form: str, run: Path, folder: Path, first: str) -> dict[str, str]:
    """Export a run, and compare all actions in a program without this package; returns the metadata that it reads."""
    assert main(["export", f"run={run}", f"format={form}", f"hydra.run.dir={folder}"]) == 0
    chains = trained(str(run), torch.device("cpu"))[1].dense()
    assert len(np.unique(chains.reshape(-1, chains.shape[2]), axis=0)) > 3
    cells, steps, actions = reachable(chains)
    np.savez(folder / "states.npz", cells=cells, steps=steps, first=first)
    program = INPUTS + PROGRAMS[form] + "np.savez('out.npz', actions=actions, **about)\n"
    program += "assert 'trackmdp' not in sys.modules\n"
    subprocess.run([sys.executable, "-c", program], cwd=folder, check=True)
    exported = dict(np.load(folder / "out.npz", allow_pickle=False))
    found = exported.pop("actions")
    assert found.dtype == np.bool_
    assert np.array_equal(found, actions)
    return {name: str(value) for name, value in exported.items()}


@pytest.mark.parametrize("form", FORMS)
def test_a_program_without_this_package_gets_the_same_sets(
    form: str, run: Path, tmp_path: Path
) -> None:
    about = asked(form, run, tmp_path, "last_cell")
    assert {about[name] for name in ("rows", "columns")} == {"3"}
    assert "key_next" not in about


@pytest.fixture(scope="module")
def remembering(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on 3 x 4 cells, whose policy remembers a displacement."""
    folder, parts = tmp_path_factory.mktemp("export") / "keys", {"size": (3, 4), "clip": 1}
    world = tm.make_world("heading", memory="displacement", cost=0.2, **parts)
    few = {"total_frames": 1024, "frames_per_batch": 512, "envs": 64, "updates": 4, "hidden": 8}
    tm.train(world, "hindsight", folder=folder, **few, **{"optimal.enabled": False})
    return folder


@pytest.mark.parametrize("form", FORMS)
def test_with_a_memory_the_input_is_a_key_whose_formula_is_in_the_metadata(
    form: str, remembering: Path, tmp_path: Path
) -> None:
    """Located in 1, missed once, then located in 6: (1, 1) down and across is number 8, class 9 of 10."""
    about = asked(form, remembering, tmp_path, "key")
    assert (about["rows"], about["columns"], about["memory"]) == ("3", "4", "displacement")
    known = {"cell": 1}
    exec(about["key_start"], {"max": max, "min": min}, known)
    assert known["key"] == 10
    known |= {"cell": 6, "misses": 1}
    exec(about["key_next"], {"max": max, "min": min}, known)
    assert known["key"] == 69


def test_the_safe_action_of_a_file_of_onnx_is_that_of_the_sensors_that_exist(
    tmp_path: Path,
) -> None:
    onnxruntime, file = pytest.importorskip("onnxruntime"), tmp_path / "policy.onnx"
    cost = np.full(9, 0.1)
    cost[3] = np.nan
    policy = Policy.none(tm.make_world("random_walk", size=3, t_max=0, cost=cost))
    tm.export(policy, file)
    missed = {"last_cell": np.array([0]), "steps_since_detection": np.array([1])}
    (action,) = onnxruntime.InferenceSession(file).run(["action"], missed)
    tracker = tm.Tracker(file, 0)
    tracker.sensors()
    tracker.report(None)
    assert tracker.safe
    assert tracker.sensors() == np.flatnonzero(action[0]).tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    assert tm.Tracker.restore(policy, tracker.state()).sensors() == tracker.sensors()


def test_sets_hold_the_formula_too(remembering: Path, tmp_path: Path) -> None:
    words = ["format=sets", "quiet=true", f"hydra.run.dir={tmp_path}"]
    assert main(["export", f"run={remembering}", *words]) == 0
    written = json.loads((tmp_path / "sets.json").read_text(encoding="utf-8"))
    assert written["memory"]["key_start"] == "key = cell * 10"
    policy = trained(str(remembering), torch.device("cpu"))[1]
    again = read_sets(policy.task, tmp_path / "sets.json")
    assert np.array_equal(again.dense(), policy.dense())


def test_sets_are_lists_of_cells(run: Path) -> None:
    assert main(["export", f"run={run}", "format=sets", "quiet=true"]) == 0
    written = json.loads((run / "sets.json").read_text(encoding="utf-8"))
    chains = trained(str(run), torch.device("cpu"))[1].dense()
    assert written["t_max"] == 2
    assert written["sets"]["4"] == [np.flatnonzero(on).tolist() for on in chains[4]]


def test_the_best_checkpoint_is_one_that_is_kept_beside_the_newest(
    run: Path, tmp_path: Path
) -> None:
    assert (
        main(
            ["export", f"run={run}", "format=sets", "checkpoint=best", f"hydra.run.dir={tmp_path}"]
        )
        == 0
    )
    best = trained(str(run), torch.device("cpu"), best=True)[1].dense()
    written = json.loads((tmp_path / "sets.json").read_text(encoding="utf-8"))
    assert written["sets"]["0"] == [np.flatnonzero(on).tolist() for on in best[0]]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "run: missing, expected the folder of a run"),
        (["run=nowhere"], "run=.*nowhere: no such folder"),
        (["run={run}", "format=pickle"], "format=pickle: expected one of onnx, pt2, sets, geojson"),
    ],
)
def test_mistakes_end_in_one_line(
    words: list[str],
    told: str,
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", *(word.format(run=run) for word in words)]) == 2
    assert re.fullmatch(f"trackmdp export: {told}\n", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


def test_sets_that_are_drawn_are_no_list(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="draws its sets"):
        tm.export(Policy.random_k(tm.make_world(size=3), 2), tmp_path / "sets.json")


def test_onnx_is_asked_for_by_name(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert main(["export", f"run={run}", "format=onnx"]) == 2
    assert "format=onnx: needs onnx, which pip install" in capsys.readouterr().err


@pytest.mark.parametrize("ending", ["onnx", "pt2"])
def test_a_table_that_does_not_fit_is_refused_before_it_is_made(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """80 x 80 cells, three rows of 6,400 sensors for each: 123 MB, in memory several times."""
    task = Task(80, cost=0.1)
    policy = Policy.from_table(PolicyTable(task, probability=0.0))
    monkeypatch.setattr(machine, "free_bytes", lambda: 2**28)
    with pytest.raises(UserError, match=r"122,880,000 entries: needs about 0\.46 GiB"):
        tm.export(policy, tmp_path / f"policy.{ending}")
    assert not list(tmp_path.iterdir())
