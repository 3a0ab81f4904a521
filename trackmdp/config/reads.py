"""Which options does a piece of code read? An option that nothing reads is a bug."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

from trackmdp.config.checks import nodes
from trackmdp.config.options import Option, options

__all__ = ["record_reads"]


@contextmanager
def record_reads(cfg: Any) -> Iterator[set[str]]:
    """Collect the dotted keys of the options of `cfg` that are read inside, in this process.

    Copying the whole config (`to_dict`, `to_yaml`) and checking it do not count as reading.
    """
    reads: set[str] = set()
    keys = {id(node): key for key, node in nodes(cfg)}
    with ExitStack() as stack:
        for schema in {type(node) for _, node in nodes(cfg)}:
            stack.enter_context(
                mock.patch.object(schema, "__getattribute__", _recorder(schema, keys, reads), create=True)
            )
        yield reads


def _recorder(schema: type[Any], keys: dict[int, str], reads: set[str]) -> Any:
    values = {name for name, described in options(schema).items() if isinstance(described, Option)}

    def read(self: Any, name: str) -> Any:
        if name in values and id(self) in keys:
            reads.add(f"{keys[id(self)]}.{name}".lstrip("."))
        return object.__getattribute__(self, name)

    return read
