"""Which runs a line asks for, and what their folders are called."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import DictConfig

from trackmdp.app.composer import register
from trackmdp.app.sweep.plan import combinations, plan, sweep_name
from trackmdp.app.words import run_words
from trackmdp.config import conf_dir
from trackmdp.errors import UserError


def planned(
    blocks: Sequence[str], *typed: str, sweep: Path = Path("none"), more: Sequence[str] = ()
) -> list[str]:
    """Folder names of a sweep; `more` stands for what an experiment sets."""

    def composed(words: Sequence[str]) -> DictConfig:
        return compose("train", overrides=[*more, *words])

    register()
    with initialize_config_dir(config_dir=conf_dir(), version_base="1.3"):
        return [job.name for job in plan("train", sweep, composed, combinations(blocks, typed))]


def test_every_combination_in_the_order_typed() -> None:
    assert combinations([], ["seed=range(2)", "cost.sensor=0.16,0.2", "algo=ppo"]) == [
        ["seed=0", "cost.sensor=0.16", "algo=ppo"],
        ["seed=0", "cost.sensor=0.2", "algo=ppo"],
        ["seed=1", "cost.sensor=0.16", "algo=ppo"],
        ["seed=1", "cost.sensor=0.2", "algo=ppo"],
    ]


def test_blocks_are_united_and_typed_words_win() -> None:
    blocks = ["algo=a2c,ppo seed=0,1", "algo=dqn seed=0"]
    assert combinations(blocks, []) == [
        ["algo=a2c", "seed=0"],
        ["algo=a2c", "seed=1"],
        ["algo=ppo", "seed=0"],
        ["algo=ppo", "seed=1"],
        ["algo=dqn", "seed=0"],
    ]
    assert combinations(blocks, ["seed=7", "grid.size=5"]) == [
        ["algo=a2c", "seed=7", "grid.size=5"],
        ["algo=ppo", "seed=7", "grid.size=5"],
        ["algo=dqn", "seed=7", "grid.size=5"],
    ]


def test_a_value_with_commas_in_quotes_or_brackets_is_one_value() -> None:
    assert combinations([], ["kernel.path='a,b.npy'"]) == [["kernel.path='a,b.npy'"]]
    assert len(combinations([], ["cost.sensor=[1,2,3],[4,5,6]"])) == 2


@pytest.mark.parametrize(
    ("blocks", "words", "message"),
    [
        ([], ["seed"], "seed: expected option=value"),
        (["seed=1 algo"], [], "algo: expected option=value"),
        ([], ["seed=interval(0,3)"], r"seed=interval\(0,3\): expected values that can be counted"),
        ([], ["experiment=a,b"], "experiment=a,b: expected one experiment"),
        ([], ["seed=range(3,0)"], r"seed=range\(3,0\): expected 1 to 100,000 values"),
    ],
)
def test_words_that_make_no_grid(blocks: list[str], words: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        combinations(blocks, words)


def test_words_to_hydra_are_no_part_of_a_run() -> None:
    assert run_words(["seed=1", "hydra.sweep.dir=x", "hydra/launcher=joblib", "+hydra.x=1"]) == [
        "seed=1"
    ]


def test_folders_say_what_tells_the_runs_apart() -> None:
    names = planned([], "grid.size=5", "kernel.seed=1,2", "seed=0", "algo=ppo,dqn")
    assert [name.rpartition("-")[0] for name in names] == [
        "seed_1-algo_ppo",
        "seed_1-algo_dqn",
        "seed_2-algo_ppo",
        "seed_2-algo_dqn",
    ]
    assert planned([], "kernel.seed=1,2", "seed=0,1")[0].startswith("kernel.seed_1-seed_0-")
    assert len(set(names)) == 4


def test_the_same_run_asked_for_twice_is_one() -> None:
    assert len(planned(["seed=0,1", "seed=1,2"])) == 3


def test_a_run_is_found_again_whatever_else_the_line_asks_for(tmp_path: Path) -> None:
    alone = planned([], "seed=3", "algo=ppo")[0]
    (tmp_path / alone).mkdir()
    names = planned([], "algo=ppo", "seed=3,4", sweep=tmp_path)
    assert names[0] == alone
    assert names[1].startswith("seed_4-")


@pytest.mark.slow
def test_a_config_that_changed_behind_the_words_is_another_run() -> None:
    words = ["seed=0,1"]
    assert planned([], *words, more=["grid.size=5"]) != planned([], *words, more=["grid.size=6"])
    same = ["evaluation.every=3", "collector.total_frames=500000", "quiet=true", "device=auto"]
    assert planned([], *words, more=same) == planned([], *words)
    assert planned([], *words, "evaluation.every=3") != planned([], *words)


@given(st.permutations(["seed=0,1", "algo=ppo,dqn", "grid.size=5", "quiet=true"]))
def test_the_sweep_has_the_same_folder_in_whatever_order_it_is_typed(words: list[str]) -> None:
    name = sweep_name("train", words, [])
    assert name == sweep_name("train", ["algo=ppo,dqn", "seed=0,1", "grid.size=5"], [])
    assert name != sweep_name("evaluate", words, [])
    assert name != sweep_name("train", words, ["seed=3"])
    assert name.rpartition("-")[0] == "train-algo_ppo_dqn-seed_0_1-size_5"


def test_a_run_cannot_be_told_to_go_on_elsewhere() -> None:
    register()
    with initialize_config_dir(config_dir=conf_dir(), version_base="1.3"):
        jobs = plan(
            "train",
            Path("none"),
            lambda words: compose("train", overrides=list(words)),
            [["resume=runs/a"]],
        )
    assert jobs[0].cfg is None
    assert jobs[0].refusal.startswith(
        f"resume={Path.cwd() / 'runs/a'}: expected null or auto in a sweep"
    )


def test_a_file_with_another_content_makes_other_runs(tmp_path: Path) -> None:
    file = tmp_path / "motion.csv"
    words = ("kernel=table", f"kernel.path={file}", "grid.size=1", "seed=0,1")
    missing = planned([], *words)
    file.write_text("0.5")
    first = planned([], *words)
    file.write_text("0.75")
    other = planned([], *words)
    file.write_text("0.5")
    assert planned([], *words) == first
    assert len({*missing, *first, *other}) == 6
    assert {name.rpartition("-")[0] for name in other} == {"seed_0", "seed_1"}
