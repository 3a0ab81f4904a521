"""Going on with a run: what may differ, what is refused, what happens to a run that is done or damaged."""

from __future__ import annotations

import random
import re
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.helpers import later, train_config
from tests.training.runs import (
    BUDGET,
    QUICK,
    SMALL,
    assert_same_run,
    at_iteration,
    breaks,
    rows,
    train,
)
from tests.training.test_checkpoint import corrupted
from trackmdp.app.cli import main
from trackmdp.config import load_run_config, to_dict
from trackmdp.errors import RunError, UserError
from trackmdp.training import checkpoint
from trackmdp.training.state import find
from trackmdp.world.model import World
from trackmdp.world.problem_file import PROBLEM, problem_bytes, read_problem

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that broke down in its fifth iteration."""
    folder = tmp_path_factory.mktemp("state") / "half"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(RunError):
        at_iteration(patch, 5, breaks)
        train(folder, "checkpoint.keep=3")
    return folder


@pytest.fixture
def half(broken: Path, tmp_path: Path) -> Path:
    """The same run, to go on with."""
    shutil.copytree(broken, tmp_path / "half", symlinks=True)
    return tmp_path / "half"


def typed(folder: Path, *words: str) -> int:
    return main(
        [
            "train",
            *SMALL["ppo"],
            *QUICK,
            *BUDGET,
            "checkpoint.keep=3",
            f"hydra.run.dir={folder}",
            *words,
        ]
    )


def files(folder: Path) -> dict[str, bytes]:
    return {str(file): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_sixty_corruptions_are_passed_over_for_the_one_before(whole: Path, tmp_path: Path) -> None:
    train(tmp_path / "other", "seed=5", "collector.total_frames=256")
    foreign = checkpoint.newest(tmp_path / "other").read_bytes()
    cfg = train_config(*SMALL["ppo"], *QUICK, *BUDGET, "checkpoint.keep=3", "resume=auto")
    problem = read_problem(whole / PROBLEM)
    newest, rng = checkpoint.newest(whole), random.Random(3)
    content = newest.read_bytes()
    try:
        for trial in range(60):
            newest.write_bytes(foreign if trial % 20 == 0 else corrupted(content, foreign, rng))
            state, passed_over = find(cfg, problem, whole, CPU)
            assert state is not None
            assert state["iteration"] == 7, trial
            assert [line.split(":")[0] for line in passed_over] == [str(newest)]
    finally:
        newest.write_bytes(content)
    assert find(cfg, problem, whole, CPU)[1] == []


def test_auto_goes_on_from_the_one_before_and_says_so(
    half: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    newest = checkpoint.newest(half)
    newest.write_bytes(newest.read_bytes()[:-1000])
    assert typed(half, "resume=auto", "quiet=false") == 0
    out = capsys.readouterr().out
    assert f"passed over: {newest}: damaged" in out
    assert "resumes after iteration 3, 768 frames" in out
    assert_same_run(half, whole)


def test_a_checkpoint_that_is_named_is_taken_or_refused(
    half: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = half / "checkpoints" / "iteration-00000003.pt"
    content = chosen.read_bytes()
    chosen.write_bytes(content[:-1])
    assert typed(half, f"resume={chosen}") == 2
    assert re.fullmatch(
        f"trackmdp train: resume={chosen}: no checkpoint .*damaged.*\n", capsys.readouterr().err
    )
    chosen.write_bytes(content)
    assert typed(half, f"resume={chosen}") == 0
    assert_same_run(half, whole)


def test_checkpoints_of_another_run_behind_a_link_stay(tmp_path: Path) -> None:
    folder, theirs = tmp_path / "run", tmp_path / "theirs"
    for each in (folder, theirs):
        each.mkdir()
    file = theirs / "iteration-00000009.pt"
    file.write_bytes(b"theirs")
    (folder / "checkpoints").symlink_to(theirs)
    with pytest.raises(UserError, match="a link or a file"):
        train(folder)
    assert list(theirs.iterdir()) == [file]


def test_no_run_starts_anew_where_every_checkpoint_is_damaged(
    half: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in checkpoint.available_checkpoints(half / "checkpoints"):
        file.write_bytes(b"")
    before = files(half)
    assert typed(half, "resume=auto") == 2
    assert capsys.readouterr().err.count("damaged, or not a checkpoint") == 3
    assert files(half) == before


def test_a_finished_run_that_cannot_go_on_keeps_its_summary(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(whole, tmp_path / "finished")
    for file in checkpoint.available_checkpoints(folder / "checkpoints"):
        file.write_bytes(b"")
    before = files(folder)
    assert typed(folder, "resume=auto", "collector.total_frames=4096") == 2
    assert "no checkpoint to resume from" in capsys.readouterr().err
    assert files(folder) == before


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("algo.clip_epsilon=0.25", "algo.clip_epsilon: the run has 0.2, typed was 0.25"),
        ("seed=1", "seed: the run has 0, typed was 1"),
        ("algo=a2c", "algo: the run has ppo, typed was a2c"),
        ("algo=ppo_per_sensor", "algo: the run has ppo, typed was ppo_per_sensor"),
        ("collector.envs=64", "collector.envs: the run has 32, typed was 64"),
        ("grid.max_steps=9", "grid.max_steps: the run has null, typed was 9"),
    ],
)
def test_another_option_is_refused(
    word: str, told: str, half: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(half)
    assert typed(half, "resume=auto", word) == 2
    assert capsys.readouterr().err == f"trackmdp train: {told}; it cannot change on resume\n"
    assert files(half) == before


def test_a_change_is_checked_with_the_options_of_the_run(
    half: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By default there are 10,000 frames in a batch."""

    def frames(folder: Path, number: int) -> int:
        words = ["resume=auto", "quiet=true", f"collector.total_frames={number}"]
        return main(["train", f"hydra.run.dir={folder}", *words])

    for folder, batch in ((half, 256), (tmp_path / "new", 10_000)):
        assert frames(folder, 99) == 2
        assert f"frames_per_batch={batch}" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert frames(half, 2560) == 0
    assert len(rows(half)) == 10


def test_a_change_without_effect_is_refused(half: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = files(half)
    assert typed(half, "resume=auto", "partition.workers=2") == 2
    assert "partition.workers=2: without effect" in capsys.readouterr().err
    assert files(half) == before


def test_budget_logging_and_saving_may_change(half: Path) -> None:
    words = [
        "collector.total_frames=2560",
        "checkpoint.every=512",
        "evaluation.every=2",
        "log.csv.every=2",
    ]
    assert typed(half, "resume=auto", *words) == 0
    assert [int(row["iteration"]) for row in rows(half)] == [1, 2, 3, 4, 6, 8, 10]
    saved = load_run_config(half)
    assert (saved.collector.total_frames, saved.checkpoint.every, saved.seed) == (2560, 512, 0)
    assert to_dict(saved)["log"] == {"csv": {"every": 2}}


def test_a_config_edited_by_hand_is_not_the_run(
    half: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = half / "config.yaml"
    config.write_text(config.read_text().replace("gae_lambda: 0.5", "gae_lambda: 0.6"))
    assert main(["train", "resume=auto", f"hydra.run.dir={half}"]) == 2
    assert "belongs to a run with another config" in capsys.readouterr().err


def forged(run: Path, **changes: Any) -> None:
    """The newest checkpoint of a run, saved again with parts changed."""
    state = {**checkpoint.load(checkpoint.newest(run)), **changes}
    iteration = state.pop("iteration")
    checkpoint.save(run / "checkpoints", iteration, state, keep=3)


def test_sparse_weights_are_refused_in_one_line(half: Path, capfd: Any) -> None:
    """In lines of torch's before ours."""
    algorithm = checkpoint.load(checkpoint.newest(half))["algorithm"]
    policy = {
        name: tensor.to_sparse() if tensor.ndim == 2 else tensor
        for name, tensor in algorithm["policy"].items()
    }
    forged(half, algorithm={**algorithm, "policy": policy})
    capfd.readouterr()
    assert main(["evaluate", f"run={half}", "episodes=0", "quiet=true"]) == 2
    assert len(capfd.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    "package", ["torch", "trackmdp", *later(["torchrl", "tensordict", "numpy", "scipy"])]
)
def test_another_version_is_refused(
    package: str, half: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of them draw or add up what a run learns from."""
    cfg = train_config(*SMALL["ppo"], *QUICK, *BUDGET, "checkpoint.keep=3", "resume=auto")
    monkeypatch.setattr(
        "trackmdp.training.state.version",
        lambda name: "0.0" if name == package else metadata.version(name),
    )
    with pytest.raises(
        UserError, match=rf"written with {package} [\d.]+\S*, this is 0.0; expected the same"
    ):
        find(cfg, read_problem(half / PROBLEM), half, CPU)


def test_a_run_goes_on_with_its_own_kernel_whatever_became_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kernel, world = (
        tmp_path / "kernel.npy",
        ("kernel=table", f"kernel.path={tmp_path / 'kernel.npy'}"),
    )
    np.save(kernel, np.full((9, 9), 0.1))
    train(tmp_path / "whole", *world)
    with monkeypatch.context() as patch:
        at_iteration(patch, 5, lambda: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        with pytest.raises(RunError):
            train(tmp_path / "run", *world)
    kernel.unlink()
    shutil.copytree(tmp_path / "run", tmp_path / "swapped")
    assert main(["train", "resume=auto", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert_same_run(tmp_path / "run", tmp_path / "whole")
    other = World(np.full((9, 9), 0.05), 3, cost=0.2, t_max=1)
    (tmp_path / "swapped" / PROBLEM).write_bytes(problem_bytes(other))
    capsys.readouterr()
    assert main(["train", "resume=auto", f"hydra.run.dir={tmp_path / 'swapped'}"]) == 2
    assert "belongs to a run with another config or problem" in capsys.readouterr().err


@pytest.mark.parametrize("algo", ["hindsight", *later(["model_based"])])
def test_a_map_of_classes_is_kept_and_no_other_one_taken(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    classes, file = np.array([0, 0, 0, 0, 0, 0, 1, 1, 1]), tmp_path / "map.npy"
    np.save(file, classes)
    words = [
        f"algo.share_cells={file}",
        *(SMALL["hindsight"] if algo == "hindsight" else [f"algo={algo}"]),
    ]
    command = ["train", *words, *QUICK, *BUDGET]
    assert main([*command, f"hydra.run.dir={tmp_path / 'whole'}"]) == 0
    with monkeypatch.context() as patch:
        at_iteration(patch, 5, breaks)
        assert main([*command, f"hydra.run.dir={tmp_path / 'run'}"]) == 1
    shutil.copytree(tmp_path / "run", tmp_path / "moved")
    file.unlink()
    for folder in ("run", "moved"):
        assert main([*command, "resume=auto", f"hydra.run.dir={tmp_path / folder}"]) == 0
        assert_same_run(tmp_path / folder, tmp_path / "whole")
        written = [(tmp_path / name / "policy.npz").read_bytes() for name in (folder, "whole")]
        assert written[0] == written[1]
        np.save(file, np.zeros(9))  # the second time there is another map
    kept = tmp_path / "run" / PROBLEM
    kept.write_bytes(problem_bytes(read_problem(kept), 1 - classes))
    capsys.readouterr()
    assert main(["evaluate", f"run={kept.parent}"]) == 2
    assert "belongs to a run with another config or problem" in capsys.readouterr().err


def test_events_after_the_checkpoint_are_hidden_and_each_iteration_has_a_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Iterations 9 to 12 are after the last frame."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    words = ("log=[csv,tensorboard]", "checkpoint.every=512")
    with monkeypatch.context() as patch:
        at_iteration(patch, 11, lambda: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        with pytest.raises(RunError):
            train(tmp_path, *words, algo="hindsight")
    train(tmp_path, *words, "resume=auto", algo="hindsight")
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.step for event in events.Scalars("iteration")] == list(range(1, 13))


def test_a_finished_run_ends_at_once_and_stays_as_it_is(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(whole)
    assert typed(whole, "resume=auto", "quiet=false") == 0
    assert "finished before" in capsys.readouterr().out
    assert files(whole) == before


def test_a_folder_with_a_run_is_refused_without_resume(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(whole)
    assert typed(whole) == 2
    assert "holds a run already; resume it by resume=auto" in capsys.readouterr().err
    assert files(whole) == before
