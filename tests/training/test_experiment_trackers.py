"""Runs logged with the real wandb and mlflow, offline: read back with their own messages and client."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.training.runs import killed_and_resumed, rows
from tests.typed import ENVIRONMENT
from trackmdp.app.cli import main
from trackmdp.config import MlflowConfig, load_run_config, to_dict
from trackmdp.errors import UserError, adding
from trackmdp.policies.policy import Policy
from trackmdp.training.callbacks import Training
from trackmdp.training.result_loggers import MlflowLogger
from trackmdp.training.run import load_run
from trackmdp.training.train import train as train_in_python
from trackmdp.world.make import make_world

BLOCK = 32768


def records(file: Path) -> Iterator[Any]:
    """The messages of a `.wandb` file: a header of 7 bytes, then LevelDB's log format."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, place, whole = file.read_bytes(), 7, b""
    while place + 7 <= len(data):
        # A block's last bytes, too few for a record's own header (CRC, length, kind), are padding.
        if BLOCK - place % BLOCK < 7:
            place += BLOCK - place % BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", data[place : place + 7])
        whole += data[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # a whole record, or the last part of one
            record = Record()
            record.ParseFromString(whole)
            whole = b""
            yield record


def offline(folder: Path) -> list[dict[str, Any]]:
    """The processes of a run as wandb kept them: id, config, rows, and the last summary."""
    found = []
    for file in sorted((folder / "wandb").glob("offline-run-*/*.wandb")):
        run: dict[str, Any] = {"rows": [], "summary": {}, "config": {}}
        for record in records(file):
            kind = record.WhichOneof("record_type")
            if kind == "run":
                run |= {"id": record.run.run_id, "project": record.run.project}
                run["config"] |= {
                    each.key: json.loads(each.value_json) for each in record.run.config.update
                }
            elif kind == "history":
                run["rows"].append(read(record.history.item))
            elif kind == "summary":
                run["summary"] |= read(record.summary.update)
        found.append(run)
    return found


def assert_same_policy(file: Path, other: Path) -> None:
    first, second = Policy.load(file), Policy.load(other)
    assert (first.sets != second.sets).nnz == 0


def read(items: Any) -> dict[str, Any]:
    return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items}


def test_wandb_offline(tmp_path: Path) -> None:
    """Config, every row, also those after the last frame, and the final figures; resumed, under the same id."""
    pytest.importorskip("wandb")
    words = ("log=[wandb]", "log.wandb.project=ours")
    killed_and_resumed(tmp_path, 6, *words, algo="hindsight")
    first, second = offline(tmp_path)
    assert first["id"] == second["id"]
    assert first["project"] == "ours"
    assert {key: first["config"][key] for key in ("seed", "log")} == {
        key: to_dict(load_run_config(tmp_path))[key] for key in ("seed", "log")
    }
    logged = [*first["rows"], *second["rows"]]
    table = {int(row["iteration"]): row for row in rows(tmp_path)}
    assert [row["iteration"] for row in first["rows"]] == list(range(1, 6))
    assert [row["iteration"] for row in logged] == list(table) == list(range(1, 13))
    for row in logged:
        for key in ("frames", "aihtr"):
            assert str(row.get(key, "")) == table[row["iteration"]][key]
    evaluation = load_run(tmp_path).evaluation
    assert second["summary"]["final/aihtr"] == evaluation.aihtr
    assert not any(key.startswith("final/") for key in first["summary"])
    (last,) = (tmp_path / "wandb").glob("offline-run-*/files/media/images")
    assert {each.name.split("_")[0] for each in last.iterdir()} == {"policy", "value", "world"}
    file = sorted((tmp_path / "wandb").glob("offline-run-*/*.wandb"))[-1]
    kinds = [record.WhichOneof("record_type") for record in records(file)]
    assert kinds.count("artifact") or any(
        record.request.WhichOneof("request_type") == "log_artifact" for record in records(file)
    )


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning"
)  # mlflow's database layer calls deprecated names
def test_mlflow_in_the_folder(tmp_path: Path) -> None:
    """One run with the options as parameters, each row once although two processes logged it, and final figures.

    Iterations 9 to 12 are after the last frame.
    """
    pytest.importorskip("mlflow")
    from mlflow import MlflowClient

    words = ("log=[mlflow]", "checkpoint.every=512")
    killed_and_resumed(tmp_path, 11, *words, algo="hindsight")
    client = MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("trackmdp")
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.params["seed"] == str(load_run_config(tmp_path).seed)
    assert run.data.params["log.mlflow.every"] == "1"
    table = rows(tmp_path)
    history = client.get_metric_history(run.info.run_id, "frames")
    assert [int(each.value) for each in history] == [int(row["frames"]) for row in table]
    aihtr = {each.step: each.value for each in client.get_metric_history(run.info.run_id, "aihtr")}
    assert aihtr == {int(row["iteration"]): float(row["aihtr"]) for row in table if row["aihtr"]}
    assert run.data.metrics["final/aihtr"] == load_run(tmp_path).evaluation.aihtr
    assert not (tmp_path / "mlruns").exists()
    (artifacts,) = (tmp_path / "mlflow").glob("*/artifacts")
    assert {"policy.png", "value.png", "world.png"} <= {each.name for each in artifacts.iterdir()}
    assert_same_policy(artifacts / "policy.npz", tmp_path / "policy.npz")


def test_an_experiment_that_another_run_makes_at_once_is_shared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As runs of a sweep that begin together: between looking for it and making it, another one has made it."""
    pytest.importorskip("mlflow")
    from mlflow.exceptions import MlflowException

    class Client:
        def __init__(self, uri: str) -> None:
            self.made: list[str] = []

        def get_experiment_by_name(self, name: str) -> Any:
            return SimpleNamespace(experiment_id="7") if name in self.made else None

        def create_experiment(self, name: str, place: str | None) -> str:
            self.made.append(name)
            raise MlflowException("it exists already")

        def create_run(self, number: str, run_name: str) -> Any:
            return SimpleNamespace(info=SimpleNamespace(run_id=f"{number}-{run_name}"))

    monkeypatch.setattr("mlflow.MlflowClient", Client)
    monkeypatch.setattr("trackmdp.training.result_loggers.typed", lambda trainer: {})
    logger = MlflowLogger(MlflowConfig(every=1, uri="http://x", experiment="mine"), tmp_path / "a")
    logger.on_start(cast(Training, None))
    assert logger._id == "7-a"


def test_no_database_is_made_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/mlflow.db").symlink_to(tmp_path / "theirs.db")
    logger = MlflowLogger(MlflowConfig(every=1, uri=None, experiment="mine"), tmp_path / "run")
    with pytest.raises(OSError, match=r"mlflow\.db"):
        logger.on_start(cast(Training, None))
    assert not (tmp_path / "theirs.db").exists()


@pytest.mark.parametrize("name", ["wandb", "mlflow", "tensorboard"])
def test_a_missing_package_is_one_line_and_leaves_no_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda module: None)
    message = f"log=[{name}]: needs {name}, which {adding(name)} adds"
    assert main(["train", f"log=[csv,{name}]", f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert capsys.readouterr().err == f"trackmdp train: {message}\n"
    with pytest.raises(UserError) as caught:
        train_in_python(make_world(size=3), folder=tmp_path / "a", log=[name])
    assert str(caught.value) == message
    assert not (tmp_path / "a").exists()


def test_a_server_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mlflow")
    words = [
        "log=[mlflow]",
        "log.mlflow.uri=nonsense://",
        f"hydra.run.dir={tmp_path / 'a'}",
        "quiet=true",
    ]
    assert (
        main(
            ["train", *words, "algo.total_frames=512", "algo.frames_per_batch=256", "algo.envs=32"]
        )
        == 1
    )
    error = capsys.readouterr().err
    assert error.startswith("trackmdp train: log=[mlflow]: ")
    assert error.count("\n") == 1


@pytest.mark.slow
def test_a_database_that_fails_amid_a_run_is_one_line(tmp_path: Path) -> None:
    """In a process of its own, in which mlflow is first imported by the run."""
    if find_spec("mlflow") is None:
        pytest.skip("mlflow is not installed")
    code = """
import sqlite3, sys
from trackmdp.app.cli import main
from trackmdp.training.loggers import CsvLogger

def breaks(*_):
    sqlite3.connect("a/mlflow.db").execute("DROP TABLE latest_metrics")

CsvLogger.write = breaks
sys.exit(main(["train", "log=[mlflow]", "hydra.run.dir=a", *sys.argv[1:]]))
"""
    frames = ["algo.total_frames=512", "algo.frames_per_batch=256", "algo.envs=32"]
    done = subprocess.run(
        [sys.executable, "-c", code, "grid.size=3", "quiet=true", *frames],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("trackmdp train: log=[mlflow]: ")
    assert done.stderr.count("\n") == 1
