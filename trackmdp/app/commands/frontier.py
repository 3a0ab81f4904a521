"""`frontier`: accuracy against sensors per step over all prices of a sensor."""

from __future__ import annotations

from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console

from trackmdp.config import FrontierConfig
from trackmdp.durable import csv_text, own_folder, write_bytes, write_json, write_text
from trackmdp.policies.saved import sets_name, write_sets
from trackmdp.solvers.frontier import trace
from trackmdp.solvers.tradeoff import Corner, Mixture, Tradeoff
from trackmdp.training.display import make_console, reporting, table
from trackmdp.world.problem import Problem

_MOST_ROWS = 20
"""Corners shown at the terminal; the files have all."""


def run(cfg: FrontierConfig, folder: Path, world: Problem) -> None:
    """Write `frontier.csv`, `frontier.json` and the sets of each corner to `folder`.

    Where matplotlib is installed, also a figure, `frontier.svg` and `frontier.png`.

    Ctrl-C ends the search early: the corners found so far are printed and saved.

    Raises:
        UserError: no policy has the accuracy asked for; the files are written by then.
    """
    console = make_console(cfg.quiet)
    with reporting(console, f"frontier {cfg.solver.name}") as show:
        found = trace(world, cfg.solver, cfg.resolution, show)
    rows = [_row(number, corner, found) for number, corner in enumerate(found.corners)]
    write_corners(folder / "corners", found)
    write_text(folder / "frontier.csv", csv_text(rows[0], (row.values() for row in rows)))
    write_json(folder / "frontier.json", _report(cfg, found, rows, {}))
    _show(console, found, folder)
    if found.interrupted:
        raise KeyboardInterrupt
    asked = ("accuracy", "sensors")
    given = {name: value for name in asked if (value := getattr(cfg, name)) is not None}
    answers = {name: found.at(**{name: value}) for name, value in given.items()}
    write_json(folder / "frontier.json", _report(cfg, found, rows, answers))
    _draw(folder, found, answers)
    for name, mixture in answers.items():
        show_mixture(console, f"{name}={given[name]:g}", mixture, found)


def write_corners(folder: Path, found: Tradeoff) -> None:
    """Write the sets of each corner to `folder`/NUMBER, in place of those of an earlier frontier."""
    own_folder(folder)
    for earlier in folder.glob("[0-9]*/sets.*"):
        earlier.unlink()
        with suppress(OSError):  # there is something else in it
            earlier.parent.rmdir()
    for number, corner in enumerate(found.corners):
        own_folder(place := folder / f"{number}")
        write_sets(place, corner.table)


def _draw(folder: Path, found: Tradeoff, answers: dict[str, Mixture]) -> None:
    """Write `frontier.svg` and `frontier.png`, where matplotlib is installed."""
    if find_spec("matplotlib") is None:
        return
    from trackmdp.reports.tradeoffs import tradeoff_figure

    figure = tradeoff_figure(found, answers)
    write_bytes(folder / "frontier.svg", figure.svg)
    write_bytes(folder / "frontier.png", figure.png)


def _row(number: int, corner: Corner, found: Tradeoff) -> dict[str, Any]:
    """A corner as a row of the files."""
    return {
        "corner": number,
        "price": corner.price,
        **_position(corner, found),
        "safe_per_episode": corner.evaluation.safe_per_episode,
        "aihtr": corner.lower,
        "aihtr_upper": corner.upper,
        "certified": corner.certified,
        # Of the edge to the next corner; the last one has none.
        "gap_to_next": found.gaps[number] if number < len(found.gaps) else None,
    }


def _position(each: Corner | Mixture, found: Tradeoff) -> dict[str, float]:
    """Place of a corner or mixture, and the bound above it."""
    return {
        "sensors_per_step": each.sensors,
        "accuracy": each.accuracy,
        "net_accuracy": each.net,
        "net_bound": max(each.net, found.bound(each.sensors)),
    }


def _report(
    cfg: FrontierConfig,
    found: Tradeoff,
    rows: list[dict[str, Any]],
    answers: dict[str, Mixture],
) -> dict[str, Any]:
    own = ("certified", "interrupted", "gap", "resolution", "seconds", "reward", "safe_cost")
    return {
        "solver": cfg.solver.name,
        **{name: getattr(found, name) for name in own},
        "steps_in_grid": found.steps,
        "equal_prices": found.equal_prices,
        "prices_solved": len(found.slopes),
        "corners": rows,
        "answers": {name: mixture_report(mixture, found) for name, mixture in answers.items()},
    }


def mixture_report(mixture: Mixture, found: Tradeoff) -> dict[str, Any]:
    """A mixture as the files have it."""
    parts = [
        {
            "corner": found.corners.index(corner),
            "probability": weight,
            "price": corner.price,
            "sensors_per_step": corner.sensors,
        }
        for weight, corner in mixture.parts
    ]
    return {**_position(mixture, found), "parts": parts}


def _figures(each: Corner | Mixture, found: Tradeoff) -> list[str]:
    """Cells of corners and mixtures; net is the accuracy itself where D = 0."""
    shown = [f"{each.sensors:.4f}", f"{100 * each.accuracy:.2f} %"]
    return [*shown, f"{each.net:.4f}"] if found.safe_cost else shown


def _heads(found: Tradeoff) -> list[str]:
    sensors = "sensors per step" if found.equal_prices else "sensors by price"
    return [sensors, "accuracy", *(["net"] if found.safe_cost else [])]


def _show(console: Console, found: Tradeoff, folder: Path) -> None:
    """The corners, as many as a screen has room for, and the proof."""
    count = len(found.corners)
    some = min(count, _MOST_ROWS)
    rows = []
    for place in range(some):
        number = round(place * (count - 1) / max(some - 1, 1))
        corner = found.corners[number]
        proof = "yes" if corner.certified else f"< {corner.upper:,.3f}"
        price, aihtr = f"{corner.price:.5g}", f"{corner.lower:,.3f}"
        rows.append([f"{number}", price, *_figures(corner, found), aihtr, proof])
    heads = ["corner", "price", *_heads(found), "AIHTR", "certified"]
    more = "" if some == count else f" ({some} of {count} corners; all in frontier.csv)"
    console.print(table(f"accuracy against sensors per step{more}", heads, rows))
    if found.safe_cost:
        console.print(
            f"net = accuracy - {found.safe_cost / found.reward:.6g} (D/r) for each safe action, per step: D stays "
            "the same and is paid, so that net is best, not accuracy alone (cost.safe=0 leaves D out)"
        )
    if not found.equal_prices:
        console.print("sensors by price: each counts as its price over the mean price")
    ended = "certified" if found.certified else "interrupted" if found.interrupted else "not closed"
    console.print(
        f"{ended}: no policy is more than {found.gap:.2g} above the corners and their edges; "
        f"{len(found.slopes)} prices, {found.seconds:.1f} s; results in {folder}, sets in "
        f"corners/NUMBER/{sets_name(found.corners[0].table)}"
    )


def show_mixture(console: Console, asked: str, mixture: Mixture, found: Tradeoff) -> None:
    """The corners of a mixture with their probabilities, and the mixture itself."""
    rows = [
        [f"corner {found.corners.index(corner)}", f"{weight:.4f}", *_figures(corner, found)]
        for weight, corner in mixture.parts
    ]
    title = f"{asked}: one policy is enough"
    if len(rows) > 1:
        rows.append(["mixture", "1.0000", *_figures(mixture, found)])
        title = f"{asked}: a policy is drawn at the start of each episode"
    console.print(table(title, ["policy", "probability", *_heads(found)], rows))
