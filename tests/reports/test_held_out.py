"""The page of a policy on recorded tracks: its numbers, shades, legends, and the track that is drawn."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.tracks import by_hand, recorded
from trackmdp.episodes.simulate import simulate
from trackmdp.grid.place import Place
from trackmdp.policies.policy import Policy
from trackmdp.recordings.tracks import Recorded
from trackmdp.reports.held_out import recorded_page
from trackmdp.training.evaluator import HeldOutEvaluator


def page(world: Recorded, cells: tuple[int, ...] = (1,), subject: str = "<mine>, newest.pt") -> str:
    """The page of a policy that senses `cells`."""
    chains = np.zeros((9, 2, 9), dtype=bool)
    chains[:, :, list(cells)] = True
    policy = Policy.from_dense(world, chains)
    evaluator = HeldOutEvaluator(world)
    episodes = simulate(world, policy, 4, seed=0)
    report = evaluator.held_out(policy)
    replayed = {"policy": evaluator.replayed(policy)}
    return recorded_page(world, subject, report, replayed, {"policy": episodes}).html()


def tracks(*cells: list[int], place: Place | None = None) -> Recorded:
    """Tracks on 3 x 3 cells."""
    return recorded(by_hand(*cells), place=place)


def section(text: str, anchor: str) -> str:
    found = re.search(f'<section id="{anchor}">.*?</section>', text, re.DOTALL)
    assert found
    return found[0]


def maps(text: str) -> list[str]:
    return re.findall(r"<figure>.*?</figure>", section(text, "where"))


def test_the_table_holds_the_figures_of_every_policy() -> None:
    """0 > 1 is sensed, 1 > 1 as well, 1 > 4 is not: 3 sensors, 2 of 3 steps located, over 4 steps with the exit."""
    text = page(tracks([0, 1, 1, 4]))
    rows = re.findall(r"<tr><td>(.*?)</tr>", section(text, "earns"))
    names = [re.sub("<.*", "", row) for row in rows]
    assert names == ["&lt;mine&gt;", "all on", "no sensors", "Q_MDP of the estimated kernel"]
    values = [float(each) for each in re.findall(r'data-v="([^"]+)"', rows[0])]
    assert values == pytest.approx([(2 - 3 * 0.2) / 4, 100 * 2 / 3, 1.0, 2 - 3 * 0.2])
    assert "<mine>" not in text and "newest.pt" not in text


def test_shades_are_the_shares_of_steps() -> None:
    """Cells 0, 1 and 4 are visited, once, twice and once; the sensor of cell 1 is on in every step, 8's too."""
    recording, sensed = maps(page(tracks([0, 1, 1, 4]), cells=(1, 8)))
    square = r'd="M(\d) (\d)h1v1h-1z" fill-opacity="([\d.]+)"'
    assert re.findall(square, recording) == [
        ("0", "0", "0.71"),
        ("1", "0", "1.00"),
        ("1", "1", "0.71"),
    ]
    assert re.findall(square, sensed) == [("1", "0", "1.00"), ("2", "2", "1.00")]
    assert re.findall(r'points="([^"]+)"', recording) == ["0.5,0.5 1.5,0.5 1.5,0.5 1.5,1.5"]


def test_maps_have_a_legend_of_shades_and_the_frame_of_the_strip() -> None:
    text = page(tracks([0, 1, 1, 4]))
    recording, sensed = maps(text)
    assert " 2 visits<" in recording and " 100.0%<" in sensed
    assert all(each.count("stroke-dasharray") == 1 for each in (recording, sensed))
    assert "rows 1 to 2, columns 1 to 2" in section(text, "steps")


@pytest.mark.parametrize(
    ("place", "width", "words"),
    [
        (Place((0.0, 0.0), 70.0), 50 / 210, "50; y points up"),
        (Place((0.0, 0.0), 400.0, downwards=True), 200 / 1200, "200; y points down"),
        (Place((0.0, 0.0), 1000.0, crs="EPSG:32632"), 1 / 3, "1000 m; north points up"),
    ],
)
def test_a_map_with_a_place_has_a_scale_bar_and_a_direction(
    place: Place, width: float, words: str
) -> None:
    for each in maps(page(tracks([0, 1, 1, 4], place=place))):
        assert f"width:{100 * width:.1f}%" in each
        assert f">{words}<" in each
    assert "points up" not in page(tracks([0, 1, 1, 4]))


def test_the_track_through_most_cells_is_drawn_step_by_step() -> None:
    """Of 0 0 0 0 and 0 1 4 5: located, missed, located by the safe action at last, gone."""
    text = section(page(tracks(*[[0, 0, 0, 0], [0, 1, 4, 5, 5]] * 3)), "steps")
    events = ["1: 1 on", "2: 1 on", "3: 1 on", "4: safe action", "5: left"]
    assert re.findall(r">(\d: [^<]+)<", text) == events
    assert re.findall(r'cx="([\d.]+)" cy="([\d.]+)" r=".3" fill="var\(--(\w+)\)"', text) == [
        ("1.5", "0.5", "vermilion"),
        ("1.5", "1.5", "page"),
        ("2.5", "1.5", "page"),
        ("2.5", "1.5", "vermilion"),
    ]


def test_nothing_is_loaded_and_nothing_sensed_is_a_page_too() -> None:
    text = page(tracks([0, 1]), cells=())
    assert not re.search(r'(src|href)="(?!#)', text)
    assert "nan" not in text
