"""`train` from Python: the command's names and defaults, nothing written unless asked for, and no Hydra."""

from __future__ import annotations

import itertools
import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from tests.helpers import small_world, train_config
from tests.tracks import drawn, recorded
from tests.training.runs import rows
from trackmdp.app.cli import main
from trackmdp.app.commands import train as command
from trackmdp.errors import RunError, UserError
from trackmdp.motion.kernels import drift
from trackmdp.policies.policy import Policy
from trackmdp.training import run
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.training.evaluator import Score
from trackmdp.training.run import load_run
from trackmdp.training.train import train
from trackmdp.world.model import World

QUICK: dict[str, Any] = {
    "total_frames": 2048,
    "frames_per_batch": 256,
    "envs": 32,
    "hidden": 16,
    "optimal": {"enabled": False},
    "evaluation.every": 4,
}


class Heard(Callback):
    """Writes down which hooks were called."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def on_start(self, trainer: Training) -> None:
        self.calls.append("start")

    def on_batch(self, trainer: Training, batch: TensorDictBase) -> None:
        self.calls.append(f"batch {tuple(batch.shape)}")

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:
        assert score.evaluation.aihtr == trainer.evaluator.evaluate(policy).aihtr
        self.calls.append("evaluation")

    def on_update(self, trainer: Training, row: Row) -> None:
        self.calls.append(f"update {row['iteration']}")

    def on_checkpoint(self, trainer: Training, file: Path) -> None:
        assert file.is_file()
        self.calls.append("checkpoint")

    def on_end(self, trainer: Training) -> None:
        self.calls.append(f"end {trainer.error}")


def test_it_is_the_run_of_the_command(tmp_path: Path) -> None:
    world = small_world()
    run = train(world, "ppo", seed=3, folder=tmp_path / "python", **QUICK)
    words = [
        f"algo.{key}={QUICK[key]}" for key in ("total_frames", "frames_per_batch", "envs", "hidden")
    ]
    words += [
        "optimal.enabled=false",
        "evaluation.every=4",
        "quiet=true",
        "grid.size=3",
        "cost.sensor=0.2",
    ]
    np.save(tmp_path / "kernel.npy", world.kernel.toarray())
    table = f"kernel.path={tmp_path / 'kernel.npy'}"
    (tmp_path / "typed").mkdir()
    reached = command.run(
        train_config("algo=ppo", "seed=3", "kernel=table", table, *words), tmp_path / "typed"
    )
    assert reached == run.evaluation.aihtr
    assert rows(tmp_path / "typed") == rows(tmp_path / "python")
    assert (tmp_path / "typed/policy.npz").read_bytes() == (
        tmp_path / "python/policy.npz"
    ).read_bytes()


@pytest.mark.parametrize("algo", ["a2c", "dqn"])
def test_nothing_is_written_and_nothing_is_disturbed(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    log, lines = logging.getLogger("torchrl"), list[logging.LogRecord]()
    monkeypatch.setattr(log, "level", logging.INFO)
    monkeypatch.setattr(log, "handle", lines.append)
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    run = train(small_world(), algo, **QUICK)
    assert torch.equal(torch.rand(3), expected)
    assert (lines, log.level) == ([], logging.INFO)
    assert not list(tmp_path.iterdir())
    assert run.folder is None
    assert run.columns["iteration"] == list(range(1, 9))
    assert run.columns["aihtr"][-1] == run.summary["policy"]["aihtr"] == run.evaluation.aihtr
    assert run.policy.dense().shape == (9, 2, 9)


def test_a_run_is_loaded_as_it_ended(tmp_path: Path) -> None:
    run = train(small_world(), "ppo", folder=tmp_path / "run", **QUICK)
    found = load_run(tmp_path / "run")
    assert np.array_equal(found.policy.dense(), run.policy.dense())
    assert found.columns == run.columns
    assert found.summary["policy"] == run.summary["policy"]
    assert np.array_equal(found.evaluation.value, run.evaluation.value)
    assert (found.evaluation.aihtr, found.evaluation.accuracy) == (
        run.evaluation.aihtr,
        run.evaluation.accuracy,
    )
    with pytest.raises(UserError, match="not the folder of a finished run"):
        load_run(tmp_path)


def test_a_run_in_a_folder_is_resumed_exactly(tmp_path: Path) -> None:
    class Stop(Callback):
        def on_update(self, trainer: Training, row: Row) -> None:
            if row["iteration"] == 5:
                raise RuntimeError("stopped")

    whole = train(
        small_world(), "ppo", folder=tmp_path / "whole", **QUICK, **{"checkpoint.every": 256}
    )
    words: dict[str, Any] = {**QUICK, "checkpoint.every": 256, "folder": tmp_path / "cut"}
    with pytest.raises(RuntimeError, match="stopped"):
        train(small_world(), "ppo", callbacks=[Stop()], **words)
    with pytest.raises(UserError, match="holds a run already"):
        train(small_world(), "ppo", **words)
    with pytest.raises(UserError, match="belongs to a run with another config or problem"):
        train(small_world(seed=1), "ppo", resume="auto", **words)
    run = train(small_world(), "ppo", resume="auto", **words)
    assert rows(tmp_path / "cut") == rows(tmp_path / "whole")
    assert np.array_equal(run.policy.dense(), whole.policy.dense())


def test_hooks_are_called_in_order(tmp_path: Path) -> None:
    heard = Heard()
    train(small_world(), "ppo", folder=tmp_path, callbacks=[heard], **QUICK | {"total_frames": 512})
    batch = "batch (32, 8)"
    first, last = [batch, "evaluation", "update 1"], [batch, "evaluation", "update 2", "checkpoint"]
    assert heard.calls == ["start", *first, *last, "end None"]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"hiden": 3}, "algo.hiden"),
        ({"hidden": "many"}, "algo.hidden=many: expected"),
        ({"collector": "singel"}, "collector=singel: expected one of"),
        ({"gamma": 2}, "algo.gamma=2: expected a number from 0 to 1"),
        ({"collector.workers": 2}, "collector.workers"),
        ({"optimal": False}, "optimal=False: expected optimal.enabled=value"),
        ({"resume": "auto"}, "resume=auto: expected folder=FOLDER beside it"),
        (
            {"task.memory": "displacement"},
            "task.memory: of the problem, expected where that is made",
        ),
        ({"cost": {"budget": 1}}, "cost: of the problem, expected where that is made"),
        ({"kernel": "drift"}, "kernel: of the problem, expected where that is made"),
        ({"targets.count": 2}, "targets.count: of the problem, expected where that is made"),
    ],
)
def test_a_wrong_option_is_refused_in_one_line(given: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError) as caught:
        train(small_world(), "ppo", **QUICK | given)
    assert str(caught.value).startswith(told)
    assert "\n" not in str(caught.value)


def test_recorded_tracks_are_learned_from() -> None:
    world = small_world(exit_probability=0.05)
    setting = recorded(drawn(world.kernel, 200), drawn(world.kernel, 40, seed=1))
    run = train(setting, "ppo", **QUICK)
    assert run.summary["held_out"]["tracks"] == 40
    assert np.isfinite(run.evaluation.aihtr)


def test_recorded_tracks_in_a_folder_are_resumed_and_evaluated(tmp_path: Path) -> None:
    world = small_world(exit_probability=0.05)
    setting = recorded(
        drawn(world.kernel, 120), drawn(world.kernel, 40, seed=1), markov=False, anywhere=True
    )
    whole = train(setting, "ppo", folder=tmp_path / "whole", **QUICK)

    class Stop(Callback):
        def on_checkpoint(self, trainer: Training, file: Path) -> None:
            raise RunError("stop")

    options = QUICK | {"checkpoint.every": 1}
    with pytest.raises(RunError, match="stop"):
        train(setting, "ppo", folder=tmp_path / "cut", callbacks=[Stop()], **options)
    # Typed, by somebody who has nothing but the folder.
    words = [f"hydra.run.dir={tmp_path / 'cut'}", "quiet=true"]
    assert main(["train", "resume=auto", *words]) == 0
    assert load_run(tmp_path / "cut").summary["policy"] == whole.summary["policy"]
    assert (
        main(
            ["evaluate", f"run={tmp_path / 'cut'}", "quiet=true", f"hydra.run.dir={tmp_path / 'e'}"]
        )
        == 0
    )
    other = recorded(drawn(world.kernel, 120, seed=5), markov=False, anywhere=True)
    with pytest.raises(UserError, match="belongs to a run with another config or problem"):
        train(
            other,
            "ppo",
            folder=tmp_path / "cut",
            resume="auto",
            **{**options, "collector.total_frames": 4096},
        )


def test_the_regret_is_the_same_on_a_busy_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the optimum stays open, the bound is that of a budget of work: bit for bit, however the clock runs."""
    kernel = drift(5, direction=0.0, persistence=0.5, exit_probability=0.01, border="renormalize")
    world = World(kernel, 5, cost=0.3, t_max=2)
    words = QUICK | {"optimal": {"enabled": True, "nodes": 20_000}}
    idle = train(world, "a2c", seed=0, **words)
    ticks = itertools.count()
    monkeypatch.setattr("time.monotonic", lambda: 3600.0 * next(ticks))
    busy = train(world, "a2c", seed=0, **words)
    assert busy.summary["regret_per_step"] == idle.summary["regret_per_step"]
    assert busy.summary["optimal"] == idle.summary["optimal"]
    assert not idle.summary["optimal"]["certified"]
    low, high = idle.summary["regret_per_step_lower"], idle.summary["regret_per_step"]
    assert 0.0 <= low < high
    assert idle.solution is not None
    length = idle.evaluation.expected_length
    assert low == pytest.approx((idle.solution.lower - idle.evaluation.aihtr) / length, abs=1e-12)


@pytest.mark.parametrize("solved", [True, False])
def test_an_evaluation_of_a_run_measures_against_what_the_run_proved(
    tmp_path: Path, solved: bool
) -> None:
    """The regret of `evaluate run=` is that of the run's summary; without a bracket there, to the clocked bound."""
    kernel = drift(5, direction=0.0, persistence=0.5, exit_probability=0.01, border="renormalize")
    np.save(tmp_path / "kernel.npy", kernel.toarray())
    words = "kernel=table grid.size=5 grid.t_max=2 cost.sensor=0.3 algo=ppo collector.total_frames=512 quiet=true"
    frames = ["collector.frames_per_batch=256", "collector.envs=32", "optimal.nodes=2000"]
    own = [
        f"kernel.path={tmp_path / 'kernel.npy'}",
        f"optimal.enabled={solved}",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    assert main(["train", *words.split(), *frames, *own]) == 0
    judge = [
        "evaluate",
        f"run={tmp_path / 'run'}",
        "episodes=0",
        "quiet=true",
        f"hydra.run.dir={tmp_path / 'judged'}",
    ]
    assert main(judge) == 0
    summary, found = (
        json.loads((tmp_path / name).read_text())
        for name in ("run/summary.json", "judged/evaluation.json")
    )
    for name in ("regret_per_step", "regret_per_step_lower"):
        assert found[name] == pytest.approx(summary[name], abs=1e-12)
    length = found["exact"]["expected_length"]
    clocked = (found["bounds"]["clocked"] - found["exact"]["aihtr"]) / length
    assert (found["regret_per_step"] < clocked - 1e-4) is solved
    if solved:
        # A bracket of another world would make the regret what it is not.
        (tmp_path / "run/config.yaml").write_text(
            (tmp_path / "run/config.yaml").read_text() + "# touched\n"
        )
        assert main(judge) != 0


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "run"
    with pytest.raises(UserError, match=f"folder={folder}: cannot be made"):
        train(small_world(), "a2c", folder=folder, **QUICK)


def test_a_run_has_its_threads_until_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last figures of several targets are those of a network, which waits long for threads nobody asked for."""
    seen = []

    def beside(*args: Any, **options: Any) -> None:
        seen.append(torch.get_num_threads())

    monkeypatch.setattr(run, "_several", beside)
    summary = train(small_world(), "a2c", threads=2, **QUICK | {"total_frames": 256}).summary
    assert [*seen, summary["machine"]["torch_threads"], torch.get_num_threads()] == [2, 2, 1]
