"""Episodes on a large grid: the part around the target is drawn, in the terminal and on the page."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.episodes.browser import CHROMIUM, Browser
from trackmdp import machine
from trackmdp.app.cli import main
from trackmdp.environment.render import around
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.episode_page import PAGE_WIDE
from trackmdp.episodes.extracts import write_page
from trackmdp.episodes.player import WIDE, frame
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.errors import UserError
from trackmdp.sensing.task import Task
from trackmdp.world.group import group_of
from trackmdp.world.make import make_world


@pytest.mark.parametrize(
    ("place", "length", "expected"),
    [
        (0, 40, range(21)),
        (4, 40, range(21)),
        (15, 40, range(5, 26)),
        (39, 40, range(19, 40)),
        (3, 9, range(9)),
    ],
)
def test_the_part_that_is_drawn(place: int, length: int, expected: range) -> None:
    assert around(place, length, 21) == expected


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("large") / "e"
    words = [
        "baseline=clocked",
        "grid.size=[60,50]",
        "episodes=2",
        "seed=3",
        "log=[mcap]",
        "quiet=true",
    ]
    assert main(["evaluate", *words, f"hydra.run.dir={folder}"]) == 0
    return folder


def test_a_frame_is_the_grid_around_the_target(folder: Path) -> None:
    with EpisodeReader(folder / "episodes.mcap") as reader:
        episode, task = reader.read(0), reader.world().task
    for t in range(len(episode)):
        lines = frame(episode, t, task).splitlines()
        assert len(lines) == WIDE + 3
        assert {len(line) for line in lines[:-1]} == {2 * WIDE + 3} and 2 * WIDE + 3 < 80
        drawn = [list(line[2:-2:2]) for line in lines[1:-2]]
        top, left = (
            int(each) - 1
            for each in re.fullmatch(
                r"rows (\d+) to \d+ of 60, columns (\d+) to \d+ of 50", lines[-1]
            ).groups()
        )
        _same_marks(episode, t, task, np.array(drawn), top, left)


def _same_marks(
    episode: Episode, t: int, task: Task, drawn: np.ndarray, top: int, left: int
) -> None:
    target = int(episode.target[t])
    if target < task.num_cells:
        row, column = divmod(target, task.columns)
        assert drawn[row - top, column - left] in "●○"
        # at least as much to see on each side as the nearest border leaves
        assert min(row - top, row) >= 0 and top + WIDE <= task.rows and left + WIDE <= task.columns
        assert row - top >= min(row, 10) and column - left >= min(column, 10)
    elif episode.misses[t] <= task.t_max:
        assert not set("●○") & set(drawn.ravel())
    on = episode.action[t].reshape(task.size)[top : top + WIDE, left : left + WIDE]
    if episode.misses[t] <= task.t_max:
        assert (drawn == "▪").sum() == on.sum() - (
            target < task.num_cells and episode.action[t][target]
        )


def test_the_page_says_what_part_it_draws(folder: Path) -> None:
    page = folder / "page.html"
    assert main(["replay", f"file={folder / 'episodes.mcap'}", f"html={page}", "quiet=true"]) == 0
    data = json.loads(
        re.search(r'<script id="data" type="application/json">(.*?)</script>', page.read_text())[1]
    )
    assert (data["rows"], data["columns"], data["wide"]) == (60, 50, PAGE_WIDE)
    assert "the 41 x 41 cells around the target" in data["about"]


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_part_that_a_browser_draws(folder: Path, tmp_path: Path) -> None:
    with EpisodeReader(folder / "episodes.mcap") as reader:
        write_page(reader, tmp_path / "a.html", 0)
        episode = reader.read(0)
    with Browser(tmp_path / "profile") as browser:
        browser.view(1000, 800, "light")
        browser.open(tmp_path / "a.html")
        assert browser.ask("cells.length") == PAGE_WIDE**2
        for t in (0, len(episode) // 2, len(episode) - 1):
            browser.ask(f"show({t})")
            x, y, width, height = browser.ask("grid.getAttribute('viewBox').split(' ').map(Number)")
            if episode.target[t] < 3000:
                row, column = divmod(int(episode.target[t]), 50)
                assert x < column < x + width and y < row < y + height
                assert browser.ask(
                    "[target[0].cx, target[0].cy].map((at) => at.baseVal.value)"
                ) == [
                    column + 0.5,
                    row + 0.5,
                ]
            # the corner of what is drawn has its own number, and the shade of its own cell
            corner = browser.ask("[cells[0].x, cells[0].y].map((at) => at.baseVal.value)")
            labels = browser.ask(
                "[columnLabels, rowLabels].map((each) => Number(each[0].textContent))"
            )
            assert labels == [corner[0] + 1, corner[1] + 1]
            shades = np.array(
                browser.ask("cells.map((each) => Number(each.getAttribute('fill-opacity')))")
            )
            belief = episode.belief[t].reshape(60, 50)  # type: ignore[index]
            left, top = map(int, corner)
            seen = belief[top : top + PAGE_WIDE, left : left + PAGE_WIDE].ravel()
            np.testing.assert_allclose(shades, 0.85 * np.sqrt(np.rint(1e4 * seen) / 1e4), atol=1e-6)
        assert browser.problems == []


def test_a_small_grid_is_drawn_whole() -> None:
    world = make_world("random_walk", size=4)
    episode = Episode.__new__(Episode)
    for name, value in {
        "belief": np.zeros((1, 16), np.float32),
        "action": np.zeros((1, 16), bool),
        "target": np.array([5]),
        "start": 5,
        "terminated": False,
    }.items():
        object.__setattr__(episode, name, value)
    object.__setattr__(episode, "located", np.array([True]))
    object.__setattr__(episode, "misses", np.array([0]))
    lines = frame(episode, 0, world.task).splitlines()
    assert len(lines) == 6 and lines[2] == "│   ●     │"


def test_an_episode_that_does_not_fit_is_refused_before_its_layers_are_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with EpisodeReader(folder / "episodes.mcap") as reader:
        world, row = reader.world(), reader.row(0)
        # Belief and policy are numbers of 4 bytes, the action one of 1.
        needed = row["length"] * 3000 * 9
        made = tm.simulate(world, reader.policy(0), 1)
        free = needed
        monkeypatch.setattr(machine, "_LITTLE", 0)
        monkeypatch.setattr(machine, "free_bytes", lambda: free)
        assert len(reader.read(0)) == row["length"]
        free = needed - 1
        with pytest.raises(UserError, match=rf"{row['length']} steps on 3,000 cells: needs about"):
            reader.read(0)
        free = len(made[0]) * 3000 * 9
        assert len(list(made.complete())) == 1
        free -= 1
        with pytest.raises(UserError, match="steps on 3,000 cells: needs about"):
            list(made.complete())


@pytest.mark.parametrize(("targets", "side"), [(1, 50), (40, 10)])
def test_long_episodes_are_completed_a_few_at_a_time(targets: int, side: int) -> None:
    """600 steps of 2,500 cells, or of 40 targets that may be in 30 cells each: 5 times as many numbers are kept."""
    world = make_world("random_walk", size=side, exit_probability=0, max_steps=600)
    made: Any = tm.simulate(world if targets == 1 else group_of(world, targets), "none", 10)
    together = []

    def completed(begin: int, end: int) -> list[Episode]:
        together.append(end - begin)
        return made[begin:end]

    object.__setattr__(made, "_completed", completed)
    assert [each.number for each in made.complete()] == list(range(10))
    assert together == [5, 5]
