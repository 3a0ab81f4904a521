"""Model-based learning: what it reads, estimates, plans and reports, with pooled moves and on whole paths."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse

import trackmdp as tm
from tests.algos.estimates.test_path_counts import SWEEP
from tests.helpers import algorithm, collect, headings, hop_world, later, small_world, train_config
from tests.tracks import by_hand, recorded, write
from tests.typed import refused
from trackmdp.algos import model_based
from trackmdp.algos.estimates import path_plans
from trackmdp.algos.estimates.hidden_modes import Fit, fit_modes
from trackmdp.algos.estimates.shrinkage import without
from trackmdp.algos.model_based import ModelBased
from trackmdp.algos.observed import observed_paths
from trackmdp.app.cli import main
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded
from trackmdp.seeding import derive
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.solvers.value import replay
from trackmdp.training.run import load_run
from trackmdp.world.model import World

CPU = torch.device("cpu")
TRACKS = ("kernel=tracks", "kernel.path=t.csv", "task.memory=displacement", "task.clip=1")


def learn(
    world: World, batches: int, *overrides: str, envs: int = 256
) -> tuple[ModelBased, list[dict[str, float]]]:
    learner = algorithm("model_based", world, *overrides)
    learner.iterations = batches
    return learner, [
        learner.step(collect(world, learner.policy, envs, 20, seed=batch))
        for batch in range(batches)
    ]


def on_tracks(task: Recorded, iterations: int = 2, prior: str = "0") -> ModelBased:
    cfg = train_config(*TRACKS, "algo=model_based", f"algo.prior={prior}").algo
    return ModelBased(task.task, cfg, iterations=iterations, seed=0, device=CPU)  # type: ignore[arg-type]


def swept(count: int = 20, lengths: tuple[int, ...] = (13,), **more: object) -> Recorded:
    tracks = [[SWEEP[number % 6] for number in range(length)] for length in lengths * count]
    return recorded(by_hand(*tracks, exits=True), markov=False, **more)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_paths_are_read_from_observations() -> None:
    """Nothing is sensed: the target hops on unseen, is located by the safe action, or exits."""
    world = hop_world(t_max=1)
    batch = collect(world, Policy.none(world), 64, 30)
    paths = observed_paths(batch, world)
    located = paths.end < 4
    assert set(paths.misses[located].tolist()) == {2}
    np.testing.assert_array_equal(paths.end[located], (paths.start[located] + 3) % 4)
    assert set(paths.misses[~located].tolist()) == {0, 1, 2}
    assert not paths.sensed.nnz


@pytest.mark.parametrize("sensing", ["all", "chosen"])
def test_it_finds_the_optimum_of_a_small_world(sensing: str) -> None:
    world = small_world(3)
    warm_up = ["algo.warm_up=5000"] if sensing == "chosen" else []
    learner, _ = learn(world, 8, f"algo.sensing={sensing}", *warm_up)
    best = optimal.solve(world)
    assert evaluate(world, learner.actor).aihtr == pytest.approx(best.lower, abs=0.01)


@pytest.mark.parametrize(
    "more",
    [
        {"detection": 0.8, "safe_detection": 0.6},
        {"cost": np.where(np.arange(9) == 4, np.nan, 0.1)},
        {"window": 1, "detection": 0.9},
        {"coverage": np.eye(9)[::2] + np.eye(9, k=1)[::2], "cost": 0.2, "detection": 0.8},
        {"memory": "displacement"},
        {"max_steps": 12},
    ],
)
def test_it_comes_near_the_optimum_with_every_kind_of_sensing(more: dict[str, object]) -> None:
    world = small_world(3, exit_probability=0.05).but(**{"safe_cost": 0.9} | more)
    learner, _ = learn(world, 4)
    known = optimal.solve(world.but(max_steps=None, memory="cell")).table
    best, found = (evaluate(world.but(memory="cell"), known), evaluate(world, learner.actor))
    assert regret_per_step(best.aihtr, found) < 0.02


@pytest.mark.usefixtures("little_search")
@pytest.mark.parametrize("detection", [1.0, pytest.param(0.8, marks=pytest.mark.slow)])
def test_a_hidden_mode_is_learned_by_paths(detection: float) -> None:
    """Better than any plan of pooled moves, also where some cells of the paths are unknown."""
    world = headings(memory="displacement").but(detection=detection)
    paths, rows = learn(world, 2)
    moves, _ = learn(world, 2, "algo.estimate=moves")
    assert evaluate(world, paths.actor).aihtr > evaluate(world, moves.actor).aihtr
    assert rows[-1]["keys_seen"] > 9


def test_chosen_sets_cost_less() -> None:
    world = small_world(3)
    _, fully = learn(world, 3)
    learner, chosen = learn(world, 3, "algo.sensing=chosen", "algo.warm_up=5000")
    assert fully[-1]["sensors_per_frame"] == chosen[0]["sensors_per_frame"] == pytest.approx(9.0)
    assert chosen[-1]["sensors_per_frame"] < 5.0
    assert not (learner.policy.bits == 255).all()


@pytest.mark.parametrize("budget", [0, 2])
def test_it_keeps_to_a_budget_also_while_learning(budget: int) -> None:
    """No sensor is on in the first batch: the moves are inferred from where the safe action located the target."""
    world, most = small_world(3).but(budget=budget), []
    learner = algorithm("model_based", world, f"cost.budget={budget}")
    learner.iterations = 4
    for seed in range(4):
        batch = collect(world, learner.policy, 256, 20, seed=seed)
        most.append(int(batch["action"].sum(-1).max()))
        learner.step(batch)
    assert most == [0] + [budget] * 3
    best, found = optimal.solve(world), evaluate(world, learner.actor)
    assert regret_per_step(best.lower, found) < 0.01


@pytest.mark.slow
def test_plans_on_paths_keep_to_a_budget() -> None:
    world = headings(memory="displacement").but(budget=1)
    learner, rows = learn(world, 3, "kernel=heading", "algo.prior=1", envs=16)
    assert int(learner.actor.dense().sum(-1).max()) == 1
    assert rows[-1]["sensors_per_frame"] < 1.0


@pytest.mark.slow
def test_with_a_budget_and_no_algorithm_named(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where modes are hidden the run says which other learner to compare with."""
    little = ["algo.total_frames=1000", "algo.frames_per_batch=500", "algo.envs=50"]
    words = ["grid.size=3", "cost.budget=1", *little]
    for kernel, more, said in (("random_walk", [], False), ("heading", ["algo.prior=1"], True)):
        run = [f"kernel={kernel}", f"hydra.run.dir={here}/{kernel}", *more]
        assert main(["train", *words, *run]) == 0
        shown = " ".join(capsys.readouterr().out.split())
        assert ("compare with algo=a2c" in shown) is said


@pytest.mark.slow
def test_its_uncertainty_shrinks_and_covers_the_truth() -> None:
    world = small_world(3)
    learner, rows = learn(world, 12, "algo.plan_every=1")
    assert rows[-1]["believed_deviation"] < 0.6 * rows[0]["believed_deviation"]
    truth = evaluate(world, learner.actor).aihtr
    assert abs(rows[-1]["believed_aihtr"] - truth) < 4 * rows[-1]["believed_deviation"]
    visits = [row["least_visits"] for row in rows]
    assert visits == sorted(visits)
    assert visits[0] > 0


def test_its_uncertainty_is_not_smaller_for_few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two draws that are d apart the variance is d² / 2, without bias."""
    monkeypatch.setattr(model_based, "_SAMPLES", 2)
    world = small_world(3)
    learner, rows = learn(world, 1)
    rng = np.random.default_rng(derive(0, "model_based"))
    kernels = learner._estimate.samples(rng, 2)
    first, second = (evaluate(learner._world(each), learner.actor).aihtr for each in kernels)
    assert rows[-1]["believed_deviation"] == pytest.approx(abs(first - second) / 2**0.5)


@pytest.mark.usefixtures("little_search")
@pytest.mark.parametrize(
    ("sensing", "hidden"),
    [("all", False), ("chosen", True), *later([("all", True), ("chosen", False)])],
)
def test_a_resumed_learner_goes_on_as_the_first(
    sensing: str, hidden: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a file of plain tensors and words."""
    monkeypatch.setattr("trackmdp.algos.observed.EM_ROUNDS", 10)
    world = headings(memory="displacement").but(detection=0.9) if hidden else small_world(3)
    words = (f"algo.sensing={sensing}", *(["algo.warm_up=0"] if sensing == "chosen" else []))
    first = algorithm("model_based", world, *words)
    first.iterations = 3
    for seed in range(2):
        first.step(collect(world, first.policy, 32, 20, seed=seed))
    torch.save(first.state_dict(), tmp_path / "state.pt")
    second = algorithm("model_based", world, *words)
    second.iterations = 3
    second.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    batch = collect(world, first.policy, 32, 20, seed=7)
    assert str(first.step(batch.clone())) == str(second.step(batch))  # nan is no equal of nan
    assert (first.actor.dense() == second.actor.dense()).all()


def test_plans_within_the_window() -> None:
    """Where fewer sensors can be chosen than the target can reach, no set holds another."""
    world = small_world(5)
    learner, _ = learn(World(world.kernel, 5, cost=0.05, t_max=1, window=1), 2)
    row, cell = learner.actor.sets.nonzero()
    located = row // 2  # two sets per located cell
    assert len(row)
    assert np.abs(located // 5 - cell // 5).max() <= 1
    assert np.abs(located % 5 - cell % 5).max() <= 1


@pytest.mark.parametrize(("cells", "planned"), [(9, 6), (8, 1)])
def test_above_so_many_cells_it_plans_once(
    cells: int, planned: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trackmdp.algos.model_based.DIRECT_CELLS", cells)
    believed = [row["believed_aihtr"] for row in learn(small_world(3), 6)[1]]
    assert len({value for value in believed if not np.isnan(value)}) == planned


def test_negligible_moves_are_planned_without_and_leave_the_exit_as_it_is() -> None:
    kernel = sparse.lil_array((9, 9))
    kernel[0, [1, 3, 4]] = 0.5, 0.3, 0.1  # .1 goes, and the others share it 5 to 3
    kernel[1, [0, 2, 3, 4]] = 0.2, 0.2, 0.2, 0.2  # all would go, and all stay
    for row in range(2, 9):
        kernel[row, row] = 0.5
    believed = without(sparse.csr_array(kernel), 0.3).toarray()
    np.testing.assert_allclose(believed[0, [1, 3, 4]], [0.5625, 0.3375, 0.0])
    np.testing.assert_allclose(believed[1, [0, 2, 3, 4]], 0.2)
    np.testing.assert_allclose(believed.sum(axis=1), [0.9, 0.8, *[0.5] * 7])


@pytest.mark.parametrize(
    ("prior", "most"), [("0", 1_000_000), ("null", 60), *later([("null", 1_000_000)])]
)
def test_it_learns_the_zigzag_from_recordings(
    prior: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(path_plans, "_MOST", most)
    # Recordings that end in different cells, so that some can judge.
    task = swept(lengths=(12, 13, 14, 15, 16, 17), memory="displacement", clip=1)
    learner = on_tracks(task, iterations=1, prior=prior)
    figures = learner.step(collect(task, learner.policy, 20, 60))
    moves = task.tracks.lengths - 1
    assert replay(task, task.tracks, learner.actor).totals[:, 0] == pytest.approx(moves * 0.8)
    assert figures["keys_seen"] > 7
    assert figures["reward_per_move"] == pytest.approx(0.8, abs=0.01)


def test_hidden_modes_of_more_paths_are_fitted_from_those_of_fewer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = swept(memory="displacement", clip=1)
    plan, begun = PolicyTable.all_on(task), list[Fit | None]()
    fits = [fit_modes(task.tracks, 9, 2, seed) for seed in range(2)]

    def fitted(*given: Any) -> Fit:
        begun.append(given[-1])
        return fits[len(begun) - 1]

    monkeypatch.setattr("trackmdp.algos.model_based.fit_modes", fitted)
    monkeypatch.setattr("trackmdp.solvers.hidden.best_found", lambda *_, **__: plan)
    monkeypatch.setattr("trackmdp.solvers.exchange.improve", lambda *_: plan)
    learner = on_tracks(task, iterations=1)
    for before in (None, plan):
        assert learner._with_modes(task.tracks, before) is plan
    first, second = begun
    assert first is None
    assert second is fits[0]


def test_plans_on_paths_are_made_three_times_and_at_the_end() -> None:
    """Seven batches: after the second, the fourth and the sixth, and the last."""
    task = swept(memory="displacement", clip=1)
    learner, planned = on_tracks(task, iterations=7), []
    for seed in range(7):
        before = learner.actor
        learner.step(collect(task, learner.policy, 5, 10, seed=seed))
        planned.append(learner.actor is not before)
    assert planned == [False, True, False, True, False, True, True]


def test_a_run_is_valued_loaded_exported_and_resumed(here: Path) -> None:
    """By the command line: the policy of the folder is keyed, and its figures are those of its tracks."""
    write(here / "t.csv", swept(50).tracks)
    budget = ["algo.total_frames=2000", "collector.envs=10", "collector.frames_per_batch=500"]
    words = ["grid.size=3", "cost.sensor=0.2", "kernel.ends=exit", "algo.prior=1", *budget]
    words += ["checkpoint.every=500", "quiet=true"]
    assert main(["train", *TRACKS, *words, f"hydra.run.dir={here}/run"]) == 0
    run = load_run(here / "run")
    assert (run.policy.task.memory, run.policy.task.clip) == ("displacement", 1)
    assert run.evaluation.aihtr == pytest.approx(12 * 0.8)
    assert main(["evaluate", "run=run", "quiet=true", f"hydra.run.dir={here}/judged"]) == 0
    judged = json.loads((here / "judged/evaluation.json").read_text())
    assert judged["held_out"]["figures"]["policy"]["aihtr"]["mean"] == pytest.approx(12 * 0.8)
    assert "task.memory=cell" in judged["held_out"]["figures"]
    sets = json.loads((here / "judged/sets.json").read_text())
    assert len(sets["sets"]) == 90
    # Located in 1, having come from 0: on to 2.
    assert sets["sets"][str(1 * 10 + 1 + 5)][0] == [2]
    before = (here / "run/policy.npz").read_bytes()
    # As if it had been cut after its second batch.
    (here / "run/summary.json").unlink()
    for file in sorted((here / "run/checkpoints").glob("*"))[2:]:
        file.unlink()
    assert main(["train", "resume=auto", *TRACKS, *words, f"hydra.run.dir={here}/run"]) == 0
    assert (here / "run/policy.npz").read_bytes() == before
    assert main(["export", "run=run", "format=pt2", "quiet=true", f"hydra.run.dir={here}/out"]) == 0
    table = torch.export.load(here / "out/policy.pt2").module()
    assert table(torch.tensor([16]), torch.tensor([0])).nonzero().tolist() == [[0, 2]]


@pytest.mark.slow
@pytest.mark.usefixtures("little_search")
def test_a_hidden_heading_is_solved_and_learned(here: Path) -> None:
    """By the command line: the learned policy is no better than the solved one, and valued exactly."""
    world = ["kernel=heading", "grid.size=3", "kernel.exit_probability=0.1", "task.clip=1"]
    world += ["task.memory=displacement", "quiet=true"]
    assert main(["solve", *world, f"hydra.run.dir={here}/solved"]) == 0
    solved = json.loads((here / "solved/solution.json").read_text())
    words = ["algo.total_frames=20000", "collector.frames_per_batch=10000"]
    assert main(["train", *world, *words, f"hydra.run.dir={here}/run"]) == 0
    learned = load_run(here / "run").evaluation.aihtr
    assert solved["lower"] - 0.5 < learned <= solved["lower"] + 0.05 < solved["upper"]


def test_the_first_line_names_the_estimate(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["grid.size=3", "algo.total_frames=10000", f"hydra.run.dir={here}/run"]
    assert main(["train", *words]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert "algo=model_based: plans on pooled moves" in " ".join(shown[:3])


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["algo=path_counts"], "algo=path_counts: renamed, expected algo=model_based"),
        (["algo=learned_kernel"], "algo=learned_kernel: renamed, expected algo=model_based"),
        (["algo.warm_up=1"], "algo.warm_up=1: without effect with algo.sensing=null"),
        (["algo.sensing=all", "cost.budget=1"], "expected chosen or null with cost.budget=1"),
        (["algo.warm_up=1", "cost.budget=1"], "algo.warm_up=1: without effect with cost.budget"),
        (["algo.estimate=moves", "algo.prior=2"], "without effect with algo.estimate=moves"),
        (["algo.gamma=0.5"], "algo.gamma=0.5: without effect with kernel=random_support"),
        (
            ["algo.prior=2", "kernel=heading", "kernel.reveals=true"],
            "algo.prior=2: without effect with kernel=heading",
        ),
        (
            ["algo.estimate=paths", "algo.share_cells=all"],
            "algo.share_cells=all: without effect with algo.estimate=paths",
        ),
        (["task.clip=3"], "task.clip=3: without effect with task.memory=cell"),
        (
            ["kernel=heading", "kernel.reveals=true", "algo.share_cells=all"],
            "algo.share_cells=all: expected none or null with kernel.reveals=true",
        ),
    ],
)
def test_options_without_a_meaning_are_refused(
    words: list[str], expected: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert expected in refused(capsys, "train", *words)
    assert not list(here.iterdir())


def test_plans_on_moves_of_a_given_problem_have_no_prior() -> None:
    few: Any = {"prior": 2, "total_frames": 200, "frames_per_batch": 100, "envs": 10}
    world = small_world(2)
    with pytest.raises(UserError, match="prior=2: without effect with kernel=given, of pooled"):
        tm.train(world, "model_based", **few)
    assert tm.train(world.but(markov=False), "model_based", **few).policy.task.markov is False


@pytest.mark.parametrize("frames", [2, 4])
def test_a_target_may_not_be_located_yet(frames: int) -> None:
    """With a budget no sensor is on at first: the safe action comes in the third step, in a batch of two the second."""
    world = headings(2, memory="displacement", t_max=1).but(budget=1)
    words: Any = {"total_frames": frames, "frames_per_batch": 2, "envs": 1}
    if frames > 2:
        assert tm.train(world, "model_based", **words).evaluation.error == 0
        return
    with pytest.raises(UserError, match=r"^algo\.total_frames: in none of them was a target"):
        tm.train(world, "model_based", **words)
