"""The readers that every file of somebody else's goes through: within bounds, in one line."""

from __future__ import annotations

import io
import json
import os
import resource
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trackmdp import untrusted
from trackmdp.durable import create, own_folder, reopen, whole_file, write_text
from trackmdp.errors import UserError


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda file: None, "no such file"),
        (lambda file: file.mkdir(), "is a directory"),
        (os.mkfifo, "a pipe or a device, expected an ordinary file"),
        (
            lambda file: file.symlink_to("/etc/hostname"),
            "a symbolic link, expected an ordinary file",
        ),
        (lambda file: file.symlink_to("/nowhere"), "a symbolic link, expected an ordinary file"),
        (lambda file: file.write_bytes(bytes(101)), "101 bytes, expected at most 100"),
    ],
)
def test_only_an_ordinary_file_of_bounded_size_is_read(
    tmp_path: Path, make: Any, said: str
) -> None:
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


def test_a_file_that_the_user_named_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "data").write_bytes(b"1")
    (tmp_path / "link").symlink_to(tmp_path / "data")
    assert untrusted.read_bytes(tmp_path / "link", links=True) == b"1"
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to("/dev/zero")
    with pytest.raises(UserError, match="a pipe or a device"):
        untrusted.read_bytes(tmp_path / "link", links=True)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[" * 10**5,
        "[NaN]",
        "9" * 9000,
        "\x00",
    ],
)
def test_text_that_is_no_json_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(UserError) as refused:
        untrusted.parse_json(text, "summary.json")
    assert str(refused.value).startswith("summary.json: not JSON (")
    assert "\n" not in str(refused.value)


def test_a_summary_of_900_levels_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text('{"a":' * 900 + "1" + "}" * 900)
    # Python 3.13 reads them all, and then the digest is missing.
    with pytest.raises(UserError, match=r"^x: [^\n]*(\)|not by this program)\Z"):
        untrusted.unsealed(untrusted.read_object(tmp_path / "x.json"), "x")


@pytest.mark.parametrize(
    "text",
    [
        "a: [&x 1, *x]",
        "a: &x [*x]",
        f"a: {'[' * 60}{']' * 60}",
        "a: " + "[" * 10**5,
        "a: !!python/object/apply:os.mkdir [mark]",
        "- 1",
        "3",
        b"\xff\xfa",
        "a: [",
        "a: [" + "1," * 1000 + "1]",
    ],
)
def test_yaml_that_is_no_plain_mapping_is_refused_in_one_line(
    text: str | bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(untrusted, "_MOST_VALUES", 1000)
    with pytest.raises(UserError, match=r"^config.yaml: not a config \([^\n]*\)$"):
        untrusted.parse_yaml(text, "config.yaml")
    assert not list(tmp_path.iterdir())


def stored(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=True, **arrays)
    return stream.getvalue()


def claims(shape: tuple[int, ...]) -> bytes:
    """An .npy file with a header of a shape, and eight numbers."""
    stream = io.BytesIO()
    head = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, head)
    return stream.getvalue() + bytes(64)


@pytest.mark.parametrize("shape", [(10**12,), (7,), (2**40, 2**40), (-8,)])
def test_an_array_of_another_size_than_its_header_names_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(UserError, match=r"^x: not a table"), untrusted.decoded("x", "a table"):
        untrusted.load_npy(io.BytesIO(claims(shape)))


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "mark"),)

    evil = np.array([Evil()], dtype=object)
    with pytest.raises(UserError, match=r"^x: not a table"), untrusted.decoded("x", "a table"):
        untrusted.load_npz(io.BytesIO(stored(a=evil)))
    assert not list(tmp_path.iterdir())


def test_an_archive_beyond_the_limit_is_refused_before_it_is_unpacked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(untrusted, "LARGE", 10**6)
    with pytest.raises(ValueError, match="bytes when unpacked, expected at most 1,000,000"):
        untrusted.load_npz(io.BytesIO(stored(a=np.zeros(10**6))))


def test_every_flipped_bit_of_an_archive_of_arrays_is_found() -> None:
    """One in the length of a comment makes the next array a part of it; times and flags carry no number."""
    whole = {"a": np.arange(3.0), "b": np.arange(2)}
    content, numbers = stored(**whole), {name: list(each) for name, each in whole.items()}
    for bit in range(8 * len(content)):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        found: dict[str, Any] = whole
        with suppress(Exception):
            found = untrusted.load_npz(io.BytesIO(flipped))
        assert {name: list(each) for name, each in found.items()} == numbers, bit


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
    one, other = (
        {"aihtr": 1.5, "wall_seconds": time, "optimal": {"seconds": time}} for time in (3.0, 4.0)
    )
    assert untrusted.sealed(one)["sha256"] == untrusted.sealed(other)["sha256"]


def test_whatever_a_decoder_raises_is_one_line() -> None:
    for error in (
        RecursionError("deep"),
        MemoryError(),
        KeyError("a\nb"),
        NotImplementedError("odd\x1b[2J" + "x" * 999),
        UserError("memory=\x1b[2J: expected another"),
    ):
        with pytest.raises(UserError) as refused, untrusted.decoded("file", "a table"):
            raise error
        own = "file: memory=" if isinstance(error, UserError) else "file: not a table ("
        assert str(refused.value).startswith(own)
        assert len(str(refused.value)) < 300
        assert untrusted.printable(str(refused.value)) == str(refused.value)


def test_what_a_terminal_would_obey_is_shown() -> None:
    assert untrusted.printable("\x1b]0;title\x07 a\tb\n日本 é") == "\\x1b]0;title\\x07 a\tb\n日本 é"
    assert untrusted.printable("\u202egnp.exe \udc80") == "\\u202egnp.exe \\udc80"


def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("theirs")
    for name in ("new", "grown"):
        (tmp_path / name).symlink_to(precious)
    with whole_file(tmp_path / "new") as stream:
        stream.write(b"ours")
    assert (tmp_path / "new").read_text() == "ours"
    (tmp_path / "begun").symlink_to(precious)
    with create(tmp_path / "begun") as stream:
        stream.write(b"ours")
    for empty in (True, False):
        with pytest.raises(OSError, match="grown"):
            reopen(tmp_path / "grown", empty=empty)
    (tmp_path / "folder").symlink_to(tmp_path)
    with pytest.raises(UserError, match="folder: a link or a file"):
        own_folder(tmp_path / "folder")
    assert precious.read_text() == "theirs"


def test_two_who_write_one_file_at_once_leave_one_of_both(tmp_path: Path) -> None:
    with whole_file(tmp_path / "file") as first:
        first.write(b"first")
        write_text(tmp_path / "file", "second")
        assert (tmp_path / "file").read_text() == "second"
    assert (tmp_path / "file").read_text() == "first"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("length", [9, 10**6])
def test_a_disk_that_takes_no_bytes_is_an_error_with_the_name_of_the_file(
    length: int, tmp_path: Path
) -> None:
    """Also of a file of few bytes, which are written first by the flush, and once more when it is closed."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
        with pytest.raises(OSError, match="too large") as raised:
            write_text(tmp_path / "file", "x" * length)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert raised.value.filename == str(tmp_path / "file")
    assert not list(tmp_path.iterdir())


def test_a_failure_leaves_no_part(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), whole_file(tmp_path / "file") as stream:
        stream.write(b"half")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
