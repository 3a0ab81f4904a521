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

from tests.training.runs import train
from trackmdp.app.cli import main
from trackmdp.training.run import trained
from trackmdp.world.model import BoolArray

PROGRAMS = {
    "onnx": """
import onnxruntime
session = onnxruntime.InferenceSession("policy.onnx", providers=["CPUExecutionProvider"])
actions, = session.run(["action"], {"last_cell": cells, "steps_since_detection": steps})
""",
    "torch_export": """
import torch
policy = torch.export.load("policy.pt2").module()
actions = policy(torch.as_tensor(cells), torch.as_tensor(steps)).numpy()
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
    cells, steps = (grid.ravel() for grid in np.meshgrid(np.arange(m), np.arange(choices + 2), indexing="ij"))
    forced = (steps >= choices)[:, None]
    return cells, steps, chains[cells, np.minimum(steps, choices - 1)] | forced


@pytest.mark.parametrize("form", ["onnx", pytest.param("torch_export", marks=pytest.mark.slow)])
def test_a_program_without_this_package_gets_the_same_sets(form: str, run: Path, tmp_path: Path) -> None:
    assert main(["export", f"run={run}", f"format={form}", f"hydra.run.dir={tmp_path}"]) == 0
    chains = trained(str(run), torch.device("cpu"))[1].dense()
    assert len(np.unique(chains.reshape(-1, chains.shape[2]), axis=0)) > 3
    cells, steps, actions = reachable(chains)
    np.savez(tmp_path / "states.npz", cells=cells, steps=steps)
    program = (
        "import sys, numpy as np\nstates = np.load('states.npz')\ncells, steps = states['cells'], states['steps']\n"
    )
    program += PROGRAMS[form] + "np.save('actions.npy', actions)\nassert 'trackmdp' not in sys.modules\n"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
    exported = np.load(tmp_path / "actions.npy", allow_pickle=False)
    assert exported.dtype == np.bool_
    assert np.array_equal(exported, actions)


def test_sets_are_lists_of_cells(run: Path) -> None:
    assert main(["export", f"run={run}", "format=sets", "quiet=true"]) == 0
    written = json.loads((run / "sets.json").read_text(encoding="utf-8"))
    chains = trained(str(run), torch.device("cpu"))[1].dense()
    assert written["t_max"] == 2
    assert written["sets"]["4"] == [np.flatnonzero(on).tolist() for on in chains[4]]


def test_the_best_checkpoint_is_one_that_is_kept_beside_the_newest(run: Path, tmp_path: Path) -> None:
    assert main(["export", f"run={run}", "format=sets", "checkpoint=best", f"hydra.run.dir={tmp_path}"]) == 0
    best = trained(str(run), torch.device("cpu"), best=True)[1].dense()
    written = json.loads((tmp_path / "sets.json").read_text(encoding="utf-8"))
    assert written["sets"]["0"] == [np.flatnonzero(on).tolist() for on in best[0]]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "run: missing, expected the folder of a run"),
        (["run=nowhere"], "run=.*nowhere: no such folder"),
        (["run={run}", "format=pickle"], "format=pickle: expected one of torch_export, onnx, sets"),
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


def test_onnx_is_asked_for_by_name(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert main(["export", f"run={run}", "format=onnx"]) == 2
    assert "format=onnx: needs onnx, which pip install" in capsys.readouterr().err
