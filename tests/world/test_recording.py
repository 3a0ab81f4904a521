"""`recording.npz`: tracks come back as they were, and what is none is refused in one line."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.tracks import by_hand, recorded
from trackmdp.errors import UserError
from trackmdp.world.track_files import read_recording, recording_bytes
from trackmdp.world.tracks import Recorded


def three_parts() -> Recorded:
    learned, chosen = by_hand((0, 1, 2), (4,), exits=(True, False)), by_hand((8, 8))
    return recorded(learned, by_hand((5, 4, 3, 0)), validation=chosen)


def changed(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **(dict(np.load(io.BytesIO(recording_bytes(three_parts())))) | arrays))
    return stream.getvalue()


def test_the_parts_come_back_as_they_were(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(recording_bytes(three_parts()))
    found, given = read_recording(tmp_path / "a.npz", 9), three_parts()
    assert found is not None
    parts = (given.tracks, given.validation, given.held_out)
    assert [part.digest() for part in found] == [part.digest() for part in parts]


def test_columns_are_no_recording(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", track=np.zeros(3), cell=np.zeros(3))
    assert read_recording(tmp_path / "a.npz", 9) is None
    assert read_recording(tmp_path / "a.csv", 9) is None


@pytest.mark.parametrize(
    "content",
    [
        b"PK",
        changed(tracks_cells=np.array([0, 1, 9, 4])),
        changed(tracks_cells=np.array([0, -1, 2, 4])),
        changed(tracks_cells=np.array([0, 1, np.nan, 4])),
        changed(tracks_first=np.array([0, 3, 99])),
        changed(tracks_first=np.array([0, 5, 4])),
        changed(tracks_first=np.array([0])),
        changed(held_out_names=np.array([1, 2])),
        changed(held_out_exits=np.array([{}], dtype=object)),
        changed(validation_exits=np.ones((1, 1), dtype=bool)),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(UserError, match=r"^kernel.path=\S+a.npz: not recorded tracks") as caught:
        read_recording(tmp_path / "a.npz", 9)
    assert "\n" not in str(caught.value)
