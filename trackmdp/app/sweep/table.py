"""Results of a sweep: a table at the terminal, and `runs.csv`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from trackmdp.app.prepare import shown
from trackmdp.durable import csv_text, write_text
from trackmdp.errors import FAILED, USER_MISTAKE
from trackmdp.training.display import table
from trackmdp.training.folders import FAILED_FILE, RunState
from trackmdp.untrusted import known_object, no_formula

TABLE = "runs.csv"

_FIGURES = ("aihtr", "regret_per_step", "accuracy", "sensors_per_step", "frames")


def show_runs(console: Console, runs: Sequence[RunState], skipped: Collection[Path], sweep: Path) -> None:
    """Every run with its state, AIHTR and regret per step, or why it failed."""
    # Without the digest, where the readable part is enough to tell the runs apart.
    names = [run.folder.name.rpartition("-")[0] for run in runs]
    if len(set(names)) < len(names):
        names = [run.folder.name for run in runs]
    rows = [[name, _state(run, skipped), *_short(run), run.reason] for name, run in zip(names, runs, strict=True)]
    made = table(f"{len(runs)} runs", ["run", "state", "AIHTR", "regret per step", "reason"], rows)
    made.columns[1].justify = made.columns[4].justify = "left"
    console.print(made)
    states = [_state(run, skipped) for run in runs]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    # `markup=False`: a folder named "[red]" is a name, not an order to rich.
    console.print(f"{counts}; {shown(sweep) / TABLE}")


def write_table(sweep: Path, runs: Sequence[RunState]) -> None:
    """Write `runs.csv`: folder, state, figures, reason, and one column for every option that was overridden.

    Nothing in it depends on time, or on how often a run was interrupted.
    """
    words = [{word.partition("=")[0]: word.partition("=")[2] for word in run.overrides} for run in runs]
    # The union in order of appearance: runs of different blocks may have different options.
    keys = [key for key in dict.fromkeys(key for pairs in words for key in pairs) if key != "quiet"]
    rows = []
    for run, pairs in zip(runs, words, strict=True):
        found = run_figures(run)
        row = [_cell(run.folder.name), run.state, *(found.get(name) for name in _FIGURES), _cell(run.reason)]
        rows.append([*row, *(_cell(pairs.get(key)) for key in keys)])
    write_text(sweep / TABLE, csv_text(["folder", "state", *_FIGURES, "reason", *keys], rows))


def _cell(text: str | None) -> str | None:
    """Numbers as they are, also negative ones; a text that would be a formula is kept from being one."""
    if text is None:
        return None
    try:
        float(text)
    except ValueError:
        return no_formula(text)
    return text


def status_of(runs: Sequence[RunState]) -> int:
    """The exit status: 0 if all is done, 2 if only mistakes of the user failed, else 1."""
    if all(run.state == "done" for run in runs):
        return 0
    statuses = [known_object(run.folder / FAILED_FILE).get("status") for run in runs if run.state == "failed"]
    # A run that is neither done nor failed is nobody's mistake, and 2 would tell a script not to try again.
    unfinished = any(run.state not in ("done", "failed") for run in runs)
    return FAILED if unfinished or any(status != USER_MISTAKE for status in statuses) else USER_MISTAKE


def _state(run: RunState, skipped: Collection[Path]) -> str:
    return "skipped" if run.folder in skipped and run.state == "done" else run.state


def run_scores(run: RunState) -> dict[str, Any]:
    """The figures to choose between runs by: of recorded tracks those on the validation tracks, else all there are."""
    return {**run_figures(run), **(run.result.get("validation") or {})}


def run_figures(run: RunState) -> dict[str, Any]:
    """The figures of a training run; of another command's the one value that it returns."""
    if "policy" not in run.result:
        return {"aihtr": run.result.get("value")}
    return {**run.result["policy"], **{name: run.result.get(name) for name in ("regret_per_step", "frames")}}


def _short(run: RunState) -> list[str]:
    found = run_figures(run)
    aihtr, regret = found.get("aihtr"), found.get("regret_per_step")
    # Adding 0.0 turns the -0.0 that rounding leaves into 0.0.
    return [f"{aihtr:,.3f}" if aihtr is not None else "", f"{round(regret, 4) + 0.0:.4f}" if regret is not None else ""]
