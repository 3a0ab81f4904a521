"""Every choice names what it makes, and a choice is the only place that says so."""

from __future__ import annotations

import pytest
from omegaconf import ListConfig

from trackmdp.config import GROUPS, ChoiceConfig
from trackmdp.config.registry import maker, read_values, resolved
from trackmdp.errors import UserError

CHOICES = [(group, name) for group, names in GROUPS.items() for name in names]


@pytest.mark.parametrize(("group", "name"), CHOICES)
def test_what_a_choice_makes_is_there(group: str, name: str) -> None:
    schema = GROUPS[group][name]
    assert schema.name == name
    assert callable(maker(schema))
    assert "defaults" in read_values(f"{group}/{name}")


def test_what_is_not_there_is_one_line() -> None:
    class Absent(ChoiceConfig):
        name = "absent"
        makes = "trackmdp.motion.kernels:no_such_kernel"

    with pytest.raises(
        UserError, match=r"absent: cannot be made, trackmdp\.motion\.kernels:no_such_kernel: module"
    ):
        maker(Absent)
    with pytest.raises(UserError, match="kernel/no_such_kernel: no such config"):
        read_values("kernel/no_such_kernel")


def test_a_price_for_each_cell_is_no_node_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A million of them took more than a minute."""
    prices = [0.5] * 90_000
    with monkeypatch.context() as patch:
        patch.setattr(ListConfig, "append", lambda *_: pytest.fail("a node for a price"))
        found = resolved({"cost": {"sensor": prices}, "same": "${cost.sensor}"})
    assert found == {"cost": {"sensor": prices}, "same": prices}
