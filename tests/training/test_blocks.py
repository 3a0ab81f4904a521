"""Learning by blocks: what each block learns, what is put together of it, and runs that were cut."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import later
from trackmdp.app.cli import main
from trackmdp.errors import Preempted, UserError
from trackmdp.sensing.coverage import discs
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.callbacks import Callback
from trackmdp.training.lock import locked
from trackmdp.training.state import Checkpoints
from trackmdp.world.model import World

SMALL: dict[str, Any] = {
    "optimal.enabled": False,
    "algo.plan_every": 100,
    "evaluation.every": 100,
    "collector.envs": 50,
    "collector.frames_per_batch": 300,
    "collector.total_frames": 6000,
    "checkpoint.every": 600,
    "partition.block": 5,
    "partition.halo": 1,
}


def world(**options: Any) -> World:
    given = {
        "size": 8,
        "support_size": 3,
        "radius": 1,
        "cost": 0.16,
        "t_max": 1,
        "safe_cost": 8.0,
        "window": 2,
    }
    return tm.make_world("random_support", **given | options)


def learned(folder: Path | None = None, algo: str = "model_based", **options: Any) -> tm.Run:
    return tm.train(world(), algo, folder=folder, **SMALL | options)


@pytest.fixture(scope="module")
def uncut(tmp_path_factory: pytest.TempPathFactory) -> tm.Run:
    return learned(tmp_path_factory.mktemp("uncut"))


def policies(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("policy.npz"))
    }


def test_blocks_without_a_sensor_have_nothing_to_learn(tmp_path: Path) -> None:
    cost = np.full((8, 8), np.nan)
    cost[:, 6:] = 0.16
    run = tm.train(
        world(cost=cost),
        "model_based",
        folder=tmp_path,
        **SMALL | {"collector.total_frames": 600, "algo.rounds": 1},
    )
    assert run.evaluation.aihtr == pytest.approx(evaluate(world(cost=cost), run.policy).aihtr)
    assert len(list((tmp_path / "blocks").iterdir())) == 2  # of four


@pytest.mark.slow
def test_blocks_learn_with_footprints_and_a_budget() -> None:
    places = np.stack(np.divmod(np.arange(0, 64, 2), 8), axis=1)
    wide = world(window=None).but(
        coverage=discs((8, 8), places, 1), cost=0.3, safe_cost=8.0, budget=1
    )
    run = tm.train(wide, "model_based", **SMALL | {"collector.total_frames": 3000})
    assert run.evaluation.aihtr == evaluate(wide, run.policy).aihtr
    assert 0 < evaluate(wide, run.policy).sensors_per_step <= 1


@pytest.mark.slow
def test_blocks_learn_what_the_whole_grid_would(tmp_path: Path) -> None:
    wide = {"collector.total_frames": 60_000, "partition.block": 4, "partition.halo": None}
    run = learned(tmp_path, **wide)
    # of the whole grid, not the mean of the blocks
    assert run.evaluation.aihtr == pytest.approx(evaluate(world(), run.policy).aihtr, abs=1e-9)
    assert run.summary["regret_per_step"] < 0.02
    assert run.summary["bounds"]["clocked"] == pytest.approx(tm.solve(world()).upper)
    narrow = learned(**wide | {"partition.halo": 0})
    assert narrow.summary["regret_per_step"] > run.summary["regret_per_step"] + 0.05


def test_frames_are_shared_out_by_what_blocks_see(uncut: tm.Run) -> None:
    assert uncut.folder is not None
    places = [uncut.folder / "blocks" / f"{number:05d}" for number in range(4)]
    # of 8 x 8 cells with side 5 and halo 1: 6 x 6, 6 x 4, 4 x 6 and 4 x 4 cells, 100 in all
    assert [tuple(np.load(place / "problem.npz")["kernel.shape"]) for place in places] == [
        (n, n) for n in (36, 24, 24, 16)
    ]
    ends = [json.loads((place / "summary.json").read_text()) for place in places]
    assert [end["frames"] for end in ends] == [
        2400,
        1500,
        1500,
        1200,
    ]  # 2160, 1440, 1440 and 960, in whole batches
    assert uncut.summary["frames"] == 6600
    earned = uncut.summary["while_collecting"]["reward_per_frame"]
    assert earned == pytest.approx(
        sum(end["frames"] * end["while_collecting"]["reward_per_frame"] for end in ends) / 6600
    )
    assert len({end["seed"] for end in ends}) == 4


def test_a_cut_run_ends_as_if_it_had_not_been(
    uncut: tm.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save, saved = Checkpoints.save, []

    def noted(self: Checkpoints, trainer: Any) -> None:
        save(self, trainer)
        saved.append((trainer.folder.name, trainer.position.frames))
        if saved == [("00000", 600 * n) for n in (1, 2, 3, 4)] + [("00001", 600)]:
            raise KeyboardInterrupt

    monkeypatch.setattr(Checkpoints, "save", noted)
    with pytest.raises(KeyboardInterrupt):
        learned(tmp_path / "begun")
    assert list(policies(tmp_path / "begun")) == ["blocks/00000/policy.npz"]
    folder = (tmp_path / "begun").rename(tmp_path / "moved")
    done = (folder / "blocks" / "00000" / "summary.json").stat().st_mtime_ns
    saved.clear()
    monkeypatch.chdir(tmp_path)
    learned(Path("moved"), resume="auto")
    # what was finished is not learned again, and what was cut goes on from its checkpoint, wherever the run lies
    assert done == (folder / "blocks" / "00000" / "summary.json").stat().st_mtime_ns
    assert saved[:2] == [("00001", 1200), ("00001", 1500)]
    assert {name for name, _ in saved} == {"00001", "00002", "00003"}
    assert uncut.folder is not None
    assert policies(folder) == policies(uncut.folder)
    assert len(policies(folder)) == 5
    copied = Path(shutil.copytree(folder, tmp_path / "copied"))
    shutil.rmtree(folder)
    block = tm.load_run(copied / "blocks" / "00001")
    words = [
        "evaluate",
        f"run={block.folder}",
        "episodes=0",
        f"hydra.run.dir={tmp_path / 'figures'}",
    ]
    assert main(words) == 0
    figures = json.loads((tmp_path / "figures" / "evaluation.json").read_text())
    assert figures["exact"]["aihtr"] == block.evaluation.aihtr


def test_blocks_have_their_part_of_a_map(tmp_path: Path) -> None:
    classes = np.arange(64).reshape(8, 8) // 16
    np.save(tmp_path / "map.npy", classes)
    given = {"algo.share_cells": tmp_path / "map.npy", "collector.total_frames": 600}
    learned(tmp_path / "run", **given)
    kept = [
        np.load(tmp_path / "run" / "blocks" / f"{number:05d}" / "problem.npz")["classes"]
        for number in range(4)
    ]
    assert (kept[1] == classes[:6, 4:].ravel()).all()
    assert (kept[2] == classes[4:, :6].ravel()).all()
    (tmp_path / "map.npy").unlink()
    shutil.rmtree(tmp_path / "run" / "blocks" / "00002")
    learned(tmp_path / "run", resume="auto", **given)
    again = np.load(tmp_path / "run" / "blocks" / "00002" / "problem.npz")["classes"]
    assert (again == classes[4:, :6].ravel()).all()


@pytest.mark.parametrize("name", ["blocks", "blocks/00000"])
def test_blocks_are_not_written_through_a_link(tmp_path: Path, name: str) -> None:
    outside, link = tmp_path / "outside", tmp_path / "run" / name
    outside.mkdir()
    link.parent.mkdir(parents=True)
    link.symlink_to(outside)
    with pytest.raises(
        UserError, match=f"{name}: a link or a file, expected a folder of the run's own"
    ):
        learned(tmp_path / "run")
    assert not list(outside.iterdir())


def test_another_config_leaves_a_run_as_it_was(uncut: tm.Run) -> None:
    assert uncut.folder is not None
    before = {file: file.read_bytes() for file in uncut.folder.rglob("*") if file.is_file()}
    with pytest.raises(UserError, match="holds a run with another config"):
        learned(uncut.folder, resume="auto", seed=1)
    assert before == {file: file.read_bytes() for file in uncut.folder.rglob("*") if file.is_file()}


def test_a_block_that_runs_elsewhere_is_refused(tmp_path: Path) -> None:
    (tmp_path / "blocks" / "00000").mkdir(parents=True)
    with (
        locked(tmp_path / "blocks" / "00000"),
        pytest.raises(UserError, match="00000: another process is running"),
    ):
        learned(tmp_path)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_signal_between_two_blocks_ends_the_run(
    number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = signal.getsignal(number)
    monkeypatch.setattr(
        "trackmdp.training.blocks.finished", lambda cfg, folder: signal.raise_signal(number)
    )
    with pytest.raises(Preempted, match=f"stopped by signal {int(number)}"):
        learned(tmp_path)
    assert signal.getsignal(number) == before


def test_a_signal_in_the_last_iteration_of_a_block_begins_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ends(self: Checkpoints, trainer: Any) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Checkpoints, "on_end", ends)
    with pytest.raises(Preempted, match="stopped by signal 15"):
        learned(tmp_path)
    assert [each.name for each in (tmp_path / "blocks").iterdir()] == ["00000"]


@pytest.mark.parametrize("cluster", later([None, "local"]))
def test_the_result_does_not_depend_on_the_workers(
    uncut: tm.Run, tmp_path: Path, cluster: str | None
) -> None:
    if cluster:
        pytest.importorskip("ray")
    learned(tmp_path, **{"partition.workers": 2, "partition.cluster": cluster})
    assert uncut.folder is not None
    assert policies(tmp_path) == policies(uncut.folder)


@pytest.mark.parametrize(
    ("algo", "words"),
    later(
        [
            ("hindsight", {"updates": 20, "hidden": 8}),
            ("a2c", {"envs": 50}),
            ("ppo", {"minibatches": 5}),
            ("dqn_per_sensor", {"updates": 20, "hidden": 8}),
        ]
    ),
)
def test_every_learner_learns_by_blocks(algo: str, words: dict[str, Any]) -> None:
    options = {name: value for name, value in SMALL.items() if "plan" not in name} | words
    kept = [tm.train(world(), algo, **options).evaluation.value for _ in range(2)]
    assert np.array_equal(*kept)
    assert kept[0].mean() > evaluate(world(), tm.Policy.none(world())).aihtr


def test_blocks_learn_plans_of_keys() -> None:
    keyed = world(memory="displacement")
    run = tm.train(keyed, **SMALL)
    assert run.policy.task.num_keys == keyed.num_keys
    assert run.evaluation.aihtr > tm.solve(keyed, "qmdp").lower


@pytest.mark.parametrize("options", [{"reveals": True}, *later([{"memory": "displacement"}])])
def test_blocks_learn_against_targets_with_modes(options: dict[str, Any], tmp_path: Path) -> None:
    moving = tm.make_world(
        "heading", size=6, window=2, safe_cost=5.0, exit_probability=0.05, **options
    )
    run = tm.train(moving, folder=tmp_path / "run", **SMALL | {"partition.block": 3})
    assert run.policy.task.num_keys == moving.num_keys
    assert run.evaluation.aihtr > tm.solve(moving, "qmdp").lower
    again = tm.load_run(tmp_path / "run")
    assert tm.evaluate(moving, again.policy).aihtr == run.evaluation.aihtr


@pytest.mark.slow
def test_a_run_by_blocks_is_evaluated_and_exported(
    uncut: tm.Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", f"run={uncut.folder}", "episodes=0", f"hydra.run.dir={tmp_path}"]) == 0
    assert (
        json.loads((tmp_path / "evaluation.json").read_text())["exact"]["aihtr"]
        == uncut.evaluation.aihtr
    )
    words = ["export", f"run={uncut.folder}", "format=sets", f"hydra.run.dir={tmp_path}"]
    assert main(words) == 0
    assert json.loads((tmp_path / "sets.json").read_text()) == uncut.policy.as_lists()
    capsys.readouterr()
    assert main([*words, "checkpoint=best"]) == 2
    assert "checkpoint=best: expected newest for run=" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"log": ["mcap"]}, r"log=.*mcap"),
        ({"init_from": "elsewhere"}, "init_from=.*: expected null with partition.block"),
        ({"callbacks": [Callback()]}, "callbacks: expected none"),
        (
            {"partition.block": None, "partition.halo": 1},
            "partition.halo=1: without effect without partition.block",
        ),
        ({"partition.sweeps": 1}, "partition.sweeps: unknown option"),
    ],
)
def test_what_does_not_go_together_with_blocks_is_refused(words: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        learned(**words)


def test_recordings_are_not_cut_to_blocks(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["kernel=tracks", "kernel.path=tests/data/city.csv", "partition.block=4"]
    assert main(["train", *words]) == 2
    assert "partition.block=4: expected null with kernel=tracks" in capsys.readouterr().err
