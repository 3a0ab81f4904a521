"""The page of a policy on recorded tracks: its numbers, what is shaded, and the track that is drawn."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.tracks import by_hand, recorded
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.policy import Policy
from trackmdp.reports.held_out import recorded_page
from trackmdp.training.evaluator import HeldOutEvaluator


def page(*tracks: list[int], cells: tuple[int, ...] = (1,)) -> str:
    """That of a policy that senses `cells` on 3 x 3 cells."""
    world = recorded(by_hand(*tracks))
    chains = np.zeros((9, 2, 9), dtype=bool)
    chains[:, :, list(cells)] = True
    policy = Policy.from_dense(world, chains)
    evaluator = HeldOutEvaluator(world)
    episodes = simulate(world, policy, 4, seed=0)
    report = evaluator.report(policy)
    return recorded_page(world, "<mine>", report, {"policy": evaluator.replayed(policy)}, {"policy": episodes}).html()


def section(text: str, anchor: str) -> str:
    found = re.search(f'<section id="{anchor}">.*?</section>', text, re.DOTALL)
    assert found
    return found[0]


def test_the_table_holds_the_three_figures_of_every_policy() -> None:
    """0 > 1 is sensed, 1 > 1 as well, 1 > 4 is not: 3 sensors, 2 of 3 steps located, over 4 steps with the exit."""
    text = page([0, 1, 1, 4])
    rows = re.findall(r"<tr><td>(.*?)</tr>", section(text, "earns"))
    cells = [re.sub("<[^>]+>", " ", row).split("  ") for row in rows]
    assert [row[0].strip() for row in cells] == [
        "&lt;mine&gt;",
        "all on",
        "no sensors",
        "Q_MDP of the estimated kernel",
    ]
    values = [float(each) for each in re.findall(r'data-v="([^"]+)"', rows[0])]
    assert values == pytest.approx([(2 - 3 * 0.2) / 4, 100 * 2 / 3, 1.0])
    assert "<mine>" not in text


def test_shades_are_the_shares_of_steps() -> None:
    """Cells 0, 1 and 4 are visited, once, twice and once; the sensor of cell 1 is on in every step, 8's too."""
    recording, sensed = re.findall(r"<figure>.*?</figure>", section(page([0, 1, 1, 4], cells=(1, 8)), "where"))
    square = r'd="M(\d) (\d)h1v1h-1z" fill-opacity="([\d.]+)"'
    assert re.findall(square, recording) == [("0", "0", "0.71"), ("1", "0", "1.00"), ("1", "1", "0.71")]
    assert re.findall(square, sensed) == [("1", "0", "1.00"), ("2", "2", "1.00")]
    assert re.findall(r'points="([^"]+)"', recording) == ["0.5,0.5 1.5,0.5 1.5,0.5 1.5,1.5"]
    assert "at most 100.0%" in sensed


def test_the_track_through_most_cells_is_drawn_step_by_step() -> None:
    """Of 0 0 0 0 and 0 1 4 5: located, missed, located by the safe action at last, gone."""
    text = section(page(*[[0, 0, 0, 0], [0, 1, 4, 5, 5]] * 3), "steps")
    assert re.findall(r">(\d: [^<]+)<", text) == ["1: 1 on", "2: 1 on", "3: 1 on", "4: safe action", "5: left"]
    assert re.findall(r'cx="([\d.]+)" cy="([\d.]+)" r=".3" fill="var\(--(\w+)\)"', text) == [
        ("1.5", "0.5", "vermilion"),
        ("1.5", "1.5", "page"),
        ("2.5", "1.5", "page"),
        ("2.5", "1.5", "vermilion"),
    ]


def test_nothing_is_loaded_and_nothing_sensed_is_a_page_too() -> None:
    text = page([0, 1], cells=())
    assert not re.search(r'(src|href)="(?!#)', text)
    assert "nan" not in text
