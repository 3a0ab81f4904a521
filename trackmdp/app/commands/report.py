"""`report`: figures, tables and a web page of a sweep."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from trackmdp.build import make_world
from trackmdp.config import ReportConfig
from trackmdp.durable import write_bytes, write_text
from trackmdp.paper import openings
from trackmdp.paper.openings import Openings
from trackmdp.paper.printed import pairs
from trackmdp.reports import results, style, watch
from trackmdp.reports.gather import gather
from trackmdp.reports.grouping import study
from trackmdp.reports.page import Report, build
from trackmdp.reports.results import Results
from trackmdp.training.display import make_console

__all__ = ["run"]


def run(cfg: ReportConfig, folder: Path) -> float:
    """Write the report to `folder`, or watch the sweep; returns the number of finished runs.

    Raises:
        UserError: there is no sweep to report on, or matplotlib is not installed.
    """
    sweep, console = Path(cfg.sweep), make_console(cfg.quiet)
    if cfg.watch:
        return float(watch.watch(sweep, console, cfg.every))
    style.require()
    with console.status("reading runs") as status:

        def say(line: str) -> None:
            status.update(line)

        found = results.load(sweep) if results.is_stored(sweep) else gather(sweep, make_world)
        known = _openings(cfg, sweep, found, say)
        _store(found, known, folder)
        report = build(results.load(folder), known, cfg.resamples, say)
        _write(report, folder)
    _tell(console, found, folder)
    return float(len(found.runs))


def _openings(cfg: ReportConfig, sweep: Path, found: Results, say: style.Say) -> Openings | None:
    """What the paper leaves open, where it is asked for: as stored, or computed."""
    wanted = bool(pairs(study(found.runs))) if cfg.paper is None else cfg.paper
    if not wanted:
        return None
    return (openings.load(sweep) if results.is_stored(sweep) else None) or openings.compute(say)


def _store(found: Results, known: Openings | None, folder: Path) -> None:
    """What the report can be made from again."""
    results.save(found, folder)
    if known is not None:
        openings.save(known, folder)


def _write(report: Report, folder: Path) -> None:
    for name in ("figures", "tables"):
        (folder / name).mkdir(exist_ok=True)
    for figure in report.figures:
        write_bytes(folder / "figures" / f"{figure.name}.svg", figure.svg)
        write_bytes(folder / "figures" / f"{figure.name}.png", figure.png)
        write_text(folder / "figures" / f"{figure.name}.csv", figure.table.csv())
    for table in report.tables:
        write_text(folder / "tables" / f"{table.name}.csv", table.csv())
        write_text(folder / "tables" / f"{table.name}.tex", table.latex())
    write_text(folder / "report.html", report.html())


def _tell(console: Console, found: Results, folder: Path) -> None:
    if found.problems:
        first = found.problems[0]
        more = f" and {len(found.problems) - 1} more" if len(found.problems) > 1 else ""
        console.print(f"missing or mixed: {first.run}: {first.text}{more}", markup=False)
    console.print(f"{len(found.runs)} runs; report in {folder / 'report.html'}", markup=False)
