"""Results as they are stored: the same when read back, small, and refused where damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.reports.sweeps import plan
from trackmdp.errors import UserError
from trackmdp.reports import results
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.results import RESULTS, load_results, save_results


def test_stored_results_read_back_the_same_and_are_small(whole: Path, tmp_path: Path) -> None:
    found = gather_runs(whole)
    save_results(found, tmp_path)
    read = load_results(tmp_path)
    assert read.runs == found.runs
    assert (read.anomalies, read.manifest) == (found.anomalies, found.manifest)
    for one, other in zip(found.maps, read.maps, strict=True):
        assert (one.label, one.size, one.averaged) == (other.label, other.size, other.averaged)
        assert not (one.sets != other.sets).nnz and not (one.kernel != other.kernel).nnz
        assert not (one.after != other.after).nnz
        assert np.array_equal(one.value, other.value) and np.array_equal(one.bound, other.bound)
    content = (tmp_path / RESULTS).read_bytes()
    assert len(content) < 25_000
    save_results(read, tmp_path)
    assert (tmp_path / RESULTS).read_bytes() == content


def test_no_path_of_the_machine_is_kept(sweep: Path, tmp_path: Path) -> None:
    plan(sweep, "a2c-0.16-0")
    save_results(gather_runs(sweep), tmp_path)
    assert load_results(tmp_path).manifest["line"] == "trackmdp train -m"


def test_a_text_that_unpacks_to_more_than_a_large_sweep_has_is_refused(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_results(gather_runs(whole), tmp_path)
    monkeypatch.setattr(results, "_LONGEST_TEXT", 100)
    with pytest.raises(UserError, match="bytes of text, expected at most 100"):
        load_results(tmp_path)


def test_damaged_stored_results_are_refused_in_one_line(whole: Path, tmp_path: Path) -> None:
    save_results(gather_runs(whole), tmp_path)
    content, kept = (tmp_path / RESULTS).read_bytes(), load_results(tmp_path)
    flipped = [
        content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
        for place in range(0, len(content), 211)
    ]
    refused = 0
    for damaged in (b"PK", content[:-40], *flipped):
        (tmp_path / RESULTS).write_bytes(damaged)
        try:
            found = load_results(tmp_path)
        except UserError as error:
            assert RESULTS in str(error) and "\n" not in str(error)
            refused += 1
        else:  # a bit that has no meaning, as in a date of the archive
            assert (found.runs, found.manifest) == (kept.runs, kept.manifest)
    assert refused > len(flipped) / 2
