from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from trackmdp import errors
from trackmdp.errors import OutputError, UserError, adding, require


def test_what_is_not_installed_names_the_extra_that_adds_it() -> None:
    require("numpy", "none", "solver=x")
    with pytest.raises(UserError) as told:
        require("no_such_module", "more", "solver=x")
    assert str(told.value) == f"solver=x: needs no_such_module, which {adding('more')} adds"


def test_the_line_that_adds_an_extra_is_that_of_the_clone_where_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert adding("x") == f"pip install -e '{Path(__file__).parents[1]}[x]'"
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "site-packages/trackmdp/errors.py"))
    assert adding("x") == "pip install 'trackmdp[x]'"


def test_a_mistake_is_one_line_whatever_was_given() -> None:
    world = tm.make_world(size=2)
    policy = tm.solve(world).policy
    for wrong in (world, np.zeros((3, 3))):  # whose texts have several lines
        for call in (policy.tracker, lambda it: tm.TrackEnv(world, it)):
            with pytest.raises(UserError) as told:
                call(wrong)
            assert "expected" in str(told.value)
            assert "\n" not in str(told.value)


def test_a_mistake_is_the_same_when_copied() -> None:
    for kind in (UserError, OutputError):
        again = copy(kind("a  b=\n 3: expected 4"))
        assert (type(again), str(again)) == (kind, "a  b= 3: expected 4")
