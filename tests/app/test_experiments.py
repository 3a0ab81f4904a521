"""Every experiment that is shipped is a sweep of the size it should have, and its runs are accepted."""

from __future__ import annotations

from pathlib import Path

import pytest

from trackmdp.app.cli import main
from trackmdp.app.composer import Composer
from trackmdp.app.sweep.plan import combinations, plan
from trackmdp.config import conf_dir

RUNS = {"paper": 276, "quality": 12, "pairs": 180, "growth": 40, "model_based": 108}


def test_these_are_all_experiments() -> None:
    assert {file.stem for file in Path(conf_dir(), "experiment").glob("*.yaml")} == RUNS.keys()


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_of_an_experiment_are_accepted(name: str) -> None:
    with Composer("train") as compose:
        blocks = compose([f"experiment={name}"]).hydra.sweeper.blocks
        grids = [combinations([block], [f"experiment={name}"]) for block in blocks]
        assert sum(map(len, grids)) == RUNS[name]
        # Of runs that differ in the seed alone one will do.
        few = {
            " ".join(words).partition(" seed=")[0]: words for words in (grid[-1] for grid in grids)
        }
        refusals = {job.refusal for job in plan("train", Path("none"), compose, [*few.values()])}
    assert refusals == {""}


def test_a_single_run_of_an_experiment_names_the_runs_left_out(
    capsys: pytest.CaptureFixture[str], empty_folder: Path
) -> None:
    """One line after the first says that the sweep needs -m."""
    tiny = (
        "grid.size=3 algo=model_based collector.total_frames=1000 collector.frames_per_batch=1000"
    )
    words = (
        f"train experiment=paper {tiny} collector.envs=100 optimal.enabled=false hydra.run.dir=r"
    )
    assert main(words.split()) == 0
    assert "-m is missing, which runs all " in capsys.readouterr().out.splitlines()[1]
