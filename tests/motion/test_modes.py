"""Kernels with a hidden mode: by hand, their means, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trackmdp as tm
from tests.helpers import configured
from trackmdp.config import to_yaml
from trackmdp.config.compose import compose
from trackmdp.config.roots import SolveConfig
from trackmdp.config.tree import load_config
from trackmdp.errors import UserError
from trackmdp.motion.modes import (
    constant_velocity,
    coordinated_turn,
    dithered,
    regimes,
    steps_of,
)
from trackmdp.world.configured import make_problem
from trackmdp.world.model import World

WALK = {
    "kernel": "random_walk",
    "stay": 0.6,
    "diagonal": False,
    "exit_probability": 0.1,
    "border": "clip",
}
DRIFT = {
    "kernel": "drift",
    "direction": 0,
    "persistence": 1.0,
    "exit_probability": 0.0,
    "border": "clip",
}
METRES: dict[str, Any] = {
    "cell": 100,
    "step": 10,
    "speed": 10,
    "spacing": 5,
    "exit_probability": 0.1,
}


def world_of(*words: str) -> World:
    made = make_problem(configured("solve", *words))
    assert isinstance(made, World)
    return made


# Dithering.


@given(mean=st.floats(-3, 3), deviation=st.floats(0, 0.5))
def test_dithering_keeps_the_mean(mean: float, deviation: float) -> None:
    """floor(ξ + y) has the mean y to rounding, whatever the noise, as long as no limit is in reach."""
    [chance] = dithered(np.array([mean]), deviation, 8)
    whole = np.arange(-8, 9)
    assert chance.min() >= 0
    assert chance.sum() == pytest.approx(1)
    assert chance @ whole == pytest.approx(mean, abs=1e-9)
    # Var = σ² + E f (1 - f): at most a quarter more than the noise, and the noise is cut off.
    assert -1e-9 <= chance @ (whole - mean) ** 2 <= deviation**2 + 0.25 + 1e-9


def test_dithering_by_hand() -> None:
    assert dithered(np.array([0.3]), 0.0, 2)[0] == pytest.approx([0, 0, 0.7, 0.3, 0])
    assert dithered(np.array([-1.7]), 0.0, 2)[0] == pytest.approx([0.7, 0.3, 0, 0, 0])
    assert dithered(np.array([2.6]), 0.0, 2)[0] == pytest.approx(
        [0, 0, 0, 0, 1]
    )  # beyond the limit: that
    # Stays with 1 - 2 E (w)_+ = 1 - 2 σ φ(0), but for the noise beyond 4 σ.
    assert dithered(np.array([0.0]), 0.1, 1)[0, 1] == pytest.approx(
        1 - 0.2 / math.sqrt(2 * math.pi), abs=1e-4
    )


@given(rows=st.floats(-3, 3), columns=st.floats(-3, 3))
def test_a_step_has_the_mean_of_its_velocity(rows: float, columns: float) -> None:
    offsets, shares = steps_of(np.array([[rows, columns]]))
    assert shares[0].sum() == pytest.approx(1)
    assert shares[0] @ offsets[0] == pytest.approx([rows, columns], abs=1e-12)


# Velocity.


def moves_of(
    kernel: Any, size: int, modes: int, cell: int, mode: int
) -> list[tuple[float, int, int, int]]:
    """(probability, rows, columns, next mode) of the moves from a hidden state."""
    row = kernel[[cell * modes + mode]].tocoo()
    ends, after = np.divmod(row.coords[1], modes)
    apart = ends // size - cell // size, ends % size - cell % size
    return list(
        zip(row.data.tolist(), *(each.tolist() for each in apart), after.tolist(), strict=True)
    )


def test_constant_velocity_by_hand() -> None:
    """At (0, 5) m/s of cells of 100 m in 10 s: half a cell to the right, with no noise the same velocity for good."""
    kernel, modes = constant_velocity(3, noise=0.0, **METRES)
    assert modes == 25
    slow = 2 * 5 + 3  # rows -10 -5 0 5 10, columns the same: the third row's fourth
    assert moves_of(kernel, 3, 25, 4, slow) == [
        (pytest.approx(0.45), 0, 0, slow),
        (pytest.approx(0.45), 0, 1, slow),
    ]
    # At the right border half of it would lead outside: it stays, turned back to (0, -5).
    assert moves_of(kernel, 3, 25, 5, slow) == [
        (pytest.approx(0.45), 0, 0, 11),
        (pytest.approx(0.45), 0, 0, slow),
    ]


def test_velocity_and_displacement_keep_their_means() -> None:
    """From the middle of a large grid: E v' = v away from the limit, and E d = v' for each v', exactly."""
    kernel, modes = constant_velocity(9, noise=0.1, **METRES)
    levels = np.array([-10, -5, 0, 5, 10]) / 10  # cells a step
    for mode in (7, 12, 18):  # (-.5, 0), (0, 0), (.5, .5): the noise of 1 m/s ends before the limit
        moves = np.array(moves_of(kernel, 9, modes, 40, mode))
        chance, after = moves[:, 0] / 0.9, moves[:, 3].astype(int)
        velocity = np.stack([levels[after // 5], levels[after % 5]], axis=1)
        assert chance.sum() == pytest.approx(1)
        assert chance @ velocity == pytest.approx([levels[mode // 5], levels[mode % 5]], abs=1e-12)
        for each in np.unique(after):
            own = after == each
            mean = chance[own] @ moves[own, 1:3] / chance[own].sum()
            assert mean == pytest.approx([levels[each // 5], levels[each % 5]], abs=1e-12)


def test_a_coordinated_turn_turns_the_velocity() -> None:
    """R(ω) v is the mean of the next velocity, for the new ω, and ω is kept with `stay`."""
    kernel, modes = coordinated_turn(
        9, noise=0.0, turn_rate=4.5, stay=0.8, **METRES
    )  # 45 degrees a step
    assert modes == 75
    start = (2 * 5 + 3) * 3 + 1  # (0, 5) m/s, straight on
    moves = np.array(moves_of(kernel, 9, modes, 40, start))
    chance, after = moves[:, 0] / 0.9, moves[:, 3].astype(int)
    for turn, share in ((0, 0.1), (1, 0.8), (2, 0.1)):
        own = after % 3 == turn
        assert chance[own].sum() == pytest.approx(share)
        velocity = np.stack([after // 15 - 2, after // 3 % 5 - 2], axis=1) * 5.0
        mean = chance[own] @ velocity[own] / share
        angle = math.radians(45) * (turn - 1)
        assert mean == pytest.approx([-5 * math.sin(angle), 5 * math.cos(angle)], abs=1e-9)
    # At the border it turns back and goes on turning as before.
    moves = np.array(moves_of(kernel, 9, modes, 8, start))
    assert (2 * 5 + 1) * 3 + 1 in moves[:, 3]


def test_without_a_turn_it_is_constant_velocity() -> None:
    straight, _ = coordinated_turn(3, noise=0.1, turn_rate=1, stay=1.0, **METRES)
    plain, _ = constant_velocity(3, noise=0.1, **METRES)
    own = np.arange(9 * 25) * 3 + 1
    assert abs(straight[own][:, own] - plain).max() < 1e-15


# Regimes.


def test_regimes_by_hand() -> None:
    """From the left cell of a row of three: kept with .7 and lingering, or off to the right with .3."""
    kernel, modes = regimes((1, 3), stay=[0.7, 0.9], regimes=[WALK, DRIFT])
    assert modes == 2
    row = kernel[[0]].toarray()[0]
    # Of the walk's four neighbours three are outside, and clipped to its own cell: .6 + .3 = .9, and .1 to the right.
    assert row == pytest.approx([0.7 * 0.9 * 0.9, 0, 0.7 * 0.9 * 0.1, 0.3, 0, 0])
    assert kernel[[1]].toarray()[0] == pytest.approx(
        [0.1 * 0.9 * 0.9, 0, 0.1 * 0.9 * 0.1, 0.9, 0, 0]
    )


def test_regimes_are_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Left out options are those of conf/; a table's path becomes absolute; the saved config says all of it."""
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "t.npy", np.full((9, 9), 0.1))

    listed = [
        {"kernel": "drift", "direction": 90},
        "t.npy",
        {"kernel": "table", "path": Path("t.npy")},
    ]
    made = compose("solve", {"kernel": "regimes", "kernel.regimes": listed, "grid.size": 3})
    drift, table, same = made.kernel.regimes
    assert drift == {
        "kernel": "drift",
        "direction": 90,
        "persistence": 0.7,
        "exit_probability": 0.005,
        "border": "renormalize",
    }
    assert table == same == {"kernel": "table", "path": str(tmp_path / "t.npy")}
    (tmp_path / "c.yaml").write_text(to_yaml(made))
    again = load_config(tmp_path / "c.yaml", SolveConfig)
    assert again.kernel.regimes == made.kernel.regimes  # type: ignore[attr-defined]
    assert (make_problem(made).kernel != make_problem(again).kernel).nnz == 0  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "kernel.regimes=[{kernel: drift}]",
            r"kernel\.regimes=.*expected a list of 2 to 1,000 kernels",
        ),
        ("kernel.regimes=[{kernel: drift}, 3]", r"kernel\.regimes\[1\]=3: expected {kernel: NAME"),
        (
            "kernel.regimes=[{kernel: drift}, drift]",
            r"kernel\.regimes\[1\]=drift: expected {kernel: NAME",
        ),
        (
            "kernel.regimes=[{kernel: drift}, {kernel: heading}]",
            r"regimes\[1\]\.kernel=heading: expected one of random_s",
        ),
        (
            "kernel.regimes=[{kernel: drift}, {kernel: drift, way: 3}]",
            r"kernel\.regimes\[1\]\.way: unknown option.*\(known: .*direction",
        ),
        (
            "kernel.regimes=[{kernel: drift}, {kernel: drift, direction: 400}]",
            r"kernel\.regimes\[1\]\.direction=400: expected a number >= 0 and < 360 \(degrees\)",
        ),
        (
            "kernel.regimes=[{kernel: drift}, {kernel: table}]",
            r"kernel\.regimes\[1\]\.path: missing, expected a path",
        ),
        ("kernel.stay=2", r"kernel\.stay=2: expected numbers from 0 to 1"),
        (
            "kernel.stay=[0.1,0.2,0.3]",
            r"kernel\.stay=.*: expected one number, or 2 \(one per regime\)",
        ),
    ],
)
def test_a_wrong_regime_is_named(words: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        configured("solve", "kernel=regimes", words)


def test_a_table_for_another_grid_is_named(tmp_path: Path) -> None:
    np.save(tmp_path / "t.npy", np.full((4, 4), 0.1))
    with pytest.raises(
        UserError, match=r"kernel\.regimes\[1\]: 4 rows, but a 3x3 grid has 9 cells"
    ):
        world_of(
            "kernel=regimes", "grid.size=3", f"kernel.regimes=[{{kernel: drift}}, {tmp_path}/t.npy]"
        )


def test_a_table_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^kernel\.regimes\[0\]\.path=.*t\.npy: no such file$"):
        world_of("kernel=regimes", f"kernel.regimes=[{tmp_path}/t.npy, {{kernel: drift}}]")


def test_a_target_that_stays_for_ever_is_named() -> None:
    stays = "{kernel: drift, exit_probability: 0}"
    with pytest.raises(UserError, match="from cell 0 the target never exits"):
        world_of("kernel=regimes", "grid.size=3", f"kernel.regimes=[{stays},{stays}]")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["kernel.spacing=11"], r"kernel\.spacing=11.*: expected at most kernel\.speed=10"),
        (
            ["kernel.spacing=0.1"],
            r"kernel\.spacing=0\.1: expected more: with kernel\.speed=10 these are 40,401 velocit",
        ),
        (["kernel.spacing=1e-300"], "these are inf velocities"),
        (
            ["kernel.cell=1e-5"],
            r"kernel\.speed=10.*: expected less: with kernel\.step=10 that is 1e\+07 cells, 1,000,000",
        ),
        (
            ["kernel.noise=1e308"],
            r"kernel\.noise=1e\+308: expected less: .* inf times kernel\.spacing, 1,000,000 at most",
        ),
        (["kernel.step=1e308"], r"kernel\.step=1e\+308: expected a number > 0 and <= 1e9 \(s\)"),
    ],
)
def test_velocities_that_are_refused(words: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        configured("solve", "kernel=constant_velocity", *words)


def test_hidden_worlds_from_python() -> None:
    """As by the command line."""
    ours = tm.make_world(
        "constant_velocity", size=4, cost=0.1, memory="displacement", clip=1, noise=0.3
    )
    words = (
        "kernel=constant_velocity",
        "grid.size=4",
        "cost.sensor=0.1",
        "task.memory=displacement",
        "task.clip=1",
    )
    same = world_of(*words, "kernel.noise=0.3")
    assert (ours.kernel != same.kernel).nnz == 0
    assert (ours.num_keys, ours.modes, ours.cost[0]) == (160, 9, 0.1)
