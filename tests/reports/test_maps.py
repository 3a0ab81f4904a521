"""Maps of policies and the story of a miss, by hand and from runs."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

import trackmdp as tm
from tests.helpers import small_world
from tests.reports.sweeps import write_sweep
from trackmdp.reports import maps
from trackmdp.reports.finished import after_a_miss, read_map
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.idea import idea_figure, scenes
from trackmdp.reports.results import Mapped
from trackmdp.world.model import World


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> list[Mapped]:
    return [*gather_runs(write_sweep(tmp_path_factory.mktemp("sweep"))).maps]


def by_hand(
    sets: np.ndarray, kernel: np.ndarray, size: tuple[int, int], *, averaged: bool = False
) -> Mapped:
    zeros = np.zeros(len(kernel))
    after = kernel * (1 - sets[:: len(sets) // len(kernel)]) @ kernel
    return Mapped(
        *("w", "m", "0", size, averaged, sparse.csr_array(sets), zeros),
        *(sparse.csr_array(kernel), sparse.csr_array(after), zeros, np.full(len(kernel), np.nan)),
    )


def test_a_map_draws_the_possible_cells(drawn: list[Mapped]) -> None:
    each = drawn[1]
    figure = maps.policy_map("name", each)
    for located, n, on, possible, cells in figure.table.rows:
        assert on == each.on(n).toarray()[located].sum() == len(str(cells).split())  # type: ignore[index]
        if n == 0:
            assert possible == (each.kernel.toarray()[located] > 0).sum()  # type: ignore[call-overload]
    assert len([row for row in figure.table.rows if row[1] == 0]) == 9
    ones, none = np.ones(each.sets.shape), np.zeros(each.kernel.shape)
    everything = replace(each, sets=sparse.csr_array(ones), after=sparse.csr_array(none))
    without = maps.policy_map("name", everything)
    assert {row[1] for row in without.table.rows} == {0}, "no miss can happen: no second set"


def test_a_map_of_averaged_plans_fills_the_share_of_each_cell() -> None:
    """From cell 0 the target goes to 0 or 1; cell 1 is sensed on a quarter of the detections, cell 0 never."""
    kernel = np.array([[0.5, 0.4], [0.0, 0.9]])
    each = by_hand(np.array([[0.0, 0.25], [0.0, 1.0]]), kernel, (1, 2), averaged=True)
    figure = maps.policy_map("x", each)
    assert [row[2:4] for row in figure.table.rows] == [[0.25, 2], [1.0, 1]]
    assert "shares of the detections" in figure.table.caption


def test_a_map_of_values_shows_the_distance_from_the_bound(drawn: list[Mapped]) -> None:
    group = [each for each in drawn if each.world == drawn[0].world]
    ends = maps.shades([maps.missing(group)])
    figure = maps.missing_map("x", group, ends)
    assert [column.label for column in figure.table.columns] == [
        "row",
        "column",
        *(each.method for each in group),
        "Q_MDP",
    ]
    for place, each in enumerate(group):
        expected = each.bound - each.value
        found = [row[2 + place] for row in figure.table.rows]
        assert found == pytest.approx(np.where(expected < 1e-6, 0, expected))
    assert [row[-1] for row in figure.table.rows] == pytest.approx(group[0].bound - group[0].qmdp)
    # Two maps of 155 points: 24 letters in a line.
    long = replace(group[0], method="model_based, task.memory=displacement")
    drawn = maps.missing_map("x", [long], ends)
    assert {"model_based,", "task.memory=displacement"} <= {
        *re.findall(r">([^<>]+)</text>", drawn.svg.decode())
    }


def test_shades_are_as_frequent_as_each_other_and_shared() -> None:
    """A good policy misses .001 to .1, a poor one 100 to 1,000: each has half of the shades."""
    good, poor = np.linspace(0.001, 0.1, 100), np.linspace(100.0, 1000.0, 100)
    ends = maps.shades([{"good": good.reshape(10, 10)}, {"poor": poor.reshape(10, 10)}])
    counts = np.histogram(np.concatenate([good, poor]), ends)[0]
    assert len(ends) == maps.SHADES + 1 and counts.min() >= 16 and counts.max() <= 17
    assert np.searchsorted(ends, 1.0) == maps.SHADES // 2
    assert maps.shades([{"optimal": np.zeros((3, 3))}]).tolist() == [0.0, 1e-6]


def test_a_large_grid_is_drawn_as_means_over_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps, "MOST_MAP_CELLS", 20)
    monkeypatch.setattr(maps, "MOST_TILES", 3)
    # 5 rows of 7 cells, tiles of 3 x 3: two rows of three tiles, the last ones of 2 rows or 1 column.
    size, cells = (5, 7), 35
    value = np.arange(35.0)
    expected = np.array([[8.0, 11.0, 13.0], [25.5, 28.5, 30.5]])
    np.testing.assert_allclose(maps.binned(value, size), expected)
    # Located in x, x % 4 sensors are on at once, and one after a miss.
    on = np.zeros((cells, 2, cells))
    for x in range(cells):
        on[x, 0, : x % 4] = on[x, 1, 0] = 1
    each = by_hand(on.reshape(2 * cells, cells), np.zeros((cells, cells)), size)
    each = replace(each, value=value, bound=value + 0.5)
    sets = maps.policy_map("x", each)
    number = maps.binned(np.arange(cells) % 4.0, size)
    assert [row[2] for row in sets.table.rows] == pytest.approx(number.ravel())
    assert [row[3] for row in sets.table.rows] == [1.0] * 6
    assert sets.table.rows[4][:2] == [4, 4]
    assert "tiles of 3 x 3 cells" in sets.table.caption
    values = maps.missing_map("x", [each], maps.shades([maps.missing([each])]))
    assert [row[2:] for row in values.table.rows] == [[0.5]] * 6  # Q_MDP was not valued
    assert idea_figure(each) is None  # no motion is kept


def test_a_map_of_a_rectangle_has_its_rows_and_columns() -> None:
    flat = by_hand(np.eye(9), 0.9 * np.eye(9), (1, 9))
    figure = maps.missing_map("x", [flat], np.array([0.0, 1.0]))
    assert [row[:2] for row in figure.table.rows] == [[1, column] for column in range(1, 10)]
    assert maps.policy_map("x", flat)


def line_of_four(second: list[int]) -> Mapped:
    """A target that goes from 0 to 1 (.6) or 2 (.4), from 2 to 3; first the sensor of 1 is on, then those `second`."""
    kernel = np.zeros((4, 4))
    kernel[0, 1], kernel[0, 2], kernel[1, 1], kernel[2, 3], kernel[3, 3] = 0.6, 0.4, 0.9, 0.9, 0.9
    sets = np.zeros((4, 2, 4))
    sets[:, 0] = kernel > 0
    sets[0] = [[0, 1, 0, 0], second]
    return by_hand(sets.reshape(8, 4), kernel, (1, 4))


def test_the_story_is_a_miss_that_is_made_good() -> None:
    drawn = line_of_four([0, 0, 0, 1])
    located, missed, inferred, found = scenes(drawn)
    assert (located.target, located.found) == (0, True)
    assert missed.belief.tolist() == [0, 0.6, 0.4, 0]
    assert (missed.target, missed.found) == (2, False)
    assert missed.on.tolist() == [False, True, False, False]
    assert (inferred.target, inferred.belief.tolist()) == (None, [0, 0, 1, 0])
    assert found.belief == pytest.approx([0, 0, 0, 0.9])
    assert (found.target, found.found) == (3, True)
    figure = idea_figure(drawn)
    assert figure
    assert figure.table.rows[1] == ["2  moves; missed", 1, 2, 0.6, True]


def test_where_no_miss_can_be_made_good_there_is_no_story() -> None:
    assert idea_figure(line_of_four([1, 1, 1, 0])) is None
    once = line_of_four([0] * 4)
    assert scenes(replace(once, sets=once.on(0))) == []


def test_after_a_miss_a_target_goes_on_in_its_mode_and_may_be_where_a_sensor_missed_it() -> None:
    """A row of five cells; mode 0 goes right, mode 1 left, as often: the average of both would turn around."""
    moves = np.zeros((5, 2, 5, 2))
    for x in range(4):
        moves[x, 0, x + 1, 0] = moves[4 - x, 1, 3 - x, 1] = 0.9
    world = World(moves.reshape(10, 10), (1, 5), cost=0.1, modes=2)
    dark = sparse.csr_array((5, 5))
    assert after_a_miss(world, dark).toarray()[2].nonzero()[0].tolist() == [0, 4]
    stay = World(0.9 * np.eye(5), (1, 5), cost=0.1)
    found = after_a_miss(stay, sparse.diags_array([1, 0.5, 0.5, 1, 1])).toarray()
    assert found == pytest.approx(np.diag([0, 0.405, 0.405, 0, 0]))


@pytest.mark.slow
def test_a_map_knows_that_footprints_miss(tmp_path: Path) -> None:
    """Sensors that report next to their own cell with .5."""
    coverage = np.eye(9) + 0.5 * np.eye(9, k=1)
    world = replace(small_world(), coverage=coverage, cost=np.full(9, 0.01))
    frames = {"total_frames": 1000, "frames_per_batch": 1000, "envs": 50}
    run = tm.train(world, "model_based", folder=tmp_path / "a", **frames)
    found = read_map(tmp_path / "a", SimpleNamespace(seed=0), "w", "m")  # type: ignore[arg-type]
    assert found is not None
    on = run.policy.dense()[:, 0]
    silent = np.stack([np.prod(1.0 - coverage[each], axis=0) for each in on])
    kernel = world.kernel.toarray()
    assert found.after.toarray() == pytest.approx((kernel * silent) @ kernel)
    assert (silent == 0.5).any()


def test_where_a_sensor_misses_there_is_no_story() -> None:
    drawn = line_of_four([0, 0, 0, 1])
    missing = drawn.after + sparse.csr_array(0.1 * np.eye(4))
    assert scenes(drawn) and not scenes(replace(drawn, after=missing))
