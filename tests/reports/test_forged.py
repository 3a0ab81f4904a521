"""Runs and stored results that somebody forged: the others are reported, and nothing ends in a traceback."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.reports.sweeps import VERSIONS, write_run
from trackmdp.arrays.files import npz_bytes
from trackmdp.errors import UserError
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.page import build
from trackmdp.reports.results import RESULTS, load_results, save_results
from trackmdp.training.folders import read_summary, write_summary


def forged(run: Path, change: Callable[[str, dict[str, Any]], str]) -> None:
    """The run with another config and summary, whose digests are right."""
    config, summary = run / "config.yaml", read_summary(run)
    config.write_text(change(config.read_text(), summary))
    write_summary(run, {key: value for key, value in summary.items() if key != "files"})


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("when: 2020-01-01", "date is not JSON"),
        ("when: !!set {a, b}", "set is not JSON"),
        (f"many: 0x{'f' * 5000}", "4300 digits"),
        (None, "no 'grid.size'"),
    ],
)
def test_a_config_of_other_values_is_listed(line: str | None, said: str, tmp_path: Path) -> None:
    write_run(tmp_path / "good", "grid.size=3", seed=1)
    write_run(tmp_path / "forged", "grid.size=3")

    def change(config: str, _: dict[str, Any]) -> str:
        return f"{config}{line}\n" if line else config.replace("\ngrid:", "\ngird:")

    forged(tmp_path / "forged", change)
    found = gather_runs(tmp_path)
    assert [run.name for run in found.runs] == ["good"]
    (anomaly,) = found.anomalies
    assert anomaly.run == "forged" and said in anomaly.text


def test_times_and_versions_of_other_kinds_reach_the_page(tmp_path: Path) -> None:
    write_run(tmp_path / "good", "grid.size=3", seed=1)
    write_run(tmp_path / "forged", "grid.size=3")

    def change(config: str, summary: dict[str, Any]) -> str:
        summary |= {"wall_seconds": "3600", "versions": ["<b>"], "machine": "<b>"}
        return config

    forged(tmp_path / "forged", change)
    found = gather_runs(tmp_path)
    assert found.manifest["wall_seconds"] == 3602.0
    assert found.manifest["versions"] == [{"runs": 1, **VERSIONS}]
    assert "other versions" in found.anomalies[0].text
    assert "<b>" not in build(found).html()


def test_a_seed_longer_than_an_integer_is_reported(tmp_path: Path) -> None:
    write_run(tmp_path / "sweep/a", "grid.size=3", seed=10**30)
    save_results(gather_runs(tmp_path / "sweep"), tmp_path)
    assert load_results(tmp_path).maps[0].label.endswith(f"seed {10**30} (n = 1)")


@pytest.mark.parametrize(
    "manifest", [3, {"wall_seconds": "x"}, {"versions": 3}, {"machines": [{"runs": "many"}]}]
)
def test_a_manifest_of_other_kinds_is_refused(manifest: Any, tmp_path: Path) -> None:
    write_run(tmp_path / "sweep/a", "grid.size=3")
    save_results(gather_runs(tmp_path / "sweep"), tmp_path)
    with np.load(io.BytesIO((tmp_path / RESULTS).read_bytes())) as archive:
        arrays = dict(archive)
    content = json.loads(arrays["text"].tobytes()) | {"manifest": manifest}
    arrays["text"] = np.frombuffer(json.dumps(content).encode(), np.uint8)
    (tmp_path / RESULTS).write_bytes(npz_bytes(arrays))
    with pytest.raises(UserError, match="not stored results that can be read"):
        load_results(tmp_path)


def test_runs_of_another_command_are_not_called_not_started(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "grid.size=3")
    (tmp_path / "b").mkdir()
    (tmp_path / "b/done.json").write_text('{"value": 1.0}')
    jobs = [{"folder": name, "overrides": []} for name in "ab"]
    (tmp_path / "sweep.json").write_text(json.dumps({"jobs": jobs, "line": "a 'b", "command": "x"}))
    assert [each.text for each in gather_runs(tmp_path).anomalies] == ["done, but not by train"]
