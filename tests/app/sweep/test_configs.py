"""Many configs from one: the same as Hydra's own, composed once for runs that differ in numbers alone."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig
from rich.console import Console

from trackmdp.app.composer import Composer
from trackmdp.app.sweep.plan import Configs, combinations, plan
from trackmdp.config import ROOTS
from trackmdp.config.compose import composed_values, config_of
from trackmdp.errors import UserError


def typed_config(composed: Any) -> Any:
    return config_of(composed_values(composed, ROOTS["train"]), ROOTS["train"])


class Counting:
    """A composer that counts its calls."""

    def __init__(self, compose: Composer) -> None:
        self._compose, self.calls = compose, 0

    def __call__(self, words: Sequence[str]) -> DictConfig:
        self.calls += 1
        return self._compose(words)


@pytest.fixture(scope="module")
def composer() -> Iterator[Composer]:
    with Composer("train") as compose:
        yield compose


@pytest.mark.parametrize(
    ("words", "calls"),
    [
        ("seed=range(3)", 1),
        ("seed=0,1 cost.sensor=0.1,1", 1),
        ("algo=ppo,a2c algo.gamma=0.9,0.95", 2),
        ("log=[csv] log.csv.every=1,2", 1),
        ("optimal.enabled=true,false", 1),
        ("algo.total_frames=20000,40000", 1),  # those of the collector follow
        ("kernel.support_size=3,4", 1),  # the kernel's seed follows
        ("grid.size=3,[3,4]", 2),
        ("cost.safe=3,null,4", 2),
        ("kernel=drift,random_walk seed=0,1", 2),
    ],
)
def test_every_config_is_the_one_that_hydra_composes(
    words: str, calls: int, composer: Composer
) -> None:
    compose = Counting(composer)
    configs = Configs("train", compose)
    for line in combinations([], words.split()):
        expected = typed_config(composer(line))
        assert configs(line) == (expected, "")
    assert compose.calls == calls


@pytest.mark.parametrize("bad", ["seed=-1", "seed=1.5", "cost.sensor=-0.1"])
def test_a_number_out_of_range_is_refused_as_hydra_refuses_it(bad: str, composer: Composer) -> None:
    configs = Configs("train", composer)
    key = bad.partition("=")[0]
    assert configs([f"{key}=1"])[1] == ""
    refusals: list[Any] = []
    for refuse in (configs, lambda words: typed_config(composer(words))):
        try:
            refusals.append(refuse([bad])[1])  # type: ignore[operator]
        except UserError as error:
            refusals.append(str(error))
    assert refusals[0] == refusals[1]
    assert key in refusals[0]


def test_an_option_without_effect_is_refused_in_every_run(composer: Composer) -> None:
    configs = Configs("train", composer)
    lines = combinations(
        [], ["algo=dqn", "algo.prioritized.enabled=false", "algo.prioritized.alpha=0.5,0.6"]
    )
    refusals = [configs(line)[1] for line in lines]
    assert all("algo.prioritized.alpha" in refusal for refusal in refusals)


def test_progress_is_shown_where_runs_are_many(composer: Composer, tmp_path: Path) -> None:
    for count, shown in ((20, False), (200, True)):
        console = Console(file=io.StringIO(), force_terminal=True)
        grid = [[f"seed={seed}"] for seed in range(count)]
        assert len(plan("train", tmp_path, composer, grid, console=console)) == count
        assert ("runs planned" in console.file.getvalue()) == shown  # type: ignore[attr-defined]
