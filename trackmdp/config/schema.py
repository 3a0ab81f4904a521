"""What every schema has: rules between its options, and an estimate of the memory that they ask for."""

from __future__ import annotations

from dataclasses import Field, dataclass
from typing import Any, ClassVar, Protocol, dataclass_transform

from trackmdp.config.options import nested, option

BYTES = {"float32": 4, "int64": 8, "float64": 8, "int16": 2, "bool": 1}
"""Bytes of one number of each kind, for `memory`."""


class Sizes(Protocol):
    """What `memory` may know of a task: a `trackmdp.world.model.Task` is one."""

    @property
    def num_cells(self) -> int:
        """M."""

    @property
    def num_choices(self) -> int:
        """t_max + 1."""

    @property
    def num_sensors(self) -> int:
        """K."""

    @property
    def t_max(self) -> int:
        """T_max."""

    @property
    def num_keys(self) -> int:
        """Plans of a policy."""

    @property
    def keyed(self) -> bool:
        """Whether a key is more than the cell."""

    @property
    def pair_bytes(self) -> int:
        """Bytes that exact evaluation over pairs of a key and a mode takes; 0 where there is none."""

    @property
    def order(self) -> int:
        """Detections before the last one that are remembered."""

    @property
    def markov(self) -> bool:
        """Whether moves of different paths combine."""


@dataclass_transform(kw_only_default=True, field_specifiers=(option, nested))
class NodeConfig:
    """Base of every schema, each a dataclass with keywords only, whose decorator it need not have.

    A rule on one option is its `option(...)`; what concerns several is said here.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclass(kw_only=True)(cls)

    def check(self, key: str, root: Any) -> None:
        """Look after the rules between options of this node, and between them and those of the whole config.

        Args:
            key: where the node stands, such as ``algo``; what is refused is named ``{key}.{option}``.
            root: the config of the command; its values have passed their own checks.

        Raises:
            UserError: a rule is broken.
        """

    def ignored(self, root: Any) -> dict[str, str]:
        """Options of this node without effect on this config, and why: ``{"alpha": "with algo.prioritized..."}``.

        They are refused where they were typed (`trackmdp.config.checks`).
        """
        return {}

    def needs(self, task: Sizes, root: Any) -> dict[str, int]:
        """Bytes that a run needs for what this node asks for, by the dotted option that they grow with."""
        return {}


class ChoiceConfig(NodeConfig):
    """Base of the config groups; `choice` gives each member its name and what it makes."""

    name: ClassVar[str]
    makes: ClassVar[str]
