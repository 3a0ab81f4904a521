"""`problem.npz`: any problem comes back as it was, and a file that holds none is refused in one line."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import small_world
from tests.tracks import by_hand, recorded
from trackmdp.arrays.files import npz_bytes
from trackmdp.errors import UserError
from trackmdp.grid.place import Place
from trackmdp.world.model import World
from trackmdp.world.problem import Problem
from trackmdp.world.problem_file import (
    problem_arrays,
    problem_bytes,
    problem_digest,
    read_problem,
)

PRICES = np.linspace(0.1, 0.3, 9)


def three_parts() -> Problem:
    learned, chosen = by_hand((0, 1, 2), (4,), exits=(True, False)), by_hand((8, 8))
    parts = {"held_out": by_hand((5, 4, 3, 0)), "validation": chosen}
    loaded = {"reports read": 9, "steps outside. of the grid": 2}
    return recorded(learned, **parts, anywhere=True, loaded=loaded, memory="displacement")


def footprints() -> Problem:
    table = np.array([[1, 1, 0, 0, 0, 0, 0, 0, 0], [0, 1, 1, 1, 1, 1, 1, 1, 1]])
    return World.of(small_world(), small_world().kernel, cost=[0.1, 0.2], coverage=table)


def missing() -> Problem:
    chances = {"detection": np.linspace(0.5, 1, 9), "safe_detection": 0.9}
    limits = {"window": 1, "max_steps": 7, "safe_cost": 1.1}
    return World.of(small_world(), small_world().kernel, cost=PRICES, **chances, **limits)


def placed() -> Problem:
    return replace(three_parts(), place=Place((-3.5, 2e6), 0.1, "EPSG:2056", downwards=True))


def hidden() -> Problem:
    return tm.make_world("heading", size=3, memory="two_displacements", clip=1)


@pytest.mark.parametrize("made", [small_world, three_parts, placed, footprints, missing, hidden])
def test_a_problem_comes_back_as_it_was(made: Any, tmp_path: Path) -> None:
    problem = made()
    (tmp_path / "a.npz").write_bytes(problem_bytes(problem))
    found = read_problem(tmp_path / "a.npz")
    assert type(found) is type(problem)
    assert problem_digest(found) == problem_digest(problem)
    assert problem_bytes(found) == problem_bytes(problem)
    for name in ("size", "t_max", "max_steps", "window", "safe_cost", "memory", "clip", "place"):
        assert getattr(found, name) == getattr(problem, name)
    if isinstance(problem, World):
        assert (found.kernel != problem.kernel).nnz == 0  # type: ignore[union-attr]


def test_the_digest_depends_on_every_argument() -> None:
    world = small_world()
    assert {field.name for field in fields(world)} <= {
        name.partition(".")[0] for name in problem_arrays(missing())
    } | {"budget", "coverage", "place"}
    changes: list[dict[str, Any]] = [{}, {"cost": PRICES}, {"reward": 2.0}, {"window": 1}]
    changes += [{"memory": "displacement"}, {"detection": 0.9}, {"t_max": 2}, {"budget": 1}]
    made = [World.of(world, world.kernel, **change) for change in changes]
    assert len({problem_digest(each) for each in made}) == len(changes)


def test_the_digest_depends_on_the_tracks() -> None:
    given = three_parts()
    other = replace(given.tracks, names=given.tracks.names + 1)  # type: ignore[union-attr]
    assert problem_digest(replace(given, tracks=other)) != problem_digest(given)


def test_the_digest_depends_on_the_place() -> None:
    assert len({problem_digest(each) for each in (three_parts(), placed())}) == 2


ARRAYS = problem_arrays(three_parts())
PLACED = problem_arrays(placed())
TWO = problem_arrays(tm.Group([small_world(), small_world(seed=1)]))
"""Kernels of 9 + 9 states, members 0 and 1."""


@pytest.mark.parametrize(
    "content",
    [
        b"PK",
        npz_bytes(ARRAYS | {"kind": np.str_("Task")}),
        npz_bytes(ARRAYS | {"t_max": np.int64(-1)}),
        npz_bytes(ARRAYS | {"markov": np.zeros(2, dtype=bool)}),
        npz_bytes(ARRAYS | {"surplus": np.int64(1)}),
        npz_bytes(ARRAYS | {"tracks.cells": np.array([0, 1, 9, 4])}),
        npz_bytes(ARRAYS | {"tracks.cells": np.array([0, -1, 2, 4])}),
        npz_bytes(ARRAYS | {"tracks.cells": np.array([0, 1, np.nan, 4])}),
        npz_bytes(PLACED | {"place.cell": np.float64(0)}),
        npz_bytes(PLACED | {"place.cell": np.float64(np.nan)}),
        npz_bytes(PLACED | {"place.corner": np.array([0.0, np.inf])}),
        npz_bytes(PLACED | {"place.corner": np.zeros(3)}),
        npz_bytes(PLACED | {"place.corner": np.float64(0)}),
        npz_bytes(PLACED | {"place.crs": np.str_("/etc/passwd")}),
        npz_bytes(TWO | {"members": np.array([-1, 1])}),  # two numbers, one motion
        npz_bytes(TWO | {"kernel.indices": (TWO["kernel.indices"] + 9) % 18}),
        npz_bytes(TWO | {"kernel.shape": np.array([18, 20])}),
        npz_bytes(PLACED | {"place.crs": np.int64(2056)}),
        npz_bytes(PLACED | {"place.more": np.int64(1)}),
        npz_bytes(ARRAYS | {"tracks.first": np.array([0, 3, 99])}),
        npz_bytes(ARRAYS | {"tracks.first": np.array([0, 5, 4])}),
        npz_bytes(ARRAYS | {"held_out.first": ARRAYS["held_out.first"].astype(np.uint64)}),
        npz_bytes(ARRAYS | {"held_out.names": np.array([1, 2])}),
        npz_bytes(ARRAYS | {"held_out.exits": np.array([{}], dtype=object)}),
        npz_bytes(problem_arrays(small_world()) | {"kernel.indices": np.full(81, 99)}),
        npz_bytes(problem_arrays(small_world()) | {"kernel.data": np.full(81, 0.5)}),
    ],
)
def test_a_file_that_holds_no_problem_is_refused_in_one_line(
    content: bytes, tmp_path: Path
) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(UserError) as caught:
        read_problem(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "a.npz"))
