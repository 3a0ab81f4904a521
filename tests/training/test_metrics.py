"""What a run writes of itself."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trackmdp.config.compose import compose
from trackmdp.config.logs import CsvConfig, TensorboardConfig
from trackmdp.durable import write_json, write_text
from trackmdp.training.callbacks import Position
from trackmdp.training.loggers import CsvLogger
from trackmdp.training.result_loggers import TensorboardLogger

ROW = {"iteration": 1, "frames": 256, "aihtr": 0.1 + 0.2, "loss": 1e-300, "gap": -1 / 3}


def trainer(frames: int) -> Any:
    """What a log asks of a trainer."""
    known = {
        "config": compose("train"),
        "error": KeyboardInterrupt(),
    }  # cut: there are no final figures
    return SimpleNamespace(position=Position(frames=frames), due=lambda every: every == 1, **known)


TRAINER = trainer(0)


def opened(folder: Path) -> CsvLogger:
    log = CsvLogger(CsvConfig(every=1), folder)
    log.on_start(TRAINER)
    return log


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_numbers_read_back_exactly_and_are_on_the_disk_at_once(tmp_path: Path) -> None:
    log = opened(tmp_path)
    log.write(ROW)
    assert {key: float(value) for key, value in rows(tmp_path)[0].items()} == ROW
    log.write(ROW | {"iteration": 2})
    assert len(rows(tmp_path)) == 2
    log.on_end(TRAINER)


def test_what_is_missing_or_not_finite_is_an_empty_field(tmp_path: Path) -> None:
    log = opened(tmp_path)
    log.write(ROW)
    log.write({"iteration": 2, "frames": 512, "aihtr": None, "loss": math.nan, "gap": math.inf})
    log.on_end(TRAINER)
    assert rows(tmp_path)[1] == {
        "iteration": "2",
        "frames": "512",
        "aihtr": "",
        "loss": "",
        "gap": "",
    }


def test_the_columns_are_those_of_the_first_row(tmp_path: Path) -> None:
    log = opened(tmp_path)
    log.write(ROW)
    with pytest.raises(ValueError, match="surprise"):
        log.write(ROW | {"surprise": 1.0})
    log.on_end(TRAINER)


def test_tensorboard_gets_the_same_numbers(tmp_path: Path) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    log = TensorboardLogger(TensorboardConfig(every=1), tmp_path)
    log.on_start(trainer(0))
    log.on_update(trainer(256), ROW)
    log.on_update(trainer(512), ROW | {"iteration": 2, "loss": None})
    log.on_end(TRAINER)
    read = events.EventAccumulator(str(tmp_path / "tensorboard"))
    read.Reload()
    assert [(event.step, event.value) for event in read.Scalars("aihtr")] == [
        (1, pytest.approx(0.3)),
        (2, pytest.approx(0.3)),
    ]
    assert len(read.Scalars("loss")) == 1


def test_json_is_strict_and_whole(tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    write_json(file, {"a": [1.5, math.nan, (math.inf,)], "b": {"c": None, 3: "d"}, "e": 0.1 + 0.2})

    def refuse(word: str) -> None:
        raise AssertionError(word)

    content = json.loads(file.read_text(), parse_constant=refuse)
    assert content == {"a": [1.5, None, [None]], "b": {"c": None, "3": "d"}, "e": 0.1 + 0.2}
    with pytest.raises(TypeError):
        write_json(file, {"a": np.zeros(2)})
    assert json.loads(file.read_text()) == content


def test_a_crash_while_writing_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "config.yaml"
    write_text(file, "old")

    def crash(descriptor: int) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.fsync", crash)
    with pytest.raises(OSError, match="disk full"):
        write_text(file, "new")
    assert file.read_text() == "old"
