"""Cost by size, and shared by workers: whole commands as a user types them, and the table made of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import trackmdp as tm
from trackmdp.app.bench import blocks, size
from trackmdp.app.bench.process import Usage, measured
from trackmdp.app.cli import main


def bench(folder: Path, *words: str) -> list[dict[str, Any]]:
    assert main(["benchmark", *words, f"hydra.run.dir={folder}"]) == 0
    rows: list[dict[str, Any]] = json.loads((folder / "benchmark.json").read_text())["rows"]
    return rows


def test_a_process_is_measured_from_start_to_end(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nblock = b'x' * 300_000_000\nassert sys.argv[1:] == ['a', 'b']\nsum(range(3_000_000))\n"
    )
    usage = measured("a", "b", script=str(script))
    assert usage.peak_mib > 286
    assert usage.cpu_seconds > 0
    assert usage.wall_seconds > 0


def test_what_was_measured_before_ctrl_c_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stand_in(*words: str) -> Usage:
        if words[0] == "train":
            raise KeyboardInterrupt
        folder = Path(words[-1].partition("=")[2])
        folder.mkdir()
        (folder / "solution.json").write_text('{"regret_per_step": 0.25}')
        assert {"grid.size=12", "grid.t_max=2", "kernel.support_size=4"} <= set(words)
        return Usage(1.0, 1.0, 1.0)

    monkeypatch.setattr(size, "measured", stand_in)
    words = ["part=size", "sizes=[12]", "grid.t_max=2", "kernel.support_size=4", "quiet=true"]
    assert main(["benchmark", *words, f"hydra.run.dir={tmp_path}/b"]) == 130
    rows = json.loads((tmp_path / "b" / "benchmark.json").read_text())["rows"]
    assert [(row["N"], row["what"], row["regret_per_step"]) for row in rows] == [
        (12, "solve, c = 0.16", 0.25),
        (12, "solve, c = 0.22", 0.25),
    ]


@pytest.mark.slow
def test_one_table_of_cost_by_size(tmp_path: Path) -> None:
    rows = bench(tmp_path / "size", "part=size", "sizes=[3]", "seconds=0.05")
    assert [row["what"] for row in rows][:4] == [
        "solve, c = 0.16",
        "solve, c = 0.22",
        "train learned_kernel, window 2",
        "env, B = 1024",
    ]
    for row in rows[:3]:
        assert 0 <= row["regret_per_step"] < 0.01
        assert row["wall_seconds"] > 0.1 < row["cpu_seconds"]
        assert 20 < row["peak_mib"] < 1500
    assert rows[3]["per_second"] > 1000
    assert rows[3]["wall_seconds"] is None


@pytest.mark.slow
def test_memory_beside_what_was_expected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(size, "MEMORY_SIZES", (3,))
    monkeypatch.setattr(size, "MEMORY_FRAMES", 20_000)
    (row,) = bench(tmp_path / "memory", "part=memory", "algos=[dqn]")
    assert 0 < row["expected_mib"] < row["peak_mib"]


def test_exponents_are_of_growth_with_the_number_of_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stand_in(*words: str) -> Usage:
        folder = Path(words[-1].partition("=")[2])
        folder.mkdir()
        (folder / "solution.json").write_text('{"regret_per_step": 0}')
        n = next(int(word.partition("=")[2]) for word in words if word.startswith("grid.size"))
        return Usage(1.0, float(n**2), float(n))

    monkeypatch.setattr(size, "measured", stand_in)
    first, _, second, _ = bench(tmp_path / "size", "part=size", "sizes=[10,20]", "work=[solve]")
    assert first["cpu_exponent"] is first["memory_exponent"] is None
    assert second["cpu_exponent"] == pytest.approx(1.0)
    assert second["memory_exponent"] == pytest.approx(0.5)


def test_what_blocks_lose_by_the_width_of_their_halo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "_COSTS", (0.16,))
    rows = bench(tmp_path / "handoff", "part=handoff", "grid.size=8", "blocks=[4]", "halos=[0]", "cost.safe=10")
    # The reach of the default kernel is 1: R (T_max + 2) is 3 for T_max 1 and 4 for T_max 2.
    assert [(row["T_max"], row["halo"], row["sweeps"]) for row in rows] == [
        (1, 0, False),
        (1, 3, False),
        (1, 3, True),
        (2, 0, False),
        (2, 4, False),
        (2, 4, True),
    ]
    for without, wide in zip(rows[::3], rows[2::3], strict=True):
        assert without["loss_per_step"] > 0.1
        assert abs(wide["loss_per_step"]) < 5e-4
        assert wide["gap_per_step"] >= wide["loss_per_step"]


@pytest.mark.parametrize("numbers", [[1, 1], pytest.param([1, 2], marks=pytest.mark.slow)])
def test_what_workers_gain(numbers: list[int], tmp_path: Path) -> None:
    words = ["grid.size=6", "blocks=[3]", "cost.safe=10", f"workers={numbers}", "cluster=null"]
    first, second = bench(tmp_path, "part=workers", *words)
    world = tm.make_world("random_support", size=6, safe_cost=10.0)
    assert first["aihtr"] == second["aihtr"] == pytest.approx(tm.solve(world, block=3).lower)
    # One worker is this process, whose work is then all of the worker's.
    assert (first["driver_seconds"], first["speed_up"], first["allowed"]) == (0, 1, 1)
    alone = second if numbers[1] == 1 else first
    assert second["speed_up"] == pytest.approx(alone["wall_seconds"] / second["wall_seconds"])
    spent = [float(seconds) for seconds in second["worker_seconds"].split(" + ")]
    total = sum(spent) + second["driver_seconds"]
    # Printed with three digits.
    assert second["allowed"] == pytest.approx(total / (second["driver_seconds"] + max(spent)), rel=0.02)
    assert (second["driver_seconds"] > 0) == (numbers[1] == 2)
