from __future__ import annotations

import pytest

from trackmdp.errors import UserError, require


def test_what_is_not_installed_names_the_extra_that_adds_it() -> None:
    require("numpy", "none", "solver=x")
    with pytest.raises(UserError) as told:
        require("no_such_module", "more", "solver=x")
    assert str(told.value) == "solver=x: needs no_such_module, which pip install 'trackmdp[more]' adds"
