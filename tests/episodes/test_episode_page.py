"""The page of an episode: what it holds, and what it does in a browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.episodes.browser import CHROMIUM, Browser
from tests.episodes.logs import WORLD, recorded, write
from tests.helpers import later, train_config
from tests.tracks import by_hand
from tests.tracks import recorded as recorded_tracks
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.episode_page import MOST_STEPS, page
from trackmdp.episodes.extracts import write_page
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.simulate import resimulate, simulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import as_policy
from trackmdp.solvers import bounds, rules
from trackmdp.world.configured import build_world


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EpisodeReader]:
    with EpisodeReader(write(tmp_path_factory.mktemp("log") / "a.mcap", recorded(20))) as reader:
        yield reader


def longest(reader: EpisodeReader) -> int:
    return int(max(reader.rows, key=lambda row: row["length"])["episode"])


def data_of(text: str) -> dict[str, list[float]]:
    found = re.search(
        r'<script id="data" type="application/json">(.*?)</script>', text, flags=re.DOTALL
    )
    assert found
    content: dict[str, list[float]] = json.loads(found[1])
    return content


def test_a_page_holds_the_episode_to_the_digit(reader: EpisodeReader) -> None:
    episode = reader.read(longest(reader))
    assert episode.belief is not None
    data = data_of(page(WORLD, episode))
    assert data["reward"] == episode.reward.tolist()
    assert data["total"] == episode.returns.tolist()
    assert data["n"] == episode.misses.tolist()
    assert "mode" not in data  # these targets have none
    assert data["bound"] == pytest.approx(bounds.clocked(WORLD)[episode.start])
    shares = dict(zip(data["belief"][0][::2], data["belief"][0][1::2], strict=True))  # type: ignore[index]
    assert shares[int(episode.belief[0].argmax())] == pytest.approx(
        1e4 * episode.belief[0].max(), abs=0.5
    )


def test_a_page_is_one_small_file_that_asks_for_nothing(tmp_path: Path) -> None:
    world = build_world(train_config())
    acting = as_policy(world, rules.qmdp(world))
    episodes = resimulate(world, acting, range(100)).complete()
    episode = next(each for each in episodes if 100 <= len(each) < 150)
    with EpisodeReader(write(tmp_path / "a.mcap", [episode], acting=acting, world=world)) as reader:
        write_page(reader, tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert len(text.encode()) < 250_000
    assert not re.findall(r"(?:src|href)=|url\(|@import|fetch\(", text)
    assert "default-src 'none'" in text


def test_what_a_log_says_cannot_break_out_of_the_page(reader: EpisodeReader) -> None:
    text = page(WORLD, reader.read(0), label="</script><b>&@DATA@", seed="</script>")
    assert "&amp;&#64;DATA&#64;</title>" in text
    assert text.count("</script>") == 2
    assert "&lt;/script&gt;&lt;b&gt;&amp;" in text


def test_a_long_episode_is_cut_and_the_page_says_so(
    reader: EpisodeReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trackmdp.episodes.episode_page.MOST_STEPS", 5)
    data = data_of(page(WORLD, reader.read(longest(reader))))
    assert len(data["target"]) == len(data["belief"]) == 5
    assert "the first 5 steps are shown" in str(data["about"])
    assert MOST_STEPS == 2000


def test_sensors_side_by_side_are_two_numbers_of_a_page() -> None:
    (episode,) = tm.simulate(WORLD, "all_on", 1).complete()
    assert data_of(page(WORLD, episode))["sensed"] == [[0, 16]] * len(episode)  # type: ignore[comparison-overlap]


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_in_a_browser(reader: EpisodeReader, tmp_path: Path) -> None:
    number = longest(reader)
    episode = reader.read(number)
    write_page(reader, tmp_path / "a.html", number)
    last, belief = len(episode) - 1, episode.belief
    assert belief is not None
    with Browser(tmp_path / "profile") as browser:
        browser.view(360, 740, "dark")
        browser.open(tmp_path / "a.html")
        assert browser.ask("Number(document.getElementById('slider').max)") == last
        assert (
            browser.ask("document.querySelectorAll('.cell').length") == len(reader.world().cost) + 1
        )  # and its key

        def value(name: str) -> float:
            return float(browser.ask(f"document.getElementById('v-{name}').dataset.value"))

        def check(t: int) -> None:
            assert value("step") == t + 1
            assert value("reward") == episode.reward[t]
            assert value("total") == episode.returns[t]
            assert value("n") == episode.misses[t]
            assert value("active") == episode.action[t].sum()
            said = browser.ask("document.getElementById('said').textContent")
            assert said.startswith(f"Step {t + 1} of {last + 1}. ")
            cursors = (
                "['lanes', 'sum'].map((id) => document.querySelector(`#${id} .now`).getBBox().x)"
            )
            assert browser.ask(cursors) == [t + 0.5, t + 0.5]
            # WORLD has 4 columns; x and y of the mark are those of the cell it was last located in before the step
            before = [t for t in range(t) if episode.located[t]]
            last_cell = int(episode.target[before[-1]]) if before else episode.start
            mark = browser.ask(
                "[located[0].x, located[0].y].map((at) => Math.floor(at.baseVal.value))"
            )
            assert mark == [last_cell % 4, last_cell // 4]
            likeliest = int(np.sum(np.rint(1e4 * belief[t]) == np.rint(1e4 * belief[t].max())))
            assert browser.ask("guess.getAttribute('d').split('M').length - 1") == likeliest
            on = [
                f"M{cell % 4 + 0.1:.1f} {cell // 4 + 0.1:.1f}h.8v.8h-.8z"
                for cell in episode.action[t].nonzero()[0]
            ]
            forced = episode.forced(WORLD.t_max)[t]
            assert browser.ask("sensors.getAttribute('d')") == ("" if forced else "".join(on))
            if episode.target[t] < 16:
                place = f"row {episode.target[t] // 4 + 1}, column {episode.target[t] % 4 + 1}"
                assert place in said

        check(0)
        for key, t in (
            ("ArrowRight", 1),
            ("ArrowRight", 2),
            ("End", last),
            ("ArrowLeft", last - 1),
            ("Home", 0),
        ):
            browser.press(key)
            check(t)
        browser.press("+")
        assert browser.ask("document.getElementById('speed').value") == "10"
        browser.press(" ")
        assert browser.ask("document.getElementById('play').textContent") == "Pause"
        assert browser.ask("document.getElementById('said').getAttribute('aria-live')") == "off"
        browser.ask(
            "new Promise((done) => { const look = () => at >= 2 ? done() : requestAnimationFrame(look); look(); })"
        )
        browser.press(" ")
        assert browser.ask("document.getElementById('play').textContent") == "Play"
        assert browser.ask("document.getElementById('said').getAttribute('aria-live')") == "polite"
        assert value("step") >= 3
        browser.ask("document.getElementById('next').click()")
        assert browser.ask("document.documentElement.scrollWidth") <= 360
        assert browser.smallest_letters() >= 11
        assert browser.ask("getComputedStyle(document.body).backgroundColor") == "rgb(22, 24, 27)"
        browser.shoot(tmp_path / "phone.png")
        browser.view(1000, 760, "light")
        assert (
            browser.ask("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        )
        browser.shoot(tmp_path / "desk.png")
        assert browser.problems == []


def a_page_of(targets: int, tmp_path: Path) -> tuple[Episode, Path]:
    """An episode of several targets of 15 steps or more, on a page made by its log and by `page` alike."""
    world = tm.make_world("random_walk", size=(3, 5), exit_probability=0.05, cost=0.3)
    found = tm.simulate(tm.Group([world] * targets), "optimal", 30)
    number = next(k for k, each in enumerate(found) if len(each) >= 15)
    file = found.page(tmp_path / "a.html", number)
    (episode,) = [each for each in found.complete() if each.number == number]
    return episode, file


def test_a_page_of_several_targets_holds_each_of_them(tmp_path: Path) -> None:
    episode, file = a_page_of(3, tmp_path)
    data: Any = data_of(file.read_text(encoding="utf-8"))
    assert "3 targets" in data["about"]
    assert data["reward"] == episode.reward.tolist()
    assert data["bound"] is None
    for k, (told, single) in enumerate(zip(data["targets"], episode.singles(), strict=True)):
        assert told["start"] == episode.start[k]
        assert told["target"] == np.where(single.target == 15, -1, single.target).tolist()
        assert told["located"] == single.located.astype(int).tolist()
        assert single.belief is not None
        for shares, belief in zip(told["belief"], single.belief, strict=True):
            whole = np.zeros(15)
            whole[shares[::2]] = shares[1::2]
            assert whole == pytest.approx(1e4 * belief, abs=0.5)


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("targets", [6, *later([3])])
def test_several_targets_in_a_browser(targets: int, tmp_path: Path) -> None:
    episode, file = a_page_of(targets, tmp_path)
    with Browser(tmp_path / "profile") as browser:
        browser.view(360, 740, "dark")
        browser.open(file)
        for t in range(len(episode)):
            inside = episode.target[t] < 15
            shown = browser.ask("target.map((each) => each.style.display === '')")
            assert shown == inside.tolist()
            at = browser.ask(
                "target.map((e) => [e.getAttribute('cx'), e.getAttribute('cy'), e.getAttribute('class')])"
            )
            numbers = browser.ask("names.map((each) => each.textContent)")
            assert numbers == [str(k) for k in range(targets)]
            for k in np.flatnonzero(inside):
                row, column = divmod(int(episode.target[t, k]), 5)
                kind = "target" if episode.located[t, k] else "missed"
                assert at[k] == [str(column + 0.5), str(row + 0.5), kind]
            colours = browser.ask("target.map((each) => each.style.getPropertyValue('--target'))")
            assert len(set(colours)) == targets
            said = browser.ask("document.getElementById('said').textContent")
            if targets > 4:
                assert f"{episode.located[t].sum()} of {targets} targets located" in said
            else:
                assert said.count("has left") == int((~inside).sum())
            browser.press("ArrowRight")
        assert browser.ask("document.documentElement.scrollWidth") <= 360
        assert browser.smallest_letters() >= 11
        shown = browser.ask("document.body.innerText")
        assert "expected here" in shown and "the bound on" not in shown
        assert browser.problems == []


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("targets", [1, 2])
def test_the_mode_of_each_target_is_shown_in_a_browser(targets: int, tmp_path: Path) -> None:
    """By its number, and by an arrow from the middle of the cell, as long as the mode's mean step or more."""
    world = tm.make_world("heading", size=3, exit_probability=0.2)
    found = tm.simulate(world if targets == 1 else tm.Group([world] * targets), "none", 9)
    number = next(k for k, each in enumerate(found) if len(each) >= 4)
    episode = found[number]
    assert episode.mode is not None
    with Browser(tmp_path / "profile") as browser:
        browser.view(390, 844, "light")
        browser.open(found.page(tmp_path / "a.html", number))
        for modes, cells in zip(episode.mode, episode.target, strict=True):
            told = [(int(m), int(c)) for m, c in zip(*np.atleast_1d(modes, cells), strict=True)]
            shown = browser.ask("document.getElementById('v-mode').innerText")
            assert shown == " ".join("–" if mode < 0 else str(mode) for mode, _ in told)
            arrows = browser.ask("headings.map((each) => each.getAttribute('d'))")
            for (mode, cell), arrow in zip(told, arrows, strict=True):
                assert (arrow == "") == (mode < 0)
                if arrow:  # M from L to, and the head
                    drawn = np.array(re.findall(r"[-\d.e]+", arrow)[:4], float).reshape(2, 2)
                    assert drawn[0] == pytest.approx([cell % 3 + 0.5, cell // 3 + 0.5])
                    step, drift = drawn[1, ::-1] - drawn[0, ::-1], world.drift[mode]
                    assert step @ drift == pytest.approx(np.hypot(*step) * np.hypot(*drift))
                    assert np.hypot(*step) >= np.hypot(*drift) - 1e-9
            browser.press("ArrowRight")
        assert browser.problems == []


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_the_page_of_a_recorded_track_has_neither_belief_nor_bound(tmp_path: Path) -> None:
    setting = recorded_tracks(by_hand([0, 1, 2, 5], [4, 3, 0], [8, 7, 4, 1]))
    file = simulate(setting, "all_on", 2).page(tmp_path / "a.html", 1)
    with pytest.raises(UserError, match="episode 2, expected 0 to 1"):
        simulate(setting, "all_on", 2).page(tmp_path / "b.html", 2)
    with Browser(tmp_path / "profile") as browser:
        browser.view(390, 844, "light")
        browser.open(file)
        shown = browser.ask("document.body.innerText")
        assert "held-out track" in shown
        assert "most likely" not in shown and "bound" not in shown
        assert browser.ask("document.querySelector('.limit')") is None
        assert browser.problems == []
