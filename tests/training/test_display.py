"""What is shown while a run goes on."""

from __future__ import annotations

import io
import re
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from trackmdp.config.counting import ModelBasedConfig
from trackmdp.config.learning import AlgoConfig
from trackmdp.training.callbacks import Position
from trackmdp.training.display import Display


def shown(
    width: int,
    *,
    terminal: bool,
    frames: int = 1_000_000,
    aihtr: float = -2985.0,
    done: int = 10,
    **algo: bool,
) -> list[str]:
    """The lines that are printed for a run of so many frames, collected in 4 s."""
    out = io.StringIO()
    console = Console(
        width=width, file=out, force_terminal=terminal, color_system=None, soft_wrap=not terminal
    )
    trainer: Any = SimpleNamespace(
        position=Position(),
        iterations=10,
        evaluator=SimpleNamespace(upper=117.25),
        collecting=0.0,
        config=SimpleNamespace(algo=SimpleNamespace(**{"plans_at_end": False} | algo)),
    )
    display = Display(console, "hindsight seed 12")
    display.on_start(trainer)
    trainer.score = SimpleNamespace(evaluation=SimpleNamespace(aihtr=aihtr))
    trainer.position, trainer.collecting = (
        Position(iteration=done, frames=frames, seconds=50.0),
        4.0,
    )
    display.on_update(trainer, {})
    display.on_end(trainer)
    return re.split(r"\r?\n|\r|\x1b\[2K|\x1b\[1A", out.getvalue())


def test_at_80_columns_the_progress_takes_one_line() -> None:
    lines = shown(80, terminal=True)
    last = next(line for line in reversed(lines) if line.startswith("hindsight"))
    # cut or wrapped it would lack one of these
    assert "1,000,000 frames AIHTR -2,985.00 gap 3,102.25 left 0:00:00" in last
    assert len(last) <= 80


@pytest.mark.parametrize("terminal", [True, False])
def test_frames_per_second_are_those_of_collecting(terminal: bool) -> None:
    # 1,000,000 frames in 4 s of collecting, whatever the 50 s of the run were spent on
    assert any(
        "1,000,000 frames 250,000/s AIHTR -2,985.00" in line
        for line in shown(160, terminal=terminal)
    )


@pytest.mark.parametrize("plans", [True, False])
def test_before_a_plan_at_the_end_the_time_left_is_the_least(plans: bool) -> None:
    def last(**given: Any) -> str:
        lines = shown(160, plans_at_end=plans, **given)
        return next(line for line in reversed(lines) if line.startswith("hindsight"))

    assert last(terminal=False, done=1).endswith("  at least 0 s left" if plans else "  0 s left")
    assert last(terminal=False, done=10).endswith("3,102.25  0 s left")
    assert ("left > 0:00:00" if plans else "left 0:00:00") in last(terminal=True)
    assert AlgoConfig.plans_at_end < ModelBasedConfig.plans_at_end


def test_a_run_that_collects_no_more_has_no_speed() -> None:
    """As one resumed while it learns from its buffer alone."""
    assert any("0 frames AIHTR -2,985.00" in line for line in shown(160, terminal=False, frames=0))


def test_a_value_at_the_bound_has_no_gap_below_zero() -> None:
    # the solver's rounding may lie on either side of the bound
    lines = shown(160, terminal=False, aihtr=117.25 + 1e-12)
    assert any("AIHTR 117.25 gap 0.00" in line for line in lines)
