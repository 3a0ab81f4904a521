"""Every option of the schema refuses what it does not allow: one line, status 2, nothing written."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.config.cases import distinct, files_of
from tests.typed import refused
from trackmdp.config import ROOTS, Option
from trackmdp.config.compose import compose
from trackmdp.errors import UserError

CASES = distinct()
NAMES = [f"{command} {' '.join(words)} {key}" for command, words, key, _ in CASES]


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def bad_values(item: Option) -> list[str]:
    """Values, as typed, of a wrong type or out of the range of an option."""
    bad = [] if item.nullable or item.kind is Any else ["null"]
    if item.many:
        bad += ["elsewhere", "[]", "[null]"] + (["[-1]"] if item.ge == 0 else [])
        # A text of one's own may be a number.
        return bad + (["[1.5]", "[elsewhere]"] if item.choices or item.kind is int else [])
    if item.kind is bool:
        bad += ["perhaps", "[true]", "3.5"]
    if item.kind in (int, float):
        bad += ["many", "nan", "inf", "[1]", "{a: 1}", "true", "9" * 400]
        limits = [(item.ge, -1), (item.gt, 0), (item.le, 1), (item.lt, 0)]
        # A float is put beyond its limit by a millionth of it: 1e15 + 1e-6 would be 1e15.
        beyond = [
            limit + by * (1 if item.kind is int else max(1e-6, 1e-6 * abs(limit)))
            for limit, by in limits
            if abs(limit) < math.inf
        ]
        bad += [str(item.kind(value)) for value in beyond]
    if item.kind is int:
        bad += ["1.5"]
    if item.kind is str and (item.choices or item.expects.startswith("cpu")):
        bad += ["elsewhere", "[cpu]"]
    if item.kind is Any:
        bad += ["-1", "words", "{a: 1}", "nan", "[1,2]"]
    return bad


def by_rules_of_its_own(item: Option) -> bool:
    return item.kind is Any or item.expects.startswith("cpu")


KINDS = {
    (item.kind, item.many, item.nullable, bool(item.choices)): index
    for index, (*_, item) in enumerate(CASES)
}
TYPED = {
    *KINDS.values(),
    *(index for index, (*_, item) in enumerate(CASES) if by_rules_of_its_own(item)),
    *(next(index for index, case in enumerate(CASES) if case[0] == command) for command in ROOTS),
}
"""One option of each kind and one of each command: what is done with a typed value depends on nothing else."""


@pytest.mark.parametrize("index", sorted(TYPED), ids=NAMES.__getitem__)
def test_an_option_of_each_kind_refuses_a_bad_value_in_one_line(
    index: int, capsys: pytest.CaptureFixture[str]
) -> None:
    command, words, key, item = CASES[index]
    for value in bad_values(item)[index % 3 : 6 : 3]:
        line = refused(capsys, command, *words, f"{key}={value}")
        assert line.startswith(key), line
        assert "expected" in line


def composed_with(command: str, words: list[str], **more: Any) -> Any:
    return compose(command, dict(word.split("=", 1) for word in words) | more)


@cache
def read(value: str) -> Any:
    """A value as Hydra reads it."""
    return OverridesParser.create().parse_override(f"key={value}").value()


@pytest.mark.parametrize("index", range(len(CASES)), ids=NAMES)
def test_every_option_refuses_its_bad_values(index: int) -> None:
    command, words, key, item = CASES[index]
    if by_rules_of_its_own(item) or not (bad := bad_values(item)):
        return
    for value in bad:
        assert not item.allows(read(value)), value
    with pytest.raises(UserError) as caught:
        composed_with(command, words, **{key: read(bad[index % len(bad)])})
    assert str(caught.value).startswith(key)
    assert "expected" in str(caught.value)


NODES = list({(command, *words, key.rpartition(".")[0]): None for command, words, key, _ in CASES})


@pytest.mark.parametrize("index", range(len(NODES)), ids=[" ".join(node) for node in NODES])
def test_unknown_keys_are_refused_everywhere(
    index: int, capsys: pytest.CaptureFixture[str]
) -> None:
    command, *words, key = NODES[index]
    name = f"{key}.sizzle".lstrip(".")
    words = list(dict.fromkeys([*words, *files_of(command, words[0] if words else "")]))
    with pytest.raises(UserError) as caught:
        composed_with(command, words, **{name: 1})
    lines = [str(caught.value)]
    if index % 12 == 0:
        lines += [refused(capsys, command, *words, f"{plus}{name}=1") for plus in ("", "+")]
    for line in lines:
        assert line.startswith(f"{name}: unknown ")
        assert "(known: " in line
