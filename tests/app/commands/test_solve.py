"""`solve` and `verify` as they are typed."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.solvers.worlds import paper_world
from tests.typed import ENVIRONMENT
from trackmdp import durable
from trackmdp.app.cli import main
from trackmdp.paper import proofs, theorems
from trackmdp.paper.check import Check
from trackmdp.policies import saved
from trackmdp.solvers import bounds
from trackmdp.solvers.evaluate import evaluate


def read(folder: Path, name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / name).read_text(encoding="utf-8"))
    return content


def chains_of(policy: dict[str, Any], cells: int) -> np.ndarray:
    chains = np.zeros((cells, policy["t_max"] + 1, cells), dtype=bool)
    for x, chain in policy["sets"].items():
        for n, sensed in enumerate(chain):
            chains[int(x), n, sensed] = True
    return chains


def test_solution_json_holds_the_certified_optimum(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(["solve", "cost.sensor=0.22", "grid.t_max=2", f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    )
    solution = read(tmp_path / "a", "solution.json")
    world = paper_world(5, 0.22, 2)
    assert solution["certified"] is True
    assert solution["lower"] == pytest.approx(90.48447403756, abs=1e-8)
    assert solution["lower"] <= solution["upper"] <= solution["lower"] + 1e-4
    np.testing.assert_allclose(np.mean(solution["value"]), solution["lower"])
    policy = evaluate(world, chains_of(read(tmp_path / "a", "sets.json"), 100))
    np.testing.assert_allclose(policy.value, solution["value"], atol=1e-9)
    assert solution["bounds"]["clocked"] == pytest.approx(bounds.clocked(world).mean())
    assert solution["seconds"] > 0
    assert solution["nodes"] == 0  # positions revealed one move late prove it without a search
    printed = capsys.readouterr().out
    assert "certified: bracket 90.484474" in printed and "│ optimal" in printed


@pytest.mark.parametrize("solver", ["qmdp", "fcr", "lookahead", "clocked"])
def test_other_solvers_are_bracketed_by_the_clocked_bound(tmp_path: Path, solver: str) -> None:
    assert (
        main(
            [
                "solve",
                f"solver={solver}",
                "grid.size=4",
                "quiet=true",
                f"hydra.run.dir={tmp_path / 'a'}",
            ]
        )
        == 0
    )
    solution = read(tmp_path / "a", "solution.json")
    assert solution["lower"] <= solution["upper"] == pytest.approx(solution["bounds"]["clocked"])


def test_quiet_says_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", "grid.size=3", "quiet=true", f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    assert capsys.readouterr().out == ""


def test_verify_prints_and_writes_every_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["verify", "grid.size=4", f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    checks = read(tmp_path / "a", "verification.json")["checks"]
    names = {check["name"] for check in checks}
    assert {
        "Theorem 1",
        "Theorem 2",
        "Lemma 1, first",
        "Theorem 3, exact form",
        "Q_MDP",
        "the printed bound",
    } <= names
    assert all(check["passed"] for check in checks)
    printed = capsys.readouterr().out
    verdicts = [check["verdict"] for check in checks]
    assert verdicts.count("not claimed; does not hold") == 3
    assert "FAILS" not in verdicts
    counts = verdicts.count("holds"), verdicts.count("no case")
    assert sum(counts) == len(verdicts) - 3
    last = " ".join(printed.split())
    assert f"of {sum(counts)} claims {counts[0]} hold, " in last
    assert "0 FAIL; of 3 looser forms, not claimed, 3 do not hold" in last


def test_solve_verify(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proofs, "of_searches", lambda: iter(()))  # most of the time
    words = ["solve", "grid.size=3", "verify=true", "quiet=true", f"hydra.run.dir={tmp_path / 'a'}"]
    assert main(words) == 0
    assert (tmp_path / "a" / "solution.json").exists()
    assert read(tmp_path / "a", "verification.json")["optimum"]["certified"]


@pytest.mark.parametrize("words", ["verify", "solve verify=true"])
def test_a_claim_that_fails_ends_with_status_1(
    tmp_path: Path,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    wrong = Check("Lemma 9", "1 = 2", 1.0).judged(0.1)
    monkeypatch.setattr(theorems, "check_theorems", lambda *_: [wrong])
    monkeypatch.setattr(theorems, "check_remarks", lambda _: [])
    folder = tmp_path / "a"
    assert main([*words.split(), "grid.size=3", "quiet=true", f"hydra.run.dir={folder}"]) == 1
    assert ": of 1 claims 0 hold, 1 FAIL; " in capsys.readouterr().err
    assert not read(folder, "verification.json")["checks"][0]["passed"]


@pytest.mark.parametrize("command", ["solve", "verify"])
def test_cut_episodes_are_refused(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, "grid.max_steps=10", f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert capsys.readouterr().err.startswith(f"trackmdp {command}: grid.max_steps=10: ")
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("words", ["verify", "solve verify=true"])
def test_theorems_need_a_sensor_in_every_cell(
    tmp_path: Path, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    prices = "cost.sensor=[0.1,null,0.1,0.1,0.1,0.1,0.1,0.1,0.1]"
    assert main([*words.split(), "grid.size=3", prices, f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert "cost.sensor: nan in cell 1 (no sensor)" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.slow
def test_ctrl_c_prints_and_saves_the_bracket(tmp_path: Path) -> None:
    world = [
        "kernel=random_walk",
        "kernel.diagonal=true",
        "grid.t_max=3",
        "solver.nodes=1_000_000_000",
    ]
    words = [
        sys.executable,
        "-m",
        "trackmdp.app.cli",
        "solve",
        *world,
        f"hydra.run.dir={tmp_path / 'a'}",
    ]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "bracket" in line:  # the search is on
                process.send_signal(signal.SIGINT)
                break
        printed, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted: bracket" in printed
    assert "│ best known" in printed and "│ optimal" not in printed
    assert errors == "trackmdp solve: interrupted\n"
    solution = read(tmp_path / "a", "solution.json")
    assert solution["interrupted"] is True
    assert solution["certified"] is False
    assert solution["lower"] < solution["upper"]


@pytest.mark.parametrize("listed", [20_000, 8])
def test_the_sets_of_a_solution_are_valued_again_by_evaluate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(saved, "LISTED_CELLS", listed)
    world = ["grid.size=4", "cost.sensor=0.2"]
    assert main(["solve", *world, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    name = "sets.json" if listed > 16 else "sets.npz"
    assert f"sets in {name}" in " ".join(capsys.readouterr().out.split())
    words = [
        "baseline=sets",
        f"baseline.file={tmp_path / 'a' / name}",
        f"hydra.run.dir={tmp_path / 'b'}",
    ]
    assert main(["evaluate", *world, *words, "episodes=20", "log=[mcap]"]) == 0
    assert (
        read(tmp_path / "b", "evaluation.json")["exact"]["aihtr"]
        == read(tmp_path / "a", "solution.json")["lower"]
    )
    assert (tmp_path / "b" / name).is_file()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_to_the_group_ends_all_workers_in_one_line(
    tmp_path: Path, kind: signal.Signals
) -> None:
    words = "solve grid.size=60 grid.t_max=2 cost.sensor=0.22 partition.block=5 partition.workers=2"
    program = [
        sys.executable,
        "-m",
        "trackmdp.app.cli",
        *words.split(),
        f"hydra.run.dir={tmp_path / 'a'}",
    ]
    with subprocess.Popen(
        program, stderr=subprocess.PIPE, text=True, start_new_session=True, env=ENVIRONMENT
    ) as run:
        try:
            # a worker that still imports would be the first to write a traceback
            while (
                len(members(run.pid)) < 4 and run.poll() is None
            ):  # with Python's own tracker of semaphores
                pass
            os.killpg(run.pid, kind)
            said = run.stderr.read()  # type: ignore[union-attr]  # until the last of them has ended
        finally:
            with suppress(ProcessLookupError):
                os.killpg(run.pid, signal.SIGKILL)
    told = "interrupted" if kind is signal.SIGINT else f"stopped by signal {int(kind)}"
    assert (run.returncode, said) == (128 + kind, f"trackmdp solve: {told}\n")
    assert not list(tmp_path.iterdir())


def members(group: int) -> list[str]:
    """The processes of a group that have not ended."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, of, *_ = file.read_text().rpartition(")")[2].split()
            found += [file.parent.name] if int(of) == group and state != "Z" else []
    return found


@pytest.mark.parametrize("words", [["solve"], ["evaluate", "baseline=qmdp"]])
def test_a_grid_that_cannot_fit_into_memory_is_refused_in_one_line(
    empty_folder: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert main([*words, "kernel=random_walk", "grid.size=1000000000", "cost.safe=16"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "grid.size=1000000000: needs about" in line
    assert not list(empty_folder.iterdir())


def test_a_full_disk_under_the_results_is_one_line_that_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(durable, "sync", full)
    assert main(["solve", "grid.size=3", "quiet=true", f"hydra.run.dir={tmp_path}/a"]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f"trackmdp solve: {tmp_path}/a/")
    assert line.endswith(f": {os.strerror(errno.ENOSPC)}\n")
    assert line.count("\n") == 1
