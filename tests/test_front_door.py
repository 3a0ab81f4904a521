"""`import trackmdp as tm`: light, complete, and the same to a type checker as when run."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import json
import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from trackmdp.errors import UserError

HEAVY = ("torch", "torchrl", "tensordict", "hydra", "omegaconf", "scipy", "numpy")


def after(code: str) -> Any:
    """What a new process leaves in `found` after `code`."""
    script = f"import json, sys\n{code}\nprint(json.dumps(found))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def loaded(code: str, *packages: str) -> list[str]:
    """Which of the packages are loaded after `code`."""
    return list(after(f"{code}\nfound = [name for name in {packages!r} if name in sys.modules]"))


def test_importing_loads_nothing_heavy() -> None:
    # Of the standard library too: `importlib.abc` alone doubles the time, by way of tempfile and random.
    assert not loaded("import trackmdp", *HEAVY, "tempfile", "inspect", "dataclasses", "asyncio")


def test_a_world_needs_neither_torch_nor_hydra() -> None:
    assert not loaded("import trackmdp as tm\ntm.make_world(size=4)", "torch", "hydra")


TRAINED = """
import trackmdp as tm
world = tm.make_world(size=2)
run = tm.train(world, "ppo", total_frames=64, frames_per_batch=64, envs=32)
assert tm.evaluate(world, run.policy).aihtr <= tm.solve(world).upper
"""


def test_training_and_solving_touch_no_hydra_and_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(tm.__file__).parents[1]))
    monkeypatch.chdir(tmp_path)
    assert not after(
        f"{TRAINED}\nfound = [name for name in sys.modules if name.split('.')[0] == 'hydra']"
    )
    assert not list(tmp_path.iterdir())


def test_a_mistyped_option_is_answered_before_torch_is_loaded() -> None:
    code = """
from trackmdp.app.cli import main
assert main(["train", "sead=1"]) == 2
found = [name for name in ("torch", "tensordict", "torchrl", "scipy", "matplotlib", "pandas") if name in sys.modules]
"""
    assert not after(code)


@pytest.mark.parametrize("name", tm.__all__)
def test_every_name_is_there_and_says_what_it_is(name: str) -> None:
    found = getattr(tm, name)
    assert name in dir(tm)
    assert inspect.getdoc(found)
    assert found.__module__ == tm._HOMES[name]


PACKAGE = Path(tm.__file__).parent
WITH_EXAMPLES = [
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>>" in path.read_text()
]


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_in_docstrings_print_their_output(module: str) -> None:
    found = doctest.testmod(importlib.import_module(module))
    assert found.attempted
    assert not found.failed


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse(Path(tm.__file__).read_text(encoding="utf-8"))
    block = next(
        node
        for node in tree.body
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    )
    seen = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == tm._HOMES
    assert sorted(seen) == sorted(tm.__all__)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'wrold'"):
        _ = tm.wrold


def test_signatures_show_the_values_of_conf() -> None:
    shown = str(inspect.signature(tm.make_world))
    for default in ("'random_support'", "= 10,", "= 1,", "= 0.16,"):
        assert default in shown


def test_a_world_is_that_of_the_command_line() -> None:
    from tests.helpers import train_config
    from trackmdp.world.configured import make_problem

    world = tm.make_world(
        "drift", size=4, cost=np.linspace(0.1, 0.2, 16), direction=90, max_steps=30
    )
    cost = ",".join(str(price) for price in np.linspace(0.1, 0.2, 16))
    same = make_problem(
        train_config(
            "kernel=drift",
            "grid.size=4",
            f"cost.sensor=[{cost}]",
            "kernel.direction=90",
            "grid.max_steps=30",
        )
    )
    assert isinstance(same, tm.World)
    assert (world.kernel != same.kernel).nnz == 0
    assert np.array_equal(world.cost, same.cost)
    assert (world.max_steps, world.t_max, world.safe_cost) == (30, 1, same.safe_cost)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"size": 0}, "grid.size=0: expected"),
    ({"kernel": "lvey"}, "kernel=lvey: expected one of random_support"),
    (
        {"support_sizee": 3},
        "kernel.support_sizee: unknown option, did you mean kernel.support_size?",
    ),
    ({"cost": [1, 2]}, "cost.sensor: 2 values, expected one number or 100"),
    ({"t_max": 1.5}, "grid.t_max=1.5: expected an integer"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED)
def test_a_mistake_is_told_as_at_the_terminal(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        tm.make_world(**arguments)
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize("name", ["cost", "detection", "safe_detection"])
def test_a_map_of_numbers_is_taken_as_the_grid_has_it(name: str) -> None:
    values = np.linspace(0.1, 0.9, 12).reshape(3, 4)
    made = tm.make_world("drift", size=(3, 4), **{name: values})
    given = {"cost": 0.1, "t_max": 1, name: values}
    world = tm.World(np.eye(12) * 0.5, (3, 4), **given)
    for each in (made, world):
        assert np.array_equal(getattr(each, name), values.ravel())
    for refused in (
        lambda: tm.World(np.eye(12) * 0.5, (3, 4), **(given | {name: values.T})),
        lambda: tm.make_world("drift", size=(3, 4), **{name: values.T}),
    ):
        with pytest.raises(UserError, match=r"12|4 x 3 numbers, expected 3 x 4"):  # 12 cells
            refused()


def test_an_argument_of_another_kind_is_one_line() -> None:
    with pytest.raises(UserError, match=r"a ndarray, expected a name; World\(kernel, size"):
        tm.make_world(np.eye(9))  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"^make_world: kernel: a list, expected a name"):
        tm.make_world([[0.5, 0.5], [1.0]])  # type: ignore[call-overload]
    with pytest.raises(UserError, match="a int, expected the path of a file, or a DataFrame"):
        tm.load_tracks(3)


@pytest.mark.parametrize("name", ["kernel", "coverage", "cost"])
def test_rows_of_different_lengths_are_one_line(name: str) -> None:
    given: dict[str, Any] = {"kernel": np.eye(9) * 0.5, "cost": 0.1, name: [[0.1] * 9, [0.1]]}
    with pytest.raises(UserError, match=rf"^{name}: "):
        tm.World(size=3, t_max=1, **given)
    with pytest.raises(UserError, match=r"^cost: rows of different lengths, expected a table$"):
        tm.make_world(size=3, cost=[[0.1] * 3, [0.1]])


WORLD = tm.make_world("random_walk", size=3, exit_probability=0.2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: tm.load_run(3), "load_run: a int, expected a path"),
        (lambda: tm.Policy.load(None), "load: a NoneType, expected a path"),
        (lambda: tm.Policy.all_on(WORLD).save(3), "save: a int, expected a path"),
        (lambda: tm.export(tm.Policy.all_on(WORLD), 3), "export: a int, expected a path"),
        (lambda: tm.train(WORLD, folder=3), "folder: a int, expected a path"),
        (lambda: tm.train(WORLD, callbacks=3), "callbacks: a int, expected a list of Callback"),
        (lambda: tm.compare(WORLD, 3), "compare: a int, expected a list or dict of policies"),
        (lambda: tm.compare(WORLD, "none"), "compare: a str, expected a list or dict of policies"),
        (lambda: tm.Policy.all_on(3), "policy: a int, expected a world or recorded tracks"),
        (lambda: tm.Policy.random_k(3, 1), "policy: a int, expected a world or recorded tracks"),
        (lambda: WORLD.but(reward="x"), "reward=x: expected a number from 0"),
        (lambda: WORLD.but(safe_cost="x"), "safe_cost=x: expected a number from 0"),
        (lambda: tm.evaluate(WORLD, "none", false_alarm="x"), "false_alarm=x: expected a prob"),
        (lambda: tm.frontier(WORLD).at(sensors="x"), "sensors: a str, expected a number"),
    ],
)
def test_a_wrong_type_is_told_in_one_line(call: Callable[..., Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        call()
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("save", tm.Policy.all_on(WORLD).save),
        ("export", partial(tm.export, tm.Policy.all_on(WORLD))),
        ("page", tm.simulate(WORLD, "all_on", 1).page),
        ("video", tm.simulate(WORLD, "all_on", 1).video),
    ],
)
def test_a_file_in_no_folder_is_one_line(
    name: str, write: Callable[[Path], Any], tmp_path: Path
) -> None:
    folder, text, pipe = tmp_path / "a.onnx", tmp_path / "text", tmp_path / "pipe.onnx"
    folder.mkdir()
    text.touch()
    os.mkfifo(pipe)
    for file in (tmp_path / "no" / "a.onnx", folder, text / "a.onnx", pipe):
        with pytest.raises(UserError) as caught:
            write(file)
        expected = "expected a file in a folder that can be written to"
        assert str(caught.value) == f"{name}: {file}, {expected}"


def test_completion_offers_public_names_alone() -> None:
    assert [name for name in dir(tm) if not name.startswith("__")] == sorted(tm.__all__)
