"""Every option of the schema refuses what it does not allow: one line, status 2, nothing written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.config.cases import distinct, files_of
from tests.typed import refused
from trackmdp.config import Option

CASES = distinct()
NAMES = [f"{command} {' '.join(words)} {key}" for command, words, key, _ in CASES]


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def bad_values(item: Option) -> list[str]:
    """Values, as typed, of a wrong type or out of the range of an option."""
    bad = [] if item.nullable or item.kind is Any else ["null"]
    if item.kind is bool:
        bad += ["perhaps", "[true]", "3.5"]
    if item.kind in (int, float):
        bad += ["many", "nan", "inf", "[1]", "{a: 1}", "true", "9" * 400]
        limits = [(item.ge, -1), (item.gt, 0), (item.le, 1), (item.lt, 0)]
        # A float is put beyond its limit by a millionth of it: 1e15 + 1e-6 would be 1e15.
        beyond = [
            limit + by * (1 if item.kind is int else max(1e-6, 1e-6 * abs(limit)))
            for limit, by in limits
            if limit is not None
        ]
        bad += [str(item.kind(value)) for value in beyond]
    if item.kind is int:
        bad += ["1.5"]
    if item.kind is str and (item.choices or item.expects.startswith("cpu")):
        bad += ["elsewhere", "[cpu]"]
    if item.kind in (list[int], list[str]):
        bad += ["elsewhere", "[]", "[null]"] + (["[-1]"] if item.ge == 0 else [])
        # A text of one's own may be a number.
        bad += ["[1.5]", "[elsewhere]"] if item.choices or item.kind == list[int] else []
    if item.kind is Any:
        bad += ["-1", "words", "{a: 1}", "nan", "[1,2]"]
    return bad


def check(case: tuple[str, list[str], str, Option], value: str, capsys: pytest.CaptureFixture[str]) -> None:
    command, words, key, _ = case
    line = refused(capsys, command, *words, f"{key}={value}")
    assert line.startswith(key), line
    assert "expected" in line


@pytest.mark.parametrize("index", range(len(CASES)), ids=NAMES)
def test_every_option_refuses_a_bad_value_in_one_line(index: int, capsys: pytest.CaptureFixture[str]) -> None:
    if bad := bad_values(CASES[index][-1]):
        check(CASES[index], bad[index % len(bad)], capsys)


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(CASES)), ids=NAMES)
def test_every_option_refuses_another_bad_value_in_one_line(index: int, capsys: pytest.CaptureFixture[str]) -> None:
    if bad := bad_values(CASES[index][-1]):
        check(CASES[index], bad[(index + 1) % len(bad)], capsys)


@pytest.mark.parametrize("index", range(len(CASES)), ids=NAMES)
def test_every_option_allows_none_of_its_bad_values(index: int) -> None:
    item = CASES[index][-1]
    if item.kind is Any or item.expects.startswith("cpu"):
        return  # checked by rules of their own, through the command line above
    parser = OverridesParser.create()
    for value in bad_values(item):
        assert not item.allows(parser.parse_override(f"key={value}").value()), value


NODES = list({(command, *words, key.rpartition(".")[0]): None for command, words, key, _ in CASES})


@pytest.mark.parametrize("index", range(len(NODES)), ids=[" ".join(node) for node in NODES])
def test_unknown_keys_are_refused_everywhere(index: int, capsys: pytest.CaptureFixture[str]) -> None:
    command, *words, key = NODES[index]
    name = f"{key}.sizzle".lstrip(".")
    words = list(dict.fromkeys([*words, *files_of(command, words[0] if words else "")]))
    line = refused(capsys, command, *words, f"{'+' if index % 2 else ''}{name}=1")
    assert line.startswith(f"{name}: unknown ")
    assert "(known: " in line
