"""What an installed package adds is a choice like any other: in help, checks, memory, and the tests' lists."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.config.outside import FILES, install

ROOT = Path(__file__).parents[2]
TRAIN = "train algo=lazy kernel=jump log=[csv,lines] grid.size=3 optimal.enabled=false"

TWICE = FILES["outside/jump_config.py"].replace('"jump"', '"drift"')


def run(site: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """A new process that finds what is installed in `site`."""
    path = os.pathsep.join([str(site), str(ROOT)])
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True
    )


def command(site: Path, folder: Path, words: str) -> subprocess.CompletedProcess[str]:
    return run(site, folder, "-m", "trackmdp.app.cli", *words.split())


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("site"))


def test_three_files_each() -> None:
    for name, group in (("jump", "kernel"), ("lazy", "algo"), ("nearest", "solver"), ("lines", "log")):
        assert {f"outside/{name}.py", f"outside/{name}_config.py", f"outside/conf/{group}/{name}.yaml"} <= set(FILES)
    assert len(FILES) == 4 * 3 + 3


def test_help_lists_it(site: Path, tmp_path: Path) -> None:
    shown = command(site, tmp_path, "train --help").stdout
    assert "algo=lazy: Sleeps with all sensors on." in shown
    assert "kernel=jump: Stays, or jumps to the opposite cell." in shown
    assert "  algo.naps=1" in shown
    assert "solver=nearest" in command(site, tmp_path, "solve --help").stdout


def test_a_run_uses_it_and_says_what_memory_it_takes(site: Path, tmp_path: Path) -> None:
    done = command(site, tmp_path, f"{TRAIN} hydra.run.dir=run")
    assert done.returncode == 0, done.stderr
    assert "algo.bed 0.00 GiB" in done.stdout
    assert (tmp_path / "run" / "lines.txt").read_text().splitlines()[0] == "line 1"
    again = command(site, tmp_path, "evaluate run=run episodes=0")
    assert again.returncode == 0, again.stderr


def test_a_solver_is_valued(site: Path, tmp_path: Path) -> None:
    done = command(site, tmp_path, "solve solver=nearest solver.reach=2 grid.size=3 hydra.run.dir=solved")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "solved" / "solution.json").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"{TRAIN} algo.naps=10", "algo.naps=10: expected an integer from 0 to 9 (naps)"),
        (f"{TRAIN} algo.naps=5 algo.envs=4", "algo.naps=5: expected at most collector.envs=4"),
        (f"{TRAIN} algo.bed=1000000000000000", "algo.bed=1000000000000000: needs about"),
        (
            "train kernel=jmup",
            "kernel=jmup: expected one of random_support, random_walk, drift, table, tracks, heading, regimes, "
            "constant_velocity, coordinated_turn, jump",
        ),
    ],
)
def test_its_options_are_checked(site: Path, tmp_path: Path, words: str, message: str) -> None:
    done = command(site, tmp_path, words)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done
    assert done.stderr.startswith(f"trackmdp train: {message}")


def test_from_python_and_in_the_lists_that_tests_run_over(site: Path, tmp_path: Path) -> None:
    code = """
import trackmdp as tm
from tests import helpers
assert tm.make_world("jump", size=3, stay=0.25).kernel[0, 0] == 0.25 * 0.9
assert "jump" in helpers.KERNELS and "lazy" in helpers.ALGORITHMS
"""
    done = run(site, tmp_path, "-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        ({"outside/__init__.py": "import no_such_module"}, "cannot be loaded (ModuleNotFoundError: No module named"),
        ({"outside/conf/algo/lazy.yaml": None}, "algo/lazy.yaml with the values of algo=lazy"),
        (
            {"outside/jump_config.py": FILES["outside/jump_config.py"].replace('"jump"', '"drift"')},
            "kernel=drift: offered by",
        ),
    ],
)
def test_a_broken_one_is_one_line(tmp_path: Path, replaced: Mapping[str, str | None], message: str) -> None:
    done = command(install(tmp_path / "site", replaced), tmp_path, "solve --help")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done
    assert "plugin outside" in done.stderr
    assert message in done.stderr
