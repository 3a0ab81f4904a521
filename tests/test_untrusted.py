"""The readers that every file of somebody else's goes through: within bounds, in one line."""

from __future__ import annotations

import io
import json
import os
import tracemalloc
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trackmdp import untrusted
from trackmdp.durable import create, own_folder, reopen, whole_file, write_text
from trackmdp.errors import UserError
from trackmdp.world.files import load_npy


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda file: None, "no such file"),
        (lambda file: file.mkdir(), "a folder, expected an ordinary file"),
        (os.mkfifo, "a pipe, expected an ordinary file"),
        (lambda file: file.symlink_to("/etc/hostname"), "a symbolic link, expected an ordinary file"),
        (lambda file: file.symlink_to("/nowhere"), "a symbolic link, expected an ordinary file"),
        (lambda file: file.write_bytes(bytes(101)), "101 bytes, expected at most 100"),
    ],
)
def test_only_an_ordinary_file_of_bounded_size_is_read(tmp_path: Path, make: Any, said: str) -> None:
    file = tmp_path / "file"
    make(file)
    with pytest.raises(UserError) as refused:
        untrusted.read_bytes(file, most=100)
    assert str(refused.value) == f"{file}: {said}"


def test_a_small_file_takes_little_memory_whatever_the_bound(tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(b"1")
    tracemalloc.start()
    try:
        assert untrusted.read_bytes(tmp_path / "small", most=2**40) == b"1"
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("version", [(1, 0), (2, 0)])
def test_an_array_of_either_version_is_read(version: tuple[int, int]) -> None:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.arange(6.0).reshape(2, 3), version=version)
    stream.seek(0)
    assert np.array_equal(load_npy(stream, len(stream.getvalue())), np.arange(6.0).reshape(2, 3))


def test_a_file_that_the_user_named_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "data").write_bytes(b"1")
    (tmp_path / "link").symlink_to(tmp_path / "data")
    assert untrusted.read_bytes(tmp_path / "link", links=True) == b"1"
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("/dev/zero")
    with pytest.raises(UserError, match="a device"):
        untrusted.read_bytes(tmp_path / "link", links=True)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[" * 10**5, '{"a":' * 33 + "1" + "}" * 33, "[NaN]", "[1e999]", f'{{"n": {2**64}}}', "9" * 9000, "\x00"],
)
def test_json_beyond_its_bounds_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(UserError) as refused:
        untrusted.parse_json(text, "summary.json")
    assert str(refused.value).startswith("summary.json: not JSON (")
    assert "\n" not in str(refused.value)


def test_json_within_bounds_comes_back() -> None:
    content = {"a": [1, -2.5, None, True, "x"], "b": {"c": 2**63, "d": 1e308}}
    assert untrusted.parse_json(json.dumps(content), "x") == content
    assert untrusted.parse_json("[" * 31 + "]" * 31, "x")


@pytest.mark.parametrize("content", [b"[]", b"3", b"null", b'"x"', b"\xff\xfe"])
def test_what_is_no_object_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.json").write_bytes(content)
    with pytest.raises(UserError, match=r"x\.json: (expected a JSON object|not UTF-8 text)"):
        untrusted.read_object(tmp_path / "x.json")


def test_a_changed_number_breaks_the_seal() -> None:
    content = {"aihtr": 49.25, "runs": {"a": [1, 2]}}
    read = json.loads(json.dumps(untrusted.sealed(content)))
    assert untrusted.unsealed(read, "x") == content
    for changed in ({**read, "aihtr": 999.0}, {**read, "more": 1}, content, {**read, "sha256": 3}):
        with pytest.raises(UserError, match="x: its content does not match its digest"):
            untrusted.unsealed(changed, "x")


def test_the_clock_is_no_part_of_the_seal() -> None:
    one, other = ({"aihtr": 1.5, "wall_seconds": time, "optimal": {"seconds": time}} for time in (3.0, 4.0))
    assert untrusted.sealed(one)["sha256"] == untrusted.sealed(other)["sha256"]


def test_whatever_a_decoder_raises_is_one_line() -> None:
    for error in (
        RecursionError("deep"),
        MemoryError(),
        KeyError("a\nb"),
        NotImplementedError("odd\x1b[2J" + "x" * 999),
    ):
        with pytest.raises(UserError) as refused, untrusted.decoded("file", "a table"):
            raise error
        assert str(refused.value).startswith("file: not a table (")
        assert len(str(refused.value)) < 300
        assert untrusted.printable(str(refused.value)) == str(refused.value)


def test_what_a_terminal_would_obey_is_shown() -> None:
    assert untrusted.printable("\x1b]0;title\x07 a\tb\n日本 é") == "\\x1b]0;title\\x07 a\tb\n日本 é"
    assert untrusted.printable("\u202egnp.exe \udc80") == "\\u202egnp.exe \\udc80"


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("theirs")
    for name in ("new", "new.part", "grown"):
        (tmp_path / name).symlink_to(precious)
    with whole_file(tmp_path / "new") as stream:
        stream.write(b"ours")
    assert (tmp_path / "new").read_text() == "ours"
    (tmp_path / "begun").symlink_to(precious)
    with create(tmp_path / "begun") as stream:
        stream.write(b"ours")
    for mode in ("w", "r+"):
        with pytest.raises(UserError, match="grown: a link"):
            reopen(tmp_path / "grown", mode)
    (tmp_path / "folder").symlink_to(tmp_path)
    with pytest.raises(UserError, match="folder: a link or a file"):
        own_folder(tmp_path / "folder")
    assert precious.read_text() == "theirs"


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="pipe: a pipe or a device"):
        reopen(tmp_path / "pipe", "r+")


def test_two_who_write_one_file_take_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "file"
    with ExitStack() as first:
        first.enter_context(whole_file(file)).write(b"first")
        # The second waits for as long as the first writes: here until it has looked once.
        monkeypatch.setattr("time.sleep", lambda _: first.close())
        write_text(file, "second")
    assert file.read_text() == "second"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_who_waits_for_a_file_in_vain_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda _: None)
    with whole_file(tmp_path / "file") as first, pytest.raises(UserError, match="part: another process is writing it"):
        first.write(b"first")
        write_text(tmp_path / "file", "second")
    assert (tmp_path / "file").read_text() == "first"


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / "file.part").write_text("half of what")
    write_text(tmp_path / "file", "whole")
    assert (tmp_path / "file").read_text() == "whole"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]
