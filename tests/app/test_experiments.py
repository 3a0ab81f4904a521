"""Every experiment that is shipped is a sweep of the size it should have, and its runs are accepted."""

from __future__ import annotations

from pathlib import Path

import pytest

from trackmdp.app.compose import Composer
from trackmdp.app.sweep.plan import combinations, plan
from trackmdp.config import conf_dir

RUNS = {"paper": 216, "quality": 12, "pairs": 180, "growth": 40, "learned_kernel": 108}


def test_these_are_all_experiments() -> None:
    assert {file.stem for file in Path(conf_dir(), "experiment").glob("*.yaml")} == RUNS.keys()


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_of_an_experiment_are_accepted(name: str) -> None:
    with Composer("train") as compose:
        blocks = compose([f"experiment={name}"]).hydra.sweeper.blocks
        grids = [combinations([block], [f"experiment={name}"]) for block in blocks]
        assert sum(map(len, grids)) == RUNS[name]
        # Of runs that differ in the seed alone one will do.
        few = {" ".join(words).partition(" seed=")[0]: words for words in (grid[-1] for grid in grids)}
        refusals = {job.refusal for job in plan("train", Path("none"), compose, [*few.values()])}
    assert refusals == {""}
