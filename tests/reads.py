"""Which options does a piece of code read? An option that nothing reads is a bug."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from trackmdp.config.options import Option, nodes, options


@contextmanager
def record_reads(cfg: Any) -> Iterator[set[str]]:
    """Collect the dotted keys of the options of `cfg` that are read inside, in this process.

    Copying the whole config (`to_dict`, `to_yaml`) and checking it do not count as reading.
    """
    reads: set[str] = set()
    keys = {id(node): key for key, node in nodes(cfg)}
    schemas = {type(node) for _, node in nodes(cfg)}
    for schema in schemas:
        schema.__getattribute__ = _recorder(schema, keys, reads)  # type: ignore[method-assign]
    try:
        yield reads
    finally:
        for schema in schemas:
            del schema.__getattribute__


def unread(cfg: Any, reads: set[str]) -> set[str]:
    """The options of `cfg` that are not among `reads`."""
    everything = {
        f"{key}.{name}".lstrip(".")
        for key, node in nodes(cfg)
        for name, item in options(type(node)).items()
        if isinstance(item, Option)
    }
    return everything - reads


def _recorder(
    schema: type[Any], keys: dict[int, str], reads: set[str]
) -> Callable[[Any, str], Any]:
    values = {name for name, described in options(schema).items() if isinstance(described, Option)}

    def read(self: Any, name: str) -> Any:
        if name in values and id(self) in keys:
            reads.add(f"{keys[id(self)]}.{name}".lstrip("."))
        return object.__getattribute__(self, name)

    return read
