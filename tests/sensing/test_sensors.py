"""Sensors that miss, stepped and simulated: they do what exact evaluation says they do, and replay to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.helpers import advanced, random_kernel, small_world
from trackmdp.app.cli import main
from trackmdp.environment.dynamics import Dynamics
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.paths import path_sampler
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.policies.saved import load_policy, save_policy
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.make import make_world
from trackmdp.world.model import World

LINE = np.diag(np.full(3, 0.9), 1)


def _line(**sensors: float) -> World:
    """Cells 0 1 2 3 in a row; the target goes right, and is out beyond cell 3 or with .1 a step."""
    return World(LINE, (1, 4), cost=0.25, t_max=0, safe_cost=2.0, **sensors)


def _from_zero(world: World, action: torch.Tensor, reports: list[float]) -> list[TensorDict]:
    """The steps of one target from cell 0 that moves on and is reported where the draw is below p."""
    state = Dynamics(world, path_sampler(world)).start(torch.tensor([0]))
    steps = []
    for report in reports:
        uniform = torch.tensor([report], dtype=torch.float64)
        state |= advanced(world, state | {"action": action}, [0.5], uniform)
        steps.append(TensorDict({key: value.clone() for key, value in state.items()}, [1]))
    return steps


def test_a_miss_costs_and_a_safe_action_that_misses_is_repeated() -> None:
    world = _line(detection=0.5, safe_detection=0.25)
    action = torch.tensor([[False, True, True, False]])
    # Missed by the sensor at 1 (.6 > p_d), by the safe action at 2 (.3 > p_s), and found by it at 3 (.2 < p_s).
    first, second, third = _from_zero(world, action, [0.6, 0.3, 0.2])
    assert [step["reward"].item() for step in (first, second, third)] == [-0.5, -2.0, -1.0]
    assert [step["steps_since_detection"].item() for step in (first, second, third)] == [1, 1, 0]
    assert [step["last_cell"].item() for step in (first, second, third)] == [0, 0, 3]
    # What the safe action replaced is not remembered, and what was chosen before it stays.
    assert torch.equal(first["action_history"], action.unsqueeze(1))
    assert torch.equal(first["action_history"], second["action_history"])
    assert not third["action_history"].any()


def test_a_detection_is_what_it_is_without_misses() -> None:
    (first,) = _from_zero(_line(detection=0.5), torch.tensor([[False, True, True, False]]), [0.4])
    assert (first["reward"].item(), first["last_cell"].item()) == (0.5, 1)


def test_certain_reports_draw_nothing_and_others_from_a_generator_of_their_own() -> None:
    world = small_world()
    plain, missing = (TrackEnv(each, 8, seed=3) for each in (world, replace(world, detection=0.5)))
    assert "report" not in plain.snapshot()["generators"]
    before = missing.snapshot()["generators"]
    for env in (plain, missing):
        state = env.reset()
        for _ in range(20):
            state = env.step(state.set("action", torch.zeros(8, 9, dtype=torch.bool)))["next"]
    after = missing.snapshot()["generators"]
    assert not torch.equal(before["report"], after["report"])
    assert torch.equal(plain.snapshot()["generators"]["motion"], after["motion"])


def test_exact_values_are_those_of_simulation_on_thirty_worlds() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        kernel = random_kernel(rng, 9, 0.2)
        probabilities = {
            "detection": 1 - 0.7 * rng.random(9),
            "safe_detection": 1 - 0.5 * rng.random(9) * (seed % 2),
        }
        world = World(kernel, 3, cost=0.3 * rng.random(9), t_max=seed % 3, **probabilities)
        policy = Policy.from_dense(world, rng.random((9, world.num_choices, 9)) < 0.5)
        simulated, exact = simulate(world, policy, 1_000, seed=1).figures(), evaluate(world, policy)
        assert abs(simulated.aihtr.mean - exact.aihtr) <= 3 * simulated.aihtr.standard_error, seed
        assert simulated.accuracy.mean == pytest.approx(exact.accuracy, abs=0.05)


def test_the_environment_earns_the_exact_value() -> None:
    world = replace(small_world(exit_probability=0.3), detection=0.6, safe_detection=0.7)
    policy = Policy.from_dense(world, np.random.default_rng(2).random((9, 2, 9)) < 0.6)
    env = TrackEnv(world, 4000, seed=1)
    state, returns, running = env.reset(), torch.zeros(4000), torch.ones(4000)
    while running.any():
        following = env.step(policy(state))["next"]
        returns += running * following["reward"].squeeze(-1)
        running *= ~following["done"].squeeze(-1)
        state = following.exclude("reward", "done", "terminated", "truncated")
    error = returns.std() / len(returns) ** 0.5
    assert abs(returns.mean() - evaluate(world, policy).aihtr) <= 3 * error


def test_episodes_that_are_logged_replay_to_the_bit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["grid.size=4", "kernel=random_walk", "kernel.exit_probability=.05", "quiet=true"]
    sensors = ["sensor=miss", "sensor.p_d=.7", "sensor.p_s=.6", "cost.sensor=.3"]
    assert (
        main(
            [
                "evaluate",
                *words,
                *sensors,
                "baseline=clocked",
                "episodes=20",
                "log=[mcap]",
                _in(tmp_path),
            ]
        )
        == 0
    )
    file = next(tmp_path.glob("*.mcap"))
    assert main(["replay", f"file={file}", "verify=true"]) == 0
    assert "the same to the bit" in capsys.readouterr().out


def test_beliefs_of_a_log_are_those_of_bayes() -> None:
    """Of two cells alike, the sensed one is missed with .2 and the other for certain: .2 to 1, .167 to .833."""
    kernel = np.array([[0.45, 0.45], [0.45, 0.45]])
    world = World(kernel, (1, 2), cost=0.1, t_max=2, detection=0.8)
    policy = Policy.from_dense(world, np.tile([True, False], (2, 3, 1)))
    for episode in simulate(world, policy, 40).complete():
        assert episode.belief is not None
        for t in np.flatnonzero(episode.misses[1:] == 1) + 1:
            assert episode.belief[t] == pytest.approx([0.45, 0.45])
    other = World(np.array([[0.8, 0.1], [0.1, 0.8]]), (1, 2), cost=0.1, t_max=2, detection=0.8)
    seen = [
        episode.belief[1]
        for episode in simulate(other, policy, 40).complete()
        if episode.start == 0
        and len(episode) > 1
        and episode.misses[1] == 1
        and episode.belief is not None
    ]
    # Predicted .8 and .1, missed: .16 to .1; after the next move .8 · .16 + .1 · .1 over .26.
    assert len(seen) > 2
    assert all(belief == pytest.approx([0.138 / 0.26, 0.096 / 0.26], abs=1e-6) for belief in seen)


def test_a_saved_policy_keeps_its_sensors(tmp_path: Path) -> None:
    world = replace(small_world(), detection=np.linspace(0.5, 1, 9), safe_detection=0.9)
    save_policy(tmp_path / "a.npz", as_policy(world, Policy.all_on(world)))
    task = load_policy(tmp_path / "a.npz")[0].task
    assert np.array_equal(task.detection, world.detection)
    assert np.array_equal(task.safe_detection, world.safe_detection)
    save_policy(tmp_path / "b.npz", Policy.all_on(small_world()))
    assert load_policy(tmp_path / "b.npz")[0].task.perfect


def test_a_policy_is_valued_with_the_sensors_of_the_world() -> None:
    perfect, on = small_world(), np.random.default_rng(0).random((9, 2, 9)) < 0.6
    made = Policy.from_dense(perfect, on)
    world = replace(perfect, detection=0.5)
    assert evaluate(world, made).aihtr == evaluate(world, Policy.from_dense(world, on)).aihtr
    assert evaluate(world, made).aihtr < evaluate(perfect, made).aihtr
    cost = perfect.cost.copy()
    cost[4] = np.nan
    gone = replace(perfect, cost=cost)
    for policy in (made, Policy.all_on(perfect), Policy.random_k(perfect, 2)):
        with pytest.raises(UserError, match="sensor 4 "):
            evaluate(gone, policy)
    assert evaluate(gone, Policy.none(perfect)).accuracy > 0


def test_the_command_line_and_python_make_the_same_world(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "p.csv", np.full((5, 5), 0.75), delimiter=",")
    world = make_world("random_walk", size=5, detection=str(tmp_path / "p.csv"), safe_detection=0.5)
    assert (world.detection == 0.75).all()
    assert (world.safe_detection == 0.5).all()
    assert make_world("random_walk", size=5).perfect


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["sensor=miss", "sensor.p_d=0"], "sensor.p_d=0: expected a number above 0, at most 1"),
        (
            ["sensor=miss", "sensor.p_s=1.01"],
            "sensor.p_s=1.01: expected a number above 0, at most 1",
        ),
        (
            ["sensor=miss", "sensor.p_d=[.5,.5]"],
            "sensor.p_d: 2 values, expected one number or 9 (one per cell)",
        ),
        (["sensor=miss", "sensor.p_d=here.txt"], "sensor.p_d=here.txt: expected a number above 0"),
        (["sensor=miss", "sensor.p_d=none.npy"], "none.npy"),
        (["sensor.p_d=.5"], "sensor=miss"),
        (["sensor=deaf"], "sensor=deaf"),
    ],
)
def test_bad_sensors_are_refused_in_one_line(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["solve", "grid.size=3", *words, _in(tmp_path / "run")]) != 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert told in lines[0]
    assert not (tmp_path / "run").exists()


def test_a_file_with_no_probability_names_its_cell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "p.npy", np.array([0.5] * 8 + [1.5]))
    assert (
        main(
            [
                "solve",
                "grid.size=3",
                "sensor=miss",
                f"sensor.p_d={tmp_path / 'p.npy'}",
                _in(tmp_path / "run"),
            ]
        )
        != 0
    )
    assert "cell 8 has 1.5, expected a probability above 0, at most 1" in capsys.readouterr().err


def _in(folder: Path) -> str:
    return f"hydra.run.dir={folder}"
