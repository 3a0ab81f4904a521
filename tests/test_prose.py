"""The prose of the package, its docstrings and comments, names things: few "what", "who" and "told"."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "trackmdp"
LIMITS = {
    ("what", "who", "whoever", "whose"): 2.0,
    ("told", "tells", "tell", "said", "says", "say"): 0.5,
}
"""Words -> the most of them per 1,000 words of prose. Libraries of the field have .3 to 1.0, and 0 to .1."""


def prose(source: str) -> Iterator[str]:
    """The docstrings and comments of a module."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            yield ast.get_docstring(node) or ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string.lstrip("# ")


@cache
def of_package() -> Counter[str]:
    return words(file.read_text(encoding="utf-8") for file in PACKAGE.rglob("*.py"))


def words(sources: Iterator[str]) -> Counter[str]:
    """How often each word occurs in the prose of some modules."""
    texts = (text for source in sources for text in prose(source))
    return Counter(word for text in texts for word in re.findall(r"[a-z']+", text.lower()))


def rate(found: Counter[str], chosen: tuple[str, ...]) -> float:
    """Occurrences of the `chosen` words per 1,000 words."""
    return 1000 * sum(found[word] for word in chosen) / max(1, found.total())


@pytest.mark.parametrize("chosen", LIMITS, ids=lambda chosen: chosen[0])
def test_the_package_names_things(chosen: tuple[str, ...]) -> None:
    assert rate(of_package(), chosen) <= LIMITS[chosen]


def test_docstrings_and_comments_are_counted_and_code_is_not() -> None:
    source = '"""What it is."""\n\nwhat = "who"  # who says so\n\n\ndef f():\n    """Told."""\n'
    found = words(iter([source]))
    assert found == Counter(["what", "it", "is", "who", "says", "so", "told"])
    assert rate(found, ("what", "who")) == pytest.approx(2000 / 7)
