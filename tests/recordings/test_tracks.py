"""Recorded tracks: reading files, refusing what is wrong with them, holding some out."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import small_world
from tests.tracks import by_hand, digest_of, drawn, write
from trackmdp.arrays.files import once
from trackmdp.errors import UserError
from trackmdp.recordings.tracks import Tracks, read_tracks, split


def same(one: Tracks, other: Tracks) -> bool:
    return digest_of(one) == digest_of(other)


@pytest.mark.parametrize("size", [None, 3])
@pytest.mark.parametrize("step", [True, False])
def test_files_hold_cells_or_rows_and_columns(size: int | None, step: bool, tmp_path: Path) -> None:
    tracks = drawn(small_world().kernel, 20)
    file = write(tmp_path / "t.csv", tracks, size=size, step=step)
    assert same(read_tracks(file, 3, exits=True), tracks)
    columns = np.genfromtxt(file, delimiter=",", names=True)
    arrays: Any = {name: columns[name].astype(int) for name in columns.dtype.names}
    np.savez(tmp_path / "t.npz", **arrays)
    assert same(read_tracks(tmp_path / "t.npz", 3, exits=True), tracks)


def test_lines_of_several_tracks_may_be_mixed(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("cell, step, track\n4,11,7\n1,-2,-3\n3,10,7\n0,-3,-3\n5,12,7\n")
    tracks = read_tracks(file, 3, exits=False)
    assert tracks.names.tolist() == [-3, 7]
    assert tracks.cells.tolist() == [0, 1, 3, 4, 5]
    assert tracks.first.tolist() == [0, 2, 5]
    assert not tracks.exits.any()
    file.write_text("track,cell\n7,3\n-3,0\n7,4\n-3,1\n7,5\n")
    assert read_tracks(file, 3, exits=True).cells.tolist() == [0, 1, 3, 4, 5]


def test_ids_may_be_texts(tmp_path: Path) -> None:
    """Numbered in their sorted order, as of positions; numbers stay as they are."""
    file = tmp_path / "t.csv"
    file.write_text('"track",cell\nv1,3\n"u,0",0\nv1,4\n"u,0", 1\n 7 ,8\n')
    np.savez(
        tmp_path / "t.npz", track=["v1", "u,0", "v1", "u,0", "7"], cell=np.array([3, 0, 4, 1, 8])
    )
    for path in (file, tmp_path / "t.npz"):
        tracks = read_tracks(path, 3, exits=True)
        assert tracks.names.tolist() == [0, 1, 2]
        assert tracks.cells.tolist() == [8, 0, 1, 3, 4]
        assert tracks.first.tolist() == [0, 1, 3, 5]


def test_a_file_that_has_changed_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    for cell in (1, 2):
        file.unlink(missing_ok=True)
        file.write_text(f"track,cell\n0,{cell}\n")
        os.utime(file, ns=(cell, cell))
        found = once(read_tracks, file, 3, True)
        assert found.cells.tolist() == [cell]
        assert once(read_tracks, file, 3, True) is found
        assert not once(read_tracks, file, 3, False).exits.any()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("track,step,cell\n4,0,1\n4,2,1\n", "track 4: step 2 follows step 0"),
        ("track,step,cell\n4,0,1\n5,0,2\n4,0,1\n", "track 4: step 0 follows step 0"),
        ('track,step,cell\nv,0,1\n"u,0",0,2\n"u,0",0,1\n', "track u,0: step 0 follows step 0"),
        ("track,cell\n0,1\n0,9\n", "cell of entry 2 is 9, expected 0 to 8 on a grid of 3x3 cells"),
        ("track,cell\n0,-1\n", "cell of entry 1 is -1, expected 0 to 8"),
        ("track,row,column\n0,1,3\n", "column of entry 1 is 3, expected 0 to 2"),
        ("track,cell\n0,1.5\n", "cell of entry 1 is 1.5, expected an integer"),
        ("track,cell\n0,nan\n", "cell of entry 1 is nan, expected an integer"),
        ("track,cell\n1e300,1\n", "track of entry 1 is 1e+300, expected an integer"),
        ("track,cell\n", "no tracks, expected at least two"),
        ("track,cell", "no tracks, expected at least two"),
        ("", "columns none, expected track, cell (or row, column) and, if wanted, step"),
        ("0,1\n0,2\n", "columns 0, 1, expected track, cell"),
        ("track,cell,row\n0,1,1\n", "columns track, cell, row, expected track, cell"),
        (
            "track,cell,cell\n0,1,1\n",
            "not a table of numbers (two columns of one name in track,cell,cell)",
        ),
        ("track,cell\n0,one\n", "not a table of numbers"),
        ("track,cell\nv0,1\nv0,one\n", "not a table of numbers (could not convert string 'one'"),
        ("track,cell\nv0,1\n,1\n", "not a table of numbers (could not convert string ''"),
        (
            "track;cell\n0;1\n",
            "not a table of numbers ('track;cell': expected commas between columns)",
        ),
        ("track,cell\nv0,1\nv1,9\n", "cell of entry 2 is 9, expected 0 to 8"),
        ("track,cell\n0,1\n0\n", "not a table of numbers"),
        (
            "track,cell\n0,1,2\n",
            "not a table of numbers (2 names in the first line, but 3 columns)",
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text(text)
    with pytest.raises(UserError) as caught:
        read_tracks(file, 3, exits=True)
    assert str(caught.value).startswith(f"kernel.path={file}: {message}")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_columns_are_refused(tmp_path: Path) -> None:
    track = np.zeros(3, dtype=int)
    np.savez(
        tmp_path / "objects.npz",
        track=track,
        cell=np.array([{}] * 3, dtype=object),
        allow_pickle=True,
    )
    np.savez(tmp_path / "long.npz", track=track, cell=np.zeros(4, dtype=int))
    np.savez(tmp_path / "deep.npz", track=track, cell=np.zeros((3, 1), dtype=int))
    np.savez(tmp_path / "words.npz", track=track, cell=np.array(["a"] * 3))
    (tmp_path / "broken.npz").write_bytes(b"PK nothing")
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "t.txt").write_text("track,cell\n0,1\n")
    for name, message in (
        ("objects.npz", "not a table of numbers"),
        ("long.npz", "columns of different lengths (track 3, cell 4)"),
        ("deep.npz", "cell is not a column of numbers (but int64, shape (3, 1))"),
        ("words.npz", "cell is not a column of numbers"),
        ("broken.npz", "not a table of numbers"),
        ("bytes.csv", "not a table of numbers"),
        ("t.txt", "expected a .csv or .npz file"),
        ("none.csv", "no such file"),
    ):
        with pytest.raises(UserError) as caught:
            read_tracks(tmp_path / name, 3, exits=True)
        assert str(caught.value).startswith(f"kernel.path={tmp_path / name}: {message}")


def test_short_tracks_are_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "x.csv", by_hand([0, 1, 2], [0, 1], [0], [0, 1, 2, 3]))
    assert len(read_tracks(file, 3, exits=True)) == 4
    for shortest, message in (
        (2, r"track 2 has 1 cells, expected at least 2 \(1 of 4 are too short\)$"),
        (4, r"track 0 has 3 cells, expected at least 4 \(3 of 4 are too short\)$"),
    ):
        with pytest.raises(UserError, match=message):
            read_tracks(file, 3, exits=True, shortest=shortest)
    (tmp_path / "t.csv").write_text("track,cell\nbus 7,3\nbus 12,0\nbus 12,1\n")
    with pytest.raises(UserError, match="track bus 7 has 1 cells, expected at least 2"):
        read_tracks(tmp_path / "t.csv", 3, exits=True, shortest=2)


@given(st.integers(2, 50), st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.integers(0, 2**31))
def test_a_split_deals_out_every_track_once(
    count: int, share: float, middle: float, seed: int
) -> None:
    tracks = by_hand(*[[i % 9, (i + 1) % 9, 3][: 1 + i % 3] for i in range(count)])
    last, chosen_by = round(share * count), round(middle * count)
    if not (last and chosen_by and last + chosen_by < count):
        words = r"^kernel\.held_out=.*: leave, of \d+ tracks, none to (judge on|choose by|learn from); expected"
        with pytest.raises(UserError, match=words):
            split(tracks, share, middle, seed)
        return
    mine, validation, held_out = split(tracks, share, middle, seed)
    assert (len(held_out), len(validation)) == (last, chosen_by)
    assert sorted([*mine.names, *validation.names, *held_out.names]) == list(range(count))
    for part in (mine, validation, held_out):
        for place, name in enumerate(part.names):
            cells = part.cells[part.first[place] : part.first[place + 1]]
            assert (
                cells.tolist() == tracks.cells[tracks.first[name] : tracks.first[name + 1]].tolist()
            )
    assert all(map(same, split(tracks, share, middle, seed), (mine, validation, held_out)))
    # how many are validated on does not change which ones are held out
    assert same(split(tracks, share, 1 / count, seed)[2], held_out)


@given(st.integers(0, 2**31))
def test_tracks_of_one_name_stay_together(seed: int) -> None:
    """The pieces of a target's path, cut where it was not seen, are in one part."""
    tracks = replace(by_hand(*[[i % 9, 3] for i in range(30)]), names=np.arange(30) // 3)
    parts = split(tracks, 0.2, 0.1, seed)
    assert [len(part) for part in parts] == [21, 3, 6]
    assert sorted(name for part in parts for name in set(part.names.tolist())) == list(range(10))


def test_the_seed_decides_which_tracks_are_held_out() -> None:
    tracks = by_hand(*[[0, 1]] * 100)
    for part in range(3):
        names = [split(tracks, 0.2, 0.1, seed)[part].names.tolist() for seed in range(3)]
        assert len({tuple(each) for each in names}) == 3


def test_closed_and_limited_by_hand() -> None:
    tracks = by_hand([4, 5], [6, 7, 8], [1], exits=[True, False, True])
    closed = tracks.closed(9)
    assert closed.cells.tolist() == [4, 5, 9, 6, 7, 8, 1, 9]
    assert closed.first.tolist() == [0, 3, 6, 8]
    one, two = tracks.limited(1), tracks.limited(2)
    assert (one.cells.tolist(), one.exits.tolist()) == ([4, 5, 6, 7, 1], [False, False, True])
    assert (two.cells.tolist(), two.exits.tolist()) == ([4, 5, 6, 7, 8, 1], [True, False, True])
    assert tracks.limited(None) is tracks
