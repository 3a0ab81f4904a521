"""The parts of `scripts/benchmark.py`: their words, their tables, and what the rows are about."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import clock, spreading, train, values, words
from benchmarks.drawn import KINDS

import trackmdp as tm
from tests.helpers import ALGORITHMS
from trackmdp.errors import UserError

Row = dict[str, Any]


def measure(part: str, *typed: str) -> list[Row]:
    return words.measure(words.parse([f"part={part}", *typed]))


def test_a_part_prints_its_rows_and_the_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = [
        "part=env",
        "grid.size=3",
        "seconds=.01",
        "batch_sizes=[1,64]",
        f"out={tmp_path / 'o'}",
    ]
    assert words.main(typed) == 0
    title, head, *rows = capsys.readouterr().out.splitlines()
    assert title.startswith("env: ") and title.endswith("1 torch threads")
    assert head.split() == ["envs", "per_second", "cpu_us_each", "cpu_us_step", "frame_bytes"]
    assert [row.split()[0] for row in rows] == ["1", "64"]
    kept = json.loads((tmp_path / "o").read_text())
    assert kept["machine"]["cores"] >= 1
    assert [row["envs"] for row in kept["rows"]] == [1, 64]
    assert all(row["per_second"] > 0 and row["cpu_us_each"] > 0 for row in kept["rows"])


MISTAKES = [
    ("part", "part"),
    ("seed=0", "part"),
    ("part=speed", "part=speed"),
    ("part=env sises=[1]", "sises"),
    ("part=env seconds=fast", "seconds=fast"),
    ("part=env batch_sizes=[a]", "batch_sizes=a"),
    ("part=env grid.sise=3", "grid.sise"),
    ("part=env kernel.sise=3", "kernel.sise"),
    ("part=env kernel=drfit", "kernel=drfit"),
    ("part=env threads=0", "threads=0"),
    ("part=peers peers=nowhere", "peers=nowhere"),
    ("part=env out=no/such/o", "out"),
]


@pytest.mark.parametrize(("typed", "named"), MISTAKES)
def test_a_mistake_is_one_line(typed: str, named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert words.main(typed.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"benchmark: {named}: ")


def test_words_about_the_world_are_those_of_the_commands() -> None:
    typed = (
        "grid.size=[4,5] grid.t_max=2 kernel=drift kernel.direction=90 cost.sensor=.3 cost.safe=7"
    )
    world = words.world_of(words.parse(typed.split()))
    same = tm.make_world("drift", size=(4, 5), t_max=2, direction=90, cost=0.3, safe_cost=7)
    assert (world.kernel != same.kernel).nnz == 0
    assert (world.size, world.t_max, world.safe_cost) == ((4, 5), 2, 7)
    assert (world.cost == 0.3).all()
    assert words.as_words(words.parse(typed.split())) == typed.split()
    assert len(words.world_of({"grid.size": "3", "targets.count": "4"})) == 4


@pytest.mark.slow
def test_speed_has_a_row_for_every_policy_algorithm_and_kind_of_work() -> None:
    short = ("grid.size=3", "seconds=.01")
    rows = measure("collector", *short)
    assert [row["policy"] for row in rows[::2]] == ["random", "all_on", "network"]
    assert [row["what"] for row in measure("log", *short)] == ["record", "write", "read"] * 2
    assert list(words.defaults(train.rows)["algos"]) == ALGORITHMS
    # `hindsight` collects first and learns afterwards, and is measured to its end.
    for algo, seconds, whole in (("hindsight", 1000, True), ("dqn", 0.01, False)):
        (row,) = measure("train", "grid.size=3", f"seconds={seconds}", f"algos=[{algo}]")
        assert row["whole"] is whole


@pytest.mark.slow
def test_commands_are_measured_beside_those_of_another_checkout(tmp_path: Path) -> None:
    typed = ("grid.size=3", "repeat=1", "commands=[train --help,train threads=0]")
    here = str(Path(__file__).parents[1])
    rows = measure("start", *typed, f"beside={here}")
    assert [row["command"] for row in rows] == ["train --help", "train threads=0"]
    assert all(row["cpu_seconds"] > 0 < row["cpu_seconds_share"] for row in rows)
    with pytest.raises(UserError, match="beside"):
        measure("start", f"beside={tmp_path}")
    (row,) = measure(
        "env", "grid.size=3", "seconds=.1", "batch_sizes=[4]", "repeat=1", f"beside={here}"
    )
    assert row["cpu_share"] > 0
    with pytest.raises(UserError, match="beside"):
        measure("env", "grid.size=3", "seconds=.01", "batch_sizes=[4]", f"beside={tmp_path}")
    ways = measure("sweep", "grid.size=3", "runs=2")
    assert [row["way"] for row in ways] == ["one command each", "one sweep", "one sweep, joblib"]
    assert ways[0]["times_faster"] == 1.0


def test_figures_of_drawn_worlds_are_compared_with_those_of_another_checkout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here = str(Path(__file__).parents[1])

    def printed(place: str, count: int, seed: int) -> list[Row]:
        off = 0.5 if place == "" else 0.0
        solved = {"lower": 8.0 - off, "upper": 8.0 + off / 4, "certified": off == 0}
        plain = {"kind": "plain", "exact": [0.1, 0.2 + off]} | solved
        return [plain, {"kind": "max_steps", "exact": [count, seed + off]}]

    monkeypatch.setattr(values, "HERE", "")
    monkeypatch.setattr(values, "_printed", printed)
    plain, cut = measure("values", f"beside={here}", "count=9", "seed=2")
    # .5 of .2 counts as .5 of 1, of 2 as a quarter, of 8 as a sixteenth
    assert plain == {
        "kind": "plain",
        "worlds": 1,
        "exact": pytest.approx(0.5),
        "lower": -0.0625,
        "upper": 0.015625,
        "certified": 0,
        "certified_beside": 1,
    }
    assert (cut["exact"], cut["lower"], cut["certified"]) == (0.25, None, 0)
    with pytest.raises(UserError, match="grid"):
        measure("values", f"beside={here}", "grid.size=3")


@pytest.mark.long
def test_the_same_worlds_are_drawn_again() -> None:
    rows = measure("values", f"beside={Path(__file__).parents[1]}", "count=8")
    assert [row["kind"] for row in rows] == list(KINDS)
    assert all(row["exact"] == 0 == (row["lower"] or 0) for row in rows)
    assert sum(row["certified"] for row in rows) >= 4


def test_a_process_is_measured_from_start_to_end(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import sys\nblock = b'x' * 300_000_000\nassert sys.argv[1:] == ['a', 'b']\nsum(range(3_000_000))\n"
    )
    usage = clock.measured("a", "b", script=str(script))
    assert usage.peak_mib > 286
    assert usage.cpu_seconds > 0
    assert usage.wall_seconds > 0
    with pytest.raises(UserError, match=f"{script} c: "):
        clock.measured("c", script=str(script))


def solver_in_n_squared_seconds(*typed: str, **_: Any) -> clock.Usage:
    if typed[0] == "train":
        raise KeyboardInterrupt
    folder = Path(typed[-1].partition("=")[2])
    folder.mkdir()
    (folder / "solution.json").write_text('{"regret_per_step": 0.25}')
    n = next(int(word.partition("=")[2]) for word in typed if word.startswith("grid.size"))
    assert "kernel.support_size=4" in typed
    return clock.Usage(1.0, float(n**2), float(n))


def test_exponents_are_of_growth_with_the_number_of_cells(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clock, "measured", solver_in_n_squared_seconds)
    words_ = ("sizes=[10,20]", "kernel.support_size=4")
    first, _, second, _ = measure("size", "work=[solve]", *words_)
    assert first["cpu_exponent"] is first["memory_exponent"] is None
    assert second["cpu_exponent"] == pytest.approx(1.0)
    assert second["memory_exponent"] == pytest.approx(0.5)
    # Rows measured before Ctrl-C are kept.
    with pytest.raises(KeyboardInterrupt):
        measure("size", *words_, f"out={tmp_path / 'out.json'}")
    kept = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert [(row["N"], row["what"], row["regret_per_step"]) for row in kept] == [
        (10, "solve, c = 0.16", 0.25),
        (10, "solve, c = 0.22", 0.25),
    ]


@pytest.mark.slow
def test_cost_by_size_and_memory_come_from_whole_processes() -> None:
    rows = measure("size", "sizes=[3]", "seconds=.05")
    assert [row["what"] for row in rows[2:4]] == ["train model_based, window 2", "env, B = 1024"]
    for row in rows[:3]:
        assert 0 <= row["regret_per_step"] < 0.01
        assert row["wall_seconds"] > 0.1 < row["cpu_seconds"]
        assert 20 < row["peak_mib"] < 1500
    assert rows[3]["per_second"] > 0
    assert rows[3]["wall_seconds"] is None
    (row,) = measure("memory", "sizes=[3]", "frames=20000", "algos=[dqn]")
    assert 0 < row["expected_mib"] < row["peak_mib"]


def test_loss_of_blocks_by_the_width_of_their_halo() -> None:
    typed = ("grid.size=8", "blocks=[4]", "halos=[0]", "costs=[.16]", "cost.safe=10")
    rows = measure("handoff", *typed)
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


@pytest.mark.parametrize("number", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_workers_do_the_same_work(number: int) -> None:
    first, second = measure(
        "workers", "grid.size=6", "block=3", "cost.safe=10", f"workers=[1,{number}]"
    )
    world = tm.make_world("random_support", size=6, safe_cost=10.0)
    assert first["aihtr"] == second["aihtr"] == pytest.approx(tm.solve(world, block=3).lower)
    assert (first["worker_seconds"], first["speed_up"], first["allowed"]) == (0, 1, 1)
    own, shared = second["own_seconds"], second["worker_seconds"]
    assert second["allowed"] == pytest.approx((own + shared) / (own + shared / number))
    assert (shared > 0) == (number == 2)


def test_the_worlds_are_as_their_names() -> None:
    made = {name: make() for name, make in spreading.worlds(6, 2).items()}
    assert len(made) == 52
    assert {(world.size, world.t_max) for world in made.values()} == {((6, 6), 2)}
    dear = {name for name, world in made.items() if world.safe_cost == 1000}
    assert dear == {name for name in made if "D 1000" in name}
    rare, far, many = (
        made[name].kernel.toarray()
        for name in ("rare far jumps", "far jumps", "20 successors c .08")
    )
    row, column = np.divmod(np.arange(36), 6)
    distance = np.maximum(abs(row[:, None] - row), abs(column[:, None] - column))
    # Some far jumps end nearby: on 6 x 6 cells, two thirds and more do not.
    assert 0.01 < (rare * (distance > 1)).sum(axis=1).mean() < 0.03
    assert 0.15 < (far * (distance > 1)).sum(axis=1).mean() < 0.3
    assert (many > 0).sum(axis=1).max() == 20
    for kernel in (rare, far, many):
        np.testing.assert_allclose(kernel.sum(axis=1), 0.995)


@pytest.mark.slow
def test_regret_is_over_the_seeds_and_the_bracket_is_proved() -> None:
    typed = ("grid.size=4", "worlds=[walk c .4,Z 9 c .16]", "algos=model_based")
    both, first = (measure("regret", *typed, f"seeds={seeds}") for seeds in ("[0,1]", "[0]"))
    assert [row["world"] for row in both] == ["walk c .4", "Z 9 c .16"]
    for two, one in zip(both, first, strict=True):
        assert two["worst"] >= max(two["mean"], one["worst"])
        assert min(two["mean"], one["worst"]) >= -1e-9
        assert 0 <= two["worst_to_best"] <= two["worst"]
        assert two["bracket"] <= two["worst"] + 1e-9
    (row,) = measure("bracket", "worlds=[walk c .1]", "nodes=1000")
    assert (row["world"], row["N"], row["T_max"]) == ("walk c .1", 10, 2)
    assert 0 <= row["bracket_per_step"] < 1e-3
