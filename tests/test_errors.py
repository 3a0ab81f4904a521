from __future__ import annotations

from pathlib import Path

import pytest

from trackmdp import errors
from trackmdp.errors import UserError, adding, require


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
