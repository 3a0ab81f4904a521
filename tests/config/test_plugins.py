"""What an installed package adds is a choice like any other: in help, checks, memory, and the tests' lists."""

from __future__ import annotations

import json
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


CALLED = """
import contextlib, io, json, sys
from trackmdp.app.cli import main
said = []
for line in json.loads(sys.argv[1]):
    streams = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        status = main(line.split())
    said.append([status, *(stream.getvalue() for stream in streams)])
print(json.dumps(said))
"""


def called(site: Path, folder: Path, *lines: str, before: str = "") -> list[tuple[int, str, str]]:
    """Status and what is said of each line, in one new process that finds what is installed in `site`."""
    words, path = (
        [sys.executable, "-c", before + CALLED, json.dumps(lines)],
        os.pathsep.join([str(site), str(ROOT)]),
    )
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [(status, out, err) for status, out, err in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("site"))


def test_three_files_each() -> None:
    for name, group in (
        ("jump", "kernel"),
        ("lazy", "algo"),
        ("nearest", "solver"),
        ("lines", "log"),
        ("fading", "sensor"),
    ):
        assert {
            f"outside/{name}.py",
            f"outside/{name}_config.py",
            f"outside/conf/{group}/{name}.yaml",
        } <= set(FILES)
    assert len(FILES) == 5 * 3 + 5  # and one of the memory, and values of a second kernel


def test_help_lists_it(site: Path, tmp_path: Path) -> None:
    lines = (
        "train --help all",
        "solve --help all",
        "train kernel=jump --help",
        "train kernel=jump -c job -p kernel",
    )
    train, solve, jump, job = (said for _, said, _ in called(site, tmp_path, *lines))
    assert "algo=lazy: Sleeps with all sensors on." in train
    assert "kernel=jump: Stays, or jumps to the opposite cell." in train
    assert "  algo.naps=1" in train
    assert "solver=nearest" in solve
    assert "  kernel.stay=0.5 " in jump
    assert "stay: 0.5\n" in job


USED = """
import trackmdp as tm
from tests import helpers
assert tm.make_world("jump", size=3, stay=0.25).kernel[0, 0] == 0.25 * 0.9
assert tm.make_world("hidden_jump", size=3).modes == 2
assert "jump" in helpers.KERNELS and "lazy" in helpers.ALGORITHMS
"""


def test_it_is_used_by_the_commands_from_python_and_by_the_tests_over_all_choices(
    site: Path, tmp_path: Path
) -> None:
    solved = "solve solver=nearest solver.reach=2 grid.size=3 hydra.run.dir=solved"
    lines = f"{TRAIN} hydra.run.dir=run", "evaluate run=run episodes=0", solved
    said = called(site, tmp_path, *lines, before=USED)
    assert [status for status, _, _ in said] == [0, 0, 0], said
    assert "memory: about 0.00 GiB of " in said[0][1]
    assert (tmp_path / "run" / "lines.txt").read_text().splitlines()[0] == "line 1"
    assert (tmp_path / "solved" / "solution.json").is_file()


NEW = "sensor=fading task.memory=misses kernel.exit_probability=0.1 grid.size=3 kernel="


@pytest.mark.parametrize("kernel", ["random_walk", pytest.param("heading", marks=pytest.mark.long)])
def test_a_new_sensor_and_a_new_memory_work_in_every_command(
    kernel: str, site: Path, tmp_path: Path
) -> None:
    """Sensors that see less far away and the gap between detections: solved, learned, simulated, logged, replayed."""
    few = "algo=a2c algo.total_frames=2048 evaluation.every=1 optimal.enabled=false"
    new = NEW + kernel
    lines = (
        f"solve {new} hydra.run.dir=solved",
        f"train {new} {few} hydra.run.dir=run",
        "evaluate run=run episodes=100 log=[mcap] hydra.run.dir=found",
        "replay file=found/episodes.mcap verify=true",
        f"evaluate {new} baseline=optimal episodes=0 hydra.run.dir=best",
        f"train {new.replace('misses', 'mises')} hydra.run.dir=other",
    )
    said = called(site, tmp_path, *lines)
    assert [status for status, _, _ in said] == [0, 0, 0, 0, 0, 2], said
    assert "100 episodes" in said[3][1]
    assert "misses" in said[5][2]
    solved, found, best = (
        json.loads((tmp_path / name).read_text())
        for name in ("solved/solution.json", "found/evaluation.json", "best/evaluation.json")
    )
    assert solved["lower"] == pytest.approx(best["exact"]["aihtr"])
    assert found["exact"]["aihtr"] <= solved["upper"] + 1e-9
    mean = found["simulated"]["aihtr"]
    assert abs(mean["mean"] - found["exact"]["aihtr"]) < 4 * mean["standard_error"]


def test_its_options_are_checked(site: Path, tmp_path: Path) -> None:
    kernels = "random_support, random_walk, drift, table, tracks, heading, regimes"
    kernels += ", constant_velocity, coordinated_turn"
    refused = {
        f"{TRAIN} algo.naps=10": "algo.naps=10: expected an integer from 0 to 9 (naps)",
        f"{TRAIN} algo.naps=5 algo.envs=4": "algo.naps=5: expected at most collector.envs=4",
        f"{TRAIN} algo.bed=1000000000000000": "algo.bed=1000000000000000: needs about",
        "train kernel=jmup": f"kernel=jmup: expected one of {kernels}, hidden_jump, jump",
    }
    for (status, _, error), message in zip(
        called(site, tmp_path, *refused), refused.values(), strict=True
    ):
        assert (status, error.count("\n")) == (2, 1)
        assert error.startswith(f"trackmdp train: {message}")


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        (
            {"outside/__init__.py": "import no_such_module"},
            "cannot be loaded (ModuleNotFoundError: No module named",
        ),
        ({"outside/__init__.py": None}, "cannot be loaded (TypeError: "),  # a folder has no file
        ({"outside/__init__.py": "raise SystemExit"}, "cannot be loaded (SystemExit: "),
        (
            {
                "outside/__init__.py": "thing = 3",
                "outside-1.0.dist-info/entry_points.txt": "[trackmdp.plugins]\noutside = outside:thing",
            },
            "cannot be loaded (AttributeError: 'int' object has no attribute '__file__'",
        ),
        ({"outside/conf/algo/lazy.yaml": None}, "algo/lazy.yaml with the values of algo=lazy"),
        ({"outside/jump_config.py": TWICE}, "kernel=drift: offered by"),
    ],
)
def test_a_broken_one_is_one_line(
    tmp_path: Path, replaced: Mapping[str, str | None], message: str
) -> None:
    ((status, _, error),) = called(install(tmp_path / "site", replaced), tmp_path, "solve --help")
    assert (status, error.count("\n")) == (2, 1), error
    assert "plugin outside" in error
    assert message in error
