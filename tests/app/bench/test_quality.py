"""Whole runs as a user types them, and the tables made of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from trackmdp.app.bench import memory, quality
from trackmdp.app.bench.process import Trained, Usage, measured
from trackmdp.app.cli import main


def curve(*regrets: float) -> Trained:
    rows = [{"regret_per_step": str(regret), "seconds": str(at)} for at, regret in enumerate(regrets)]
    return Trained({}, rows, Usage(1.0, 1.0, 1.0))


def test_settled_is_when_the_regret_stays_below() -> None:
    assert curve(0.5, 0.01, 0.3, 0.02, 0.01).settled(0.02) == 3
    assert curve(0.01, 0.01).settled(0.02) == 0
    assert curve(0.01, 0.03).settled(0.02) is None


def test_the_histogram_counts_every_run_once() -> None:
    regrets = [-1e-12, 0.0005, 0.00051, 0.01, 0.7]
    rows = [{"algo": "hindsight", "regret_per_step": regret} for regret in regrets]
    counted = {text: runs for _, text, runs in quality.histogram(rows)}
    assert counted == {
        "up to 0.0005": 2,
        "up to 0.001": 1,
        "up to 0.002": 0,
        "up to 0.005": 0,
        "up to 0.01": 1,
        "up to 0.02": 0,
        "up to 0.05": 0,
        "over 0.05": 1,
    }


def test_a_process_is_measured_from_start_to_end(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nblock = b'x' * 300_000_000\nassert sys.argv[1:] == ['a', 'b']\nsum(range(3_000_000))\n"
    )
    usage = measured("a", "b", script=str(script))
    assert usage.peak_mib > 286
    assert usage.cpu_seconds > 0
    assert usage.wall_seconds > 0


def bench(folder: Path, *words: str) -> list[dict[str, object]]:
    assert main(["benchmark", *words, f"hydra.run.dir={folder}"]) == 0
    rows: list[dict[str, object]] = json.loads((folder / "benchmark.json").read_text())["rows"]
    return rows


def test_what_was_measured_before_ctrl_c_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(*words: str) -> Trained:
        if "seed=2" in words:
            raise KeyboardInterrupt
        return Trained({"frames": 1, "regret_per_step": 0.25}, [], Usage(1.0, 1.0, 1.0))

    monkeypatch.setattr(quality, "trained", trained)
    words = ["part=quality", "algos=[hindsight]", "seeds=[0,1,2]", "quiet=true", f"hydra.run.dir={tmp_path}/b"]
    assert main(["benchmark", *words]) == 130
    rows = json.loads((tmp_path / "b" / "benchmark.json").read_text())["rows"]
    assert [(row["seed"], row["regret_per_step"]) for row in rows] == [(0, 0.25), (1, 0.25)]


@pytest.mark.slow
def test_pairs_and_growth_and_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "SUPPORTS", (3,))
    monkeypatch.setattr(quality, "COSTS", (0.2,))
    monkeypatch.setattr(quality, "T_MAX", (0,))
    rows = bench(tmp_path / "pairs", "part=pairs", "grid.size=4", "algos=[hindsight]", "seeds=[0,1]")
    assert [(row["T_max"], row["Z"], row["c"]) for row in rows] == [(0, 3, 0.2)]
    for row in rows:
        assert row["bracket"] == pytest.approx(0, abs=1e-6)
        regrets = row["regrets"]
        assert isinstance(regrets, dict)
        assert list(regrets) == ["0", "1"]
        assert max(regrets.values()) == row["worst_regret"] < 0.005

    monkeypatch.setattr(quality, "SIZES", (3,))
    monkeypatch.setattr(quality, "CHOICES", (0,))
    rows = bench(tmp_path / "growth", "part=growth", "grid.size=4", "grid.t_max=0", "algos=[hindsight]")
    assert [(row["N"], row["T_max"]) for row in rows] == [
        (3, 0),
        (4, 0),
    ]  # the sizes, then the T_max of the size asked for

    monkeypatch.setattr(memory, "SIZES", (3,))
    monkeypatch.setattr(memory, "FRAMES", 20_000)
    (row,) = bench(tmp_path / "memory", "part=memory", "algos=[dqn]")
    assert 0 < float(str(row["expected_mib"])) < float(str(row["peak_mib"]))
