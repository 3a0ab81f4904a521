"""`log=[csv,tensorboard,mcap]`: any of the loggers together, in a run, when it is resumed, and as it is typed."""

from __future__ import annotations

from pathlib import Path

import pytest

import trackmdp as tm
from tests.training.runs import killed_and_resumed, rows, train
from trackmdp.app.cli import main
from trackmdp.config import load_run_config, to_dict, to_yaml
from trackmdp.config.compose import compose
from trackmdp.config.resume import continued
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.errors import UserError

ALL = (
    "log=[csv,tensorboard,mcap]",
    "log.mcap.episodes=2",
    "log.csv.every=2",
    "kernel.exit_probability=0.2",
)
EVENTS = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")


def written(folder: Path) -> tuple[list[int], list[int], int]:
    """Iterations of `metrics.csv`, steps of the event files, episodes of the log."""
    events = EVENTS.EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    with EpisodeReader(folder / "episodes.mcap") as reader:
        episodes = len(reader)
    table = [int(row["iteration"]) for row in rows(folder)]
    return table, sorted({event.step for event in events.Scalars("iteration")}), episodes


def test_all_three_are_written_and_each_goes_on_with_the_run(tmp_path: Path) -> None:
    train(tmp_path / "whole", *ALL)
    table, steps, episodes = written(tmp_path / "whole")
    assert (table, steps) == ([2, 4, 6, 8], list(range(1, 9)))
    assert episodes == 4  # of the first evaluation and the last
    assert to_dict(load_run_config(tmp_path / "whole"))["log"] == {
        "csv": {"every": 2},
        "tensorboard": {"every": 1},
        "mcap": {"evaluations": 10, "episodes": 2, "layout": False},
    }
    killed_and_resumed(tmp_path / "half", 6, *ALL)
    assert written(tmp_path / "half") == (table, steps, episodes)
    assert rows(tmp_path / "half") == rows(tmp_path / "whole")
    logs = [(tmp_path / run / "episodes.mcap").read_bytes() for run in ("half", "whole")]
    assert logs[0] == logs[1]


def test_tensorboard_has_pictures_and_hyperparameters(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    train(tmp_path, "log=[tensorboard]")
    events = EVENTS.EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert set(events.Tags()["images"]) == {"policy", "value", "world"}
    assert events.Images("value")[0].encoded_image_string.startswith(b"\x89PNG")
    assert "_hparams_/experiment" in events.summary_metadata
    assert {each.name for each in tmp_path.glob("tensorboard/*") if each.is_dir()} == set()


def test_without_csv_the_table_has_every_iteration(tmp_path: Path) -> None:
    train(tmp_path, "log=[]")
    assert [int(row["iteration"]) for row in rows(tmp_path)] == list(range(1, 9))
    assert not (tmp_path / "tensorboard").exists()


def resumed(folder: Path, *words: str) -> dict[str, object]:
    """What a run that logs three episodes of each evaluation has for `log` once these words resume it."""
    (folder / "config.yaml").write_text(
        to_yaml(compose("train", {"log": ["mcap"], "log.mcap.episodes": 3})), encoding="utf-8"
    )
    typed = dict(word.split("=") for word in words)
    overrides = {
        key: value.strip("[]").split(",") if key == "log" else int(value)
        for key, value in typed.items()
    }
    found = to_dict(continued(compose("train", overrides | {"resume": "auto"}), folder, words))[
        "log"
    ]
    assert isinstance(found, dict)
    return found


MCAP = {"evaluations": 10, "episodes": 3, "layout": False}


@pytest.mark.parametrize(
    ("words", "log"),
    [
        ((), {"mcap": MCAP}),
        (("log=[mcap]",), {"mcap": MCAP}),
        (("log=[csv,mcap]",), {"csv": {"every": 1}, "mcap": MCAP}),
        (("log=[csv]",), {"csv": {"every": 1}}),
        (("log.mcap.episodes=5", "log=[mcap]"), {"mcap": MCAP | {"episodes": 5}}),
        (("log.csv.every=4", "log=[csv,mcap]"), {"csv": {"every": 4}, "mcap": MCAP}),
    ],
)
def test_a_resumed_run_keeps_the_options_of_its_loggers(
    words: tuple[str, ...], log: dict[str, object], tmp_path: Path
) -> None:
    assert resumed(tmp_path, *words) == log


def test_an_option_of_a_logger_that_the_run_does_not_have(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught:
        resumed(tmp_path, "log.csv.every=4")
    assert (
        str(caught.value)
        == "log.csv.every: the run has log=[mcap], expected log=[mcap,csv] beside it"
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("log=[csv,nope]", "log=nope: expected one of csv, tensorboard, wandb, mlflow, mcap"),
        ("log=nope", "log=nope: expected one of csv, tensorboard, wandb, mlflow, mcap"),
        (
            "log=null",
            "log=null: expected one of csv, tensorboard, wandb, mlflow, mcap, or log=[] for none",
        ),
        ("log=csv,mcap", "log=csv,mcap: expected log=[csv,mcap]"),
        ("log.every=2", "log.every: renamed, expected log.csv.every"),
        (
            "log=[csv,mcap] log.mcap.episodes=0",
            "log.mcap.episodes=0: expected an integer from 1 to 1e6 (episodes)",
        ),
        ("log=[mcap] +log.csv={every:2}", "log.csv"),
        ("-m log=[csv],[nope]", "log=nope: expected one of csv, tensorboard, wandb, mlflow, mcap"),
        (
            "log=[wandb] log.wandb.mode=dryrun",
            "log.wandb.mode=dryrun: expected one of offline, online",
        ),
        ("log=[mlflow] log.mlflow.experiment=", "log.mlflow.experiment"),
    ],
)
def test_what_is_wrong_is_one_line(
    words: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", *words.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"trackmdp train: {message}")
    assert error.count("\n") == 1


def test_a_config_file_with_an_unknown_logger_is_one_line(tmp_path: Path) -> None:
    text = to_yaml(compose("train"))
    assert "csv:" in text
    (tmp_path / "config.yaml").write_text(text.replace("csv:", "nope:"), encoding="utf-8")
    with pytest.raises(
        UserError, match="log=nope: expected one of csv, tensorboard, wandb, mlflow, mcap"
    ):
        load_run_config(tmp_path)


def test_help_lists_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "--help", "all"]) == 0
    text = capsys.readouterr().out
    listed = (
        "log=csv|tensorboard|wandb|mlflow|mcap (default: [csv]); any of them as a list, none by []"
    )
    assert listed in " ".join(text.split())
    assert main(["train", "log=[csv,mcap]", "--help"]) == 0
    text = capsys.readouterr().out
    assert "  log.csv.every=1 " in text
    assert "  log.mcap.episodes=10 " in text
    assert "log.tensorboard" not in text


def test_from_python(tmp_path: Path) -> None:
    world = tm.make_world("random_walk", size=3, exit_probability=0.2)
    options = {
        "collector.total_frames": 512,
        "collector.frames_per_batch": 256,
        "collector.envs": 32,
    }
    tm.train(
        world,
        "a2c",
        folder=tmp_path,
        log=["csv", "mcap"],
        **{"log.mcap.episodes": 2, "optimal.enabled": False} | options,
    )
    with EpisodeReader(tmp_path / "episodes.mcap") as reader:
        assert len(reader) == 4
    assert len(rows(tmp_path)) == 2
