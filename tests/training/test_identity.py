"""Where a run is cut changes nothing, best.pt included; and what another run left is not taken for its own."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.collectors import Collector

from tests.helpers import later, small_world
from tests.training.runs import assert_same_run, at_iteration, breaks, tensors, train
from trackmdp.algos.moves import MoveBuffer
from trackmdp.errors import Preempted, RunError, UserError
from trackmdp.training import checkpoint, state
from trackmdp.training.run import trained
from trackmdp.world.problem_file import PROBLEM, problem_bytes

CPU = torch.device("cpu")


def assert_same_best(one: Path, other: Path) -> None:
    """The same policy is called the best, for the same figure."""
    for name in (checkpoint.BEST, checkpoint.LAST):
        mine, theirs = (checkpoint.load(run / "checkpoints" / name) for run in (one, other))
        assert mine["iteration"] == theirs["iteration"]
        assert mine["callbacks"]["checkpoints"] == theirs["callbacks"]["checkpoints"]
        kept, found = tensors(mine), tensors(theirs)
        assert all(
            torch.equal(kept[k], found[k]) for k in kept if isinstance(kept[k], torch.Tensor)
        )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing happened to: saved after each iteration, evaluated after every fourth."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    train(folder)
    return folder


@pytest.mark.parametrize("cuts", [(3, 5), pytest.param((8,), marks=pytest.mark.slow)])
def test_the_best_does_not_depend_on_where_a_run_was_cut(
    cuts: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path
) -> None:
    for cut in cuts:
        with monkeypatch.context() as patch:
            at_iteration(patch, cut, breaks)
            with pytest.raises(RunError):
                train(tmp_path, "resume=auto")
    train(tmp_path, "resume=auto")
    assert_same_run(tmp_path, whole)
    assert_same_best(tmp_path, whole)


def test_a_checkpoint_that_a_signal_asked_for_is_not_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Saved at iterations 3, 6 and 8 of 8; the run that is stopped after 2, 3 and 7 of them, at these as well."""
    words = ("checkpoint.every=768", "evaluation.every=1")
    train(tmp_path / "whole", *words)
    for stop in (2, 3, 7):
        with monkeypatch.context() as patch, pytest.raises(Preempted):
            at_iteration(patch, stop, lambda: signal.raise_signal(signal.SIGTERM))
            train(tmp_path / "cut", *words, "resume=auto")
    train(tmp_path / "cut", *words, "resume=auto")
    assert_same_best(tmp_path / "cut", tmp_path / "whole")


def test_the_best_is_the_policy_that_it_was_called_the_best_for(whole: Path) -> None:
    figures = [
        checkpoint.load(file)["callbacks"]["checkpoints"]
        for file in (
            whole / "checkpoints" / checkpoint.BEST,
            whole / "checkpoints" / checkpoint.LAST,
        )
    ]
    assert figures[0]["is_best"]
    assert figures[0]["best"] == figures[1]["best"]


@pytest.mark.parametrize("name", [checkpoint.BEST, *later([checkpoint.LAST])])
def test_a_run_cut_between_a_checkpoint_and_its_names_is_the_same(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path
) -> None:
    best = checkpoint.load(whole / "checkpoints" / checkpoint.BEST)["iteration"]
    named = checkpoint.second_name

    def broken(file: Path, other: Path) -> None:
        if (file.name, other.name) == (f"iteration-{best:08d}.pt", name):
            breaks()
        named(file, other)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "second_name", broken)
        with pytest.raises(RunError):
            train(tmp_path)
    train(tmp_path, "resume=auto")
    assert_same_run(tmp_path, whole)
    assert_same_best(tmp_path, whole)


def test_a_signal_that_ends_the_workers_while_weights_are_sent_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path
) -> None:
    send, calls = Collector.update_policy_weights_, iter(range(9))

    def ended(self: Collector, *args: Any) -> None:
        if next(calls) == 2:
            signal.raise_signal(signal.SIGTERM)
            raise RuntimeError("worker 0 was killed by SIGTERM")
        send(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(Collector, "update_policy_weights_", ended)
        with pytest.raises(Preempted) as told:
            train(tmp_path, "checkpoint.every=0")
    assert told.value.signal == signal.SIGTERM
    assert [file.name for file in checkpoint.available_checkpoints(tmp_path / "checkpoints")] == [
        "iteration-00000003.pt"
    ]
    train(tmp_path, "resume=auto")
    assert_same_run(tmp_path, whole)


def one_file(name: str) -> Callable[[Path, Path], Any]:
    return lambda mine, theirs: shutil.copy(theirs / name, mine / name)


def newer(mine: Path, theirs: Path) -> None:
    shutil.copy(checkpoint.newest(theirs), mine / "checkpoints/iteration-00000099.pt")


SWAPS: dict[str, tuple[Callable[[Path, Path], Any], bool]] = {
    "newest": (newer, False),
    "best": (one_file("checkpoints/best.pt"), True),
    "config": (one_file("config.yaml"), False),
    "kernel": (
        lambda mine, theirs: (mine / PROBLEM).write_bytes(problem_bytes(small_world(seed=1))),
        False,
    ),
    "kernel, cut": (lambda mine, theirs: (mine / PROBLEM).write_bytes(b"PK"), False),
    "no kernel": (lambda mine, theirs: (mine / PROBLEM).unlink(), True),
}


@pytest.mark.parametrize("case", SWAPS)
def test_what_another_run_left_is_not_taken(
    case: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, whole: Path
) -> None:
    swap, best = SWAPS[case]
    mine = tmp_path / "mine"
    shutil.copytree(whole, mine)
    trained(str(mine), CPU, best=best)
    other = tmp_path_factory.getbasetemp() / "other"
    if not other.exists():
        train(other, "cost.sensor=0.4")
    swap(mine, other)
    with pytest.raises(UserError) as refused:
        trained(str(mine), CPU, best=best)
    assert str(mine) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "damage",
    [
        {"position": {"iteration": -1}},
        {"position": {"iteration": 8, "frames": 10**30, "seconds": 0.0, "reward": 0.0}},
        {"versions": [1]},
        {"versions": {"nope": "1"}},
        {"algorithm": [1]},
        {"algorithm": {}},
        {"collector": {"environment": {"rows": {}, "generators": {}}}},
        {"random": {}},
        {"callbacks": {"csv": {"position": 10**15, "columns": []}}},
        lambda saved: {
            "callbacks": saved["callbacks"]
            | {"csv": saved["callbacks"]["csv"] | {"position": 10**4}}  # beyond its end
        },
        {"callbacks": [1]},
        {"position": {"iteration": 8, "frames": 2000, "steps": 3}},
        {"callbacks": {"checkpoints": {"best": "x"}}},
    ],
)
def test_a_sealed_state_that_makes_no_sense_is_refused_in_one_line(
    damage: dict[str, Any] | Callable[[Any], dict[str, Any]], tmp_path: Path, whole: Path
) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(whole, mine)
    saved = checkpoint.load(checkpoint.newest(mine))
    shutil.rmtree(mine / "checkpoints")
    changed = damage(saved) if callable(damage) else damage
    checkpoint.save(mine / "checkpoints", 8, {**saved, **changed}, keep=1)
    (mine / "summary.json").unlink()
    before = (mine / "metrics.csv").read_bytes()
    with pytest.raises(UserError) as refused:
        train(mine, "resume=auto")
    assert "\n" not in str(refused.value)
    assert (mine / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize(
    "damage",
    [
        *(b"", b"x" * 9999, b"\0" * 9999, b"a\n" * 5000, b"aa\n" * 5000),
        lambda whole: whole.replace(b"\n", b","),
        lambda whole: whole.replace(b"seconds", b"secondz"),
    ],
    ids=["empty", "letters", "zeros", "one column", "another column", "half a row", "a name"],
)
def test_metrics_of_rubbish_stop_a_resume_before_anything_is_written(
    damage: bytes | Callable[[bytes], bytes], tmp_path: Path, whole: Path
) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(whole, mine)
    (mine / "summary.json").unlink()
    metrics = mine / "metrics.csv"
    content = damage(metrics.read_bytes()) if callable(damage) else damage
    metrics.write_bytes(content)
    with pytest.raises(UserError, match=r"metrics\.csv: "):
        train(mine, "resume=auto")
    assert (mine / "metrics.csv").read_bytes() == content


@pytest.mark.parametrize("package", ["hydra-core", "numpy"])
def test_another_version_of_a_package_that_composes_or_computes_is_refused(
    package: str, tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "mine"
    shutil.copytree(whole, mine)
    (mine / "summary.json").unlink()
    found = state.version
    monkeypatch.setattr(state, "version", lambda name: "0.1" if name == package else found(name))
    with pytest.raises(
        UserError, match=rf"written with {package} \d[^ ]*, this is 0.1; expected the same"
    ):
        train(mine, "resume=auto")


def test_a_batch_is_whoever_s_it_was_given_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Learners may keep parts of a batch: the collector must not write the next one over it."""
    kept: list[tuple[torch.Tensor, torch.Tensor]] = []
    step = MoveBuffer.extend

    def extend(self: MoveBuffer, batch: Any) -> None:
        kept.append((batch["last_cell"], batch["last_cell"].clone()))
        step(self, batch)

    monkeypatch.setattr(MoveBuffer, "extend", extend)
    train(tmp_path / "run", algo="hindsight")
    assert len(kept) == 8
    assert all(torch.equal(now, then) for now, then in kept)
