"""`report`: figures, tables and a web page of a sweep."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.text import Text

from trackmdp.config import ReportConfig
from trackmdp.durable import write_bytes, write_text
from trackmdp.errors import require
from trackmdp.notebook.card import counted_words
from trackmdp.paper.calibration import compute, load_openings, save_openings
from trackmdp.paper.sections import sections
from trackmdp.paper.worlds import PRINTED_QMDP, pairs
from trackmdp.reports import style, watch
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import study
from trackmdp.reports.page import Report, Section, build
from trackmdp.reports.results import Results, is_stored, load_results, save_results
from trackmdp.training.display import make_console
from trackmdp.training.lock import locked
from trackmdp.untrusted import printable

_WAIT = 600.0
"""Seconds that a report waits for another one in its folder."""


def run(cfg: ReportConfig, folder: Path) -> None:
    """Write the report to `folder`, or watch the sweep.

    Raises:
        UserError: there is no sweep to report on, or matplotlib is not installed.
    """
    sweep, console = Path(cfg.sweep), make_console(cfg.quiet)
    if cfg.watch:
        watch.watch(sweep, console, cfg.every)
        return
    require("matplotlib", "report", "report")
    # Its files belong together: of several reports at once in one folder, each waits for its turn.
    with locked(folder, wait=_WAIT), console.status("reading runs") as status:

        def say(line: str) -> None:
            # `Text`: a label may hold square brackets, which rich would take for markup.
            status.update(Text(printable(line)))

        found = load_results(sweep) if is_stored(sweep) else gather_runs(sweep)
        # Stored and read back: the same page can be made again from the stored results alone.
        save_results(found, folder)
        found = load_results(folder)
        _write(
            build(found, cfg.threshold, _about_the_paper(cfg, sweep, found, folder, say), say),
            folder,
        )
    _tell(console, found, folder)


def _about_the_paper(
    cfg: ReportConfig, sweep: Path, found: Results, folder: Path, say: style.Say
) -> list[Section]:
    """The sections on the paper where they are asked for, made from stored figures or computed now."""
    grouped = study(found.runs)
    # A sweep of one's own may touch some of the paper's worlds; all twelve of them are its experiments.
    asked = len(pairs(grouped)) == len(PRINTED_QMDP) if cfg.paper is None else cfg.paper
    if not asked:
        return []
    known = (load_openings(sweep) if is_stored(sweep) else None) or compute(say)
    save_openings(known, folder)
    return sections(grouped, known)


def _write(report: Report, folder: Path) -> None:
    for name in ("figures", "tables"):
        (folder / name).mkdir(exist_ok=True)
    for figure in report.figures:
        file = folder / "figures" / figure.table.name
        write_bytes(file.with_suffix(".svg"), figure.svg)
        write_bytes(file.with_suffix(".png"), figure.png)
        write_text(file.with_suffix(".csv"), figure.table.csv())
    for table in report.tables:
        write_text(folder / "tables" / f"{table.name}.csv", table.csv())
        write_text(folder / "tables" / f"{table.name}.tex", table.latex())
    write_text(folder / "report.html", report.html())


def _tell(console: Console, found: Results, folder: Path) -> None:
    if found.anomalies:
        first = found.anomalies[0]
        more = f", the first of {len(found.anomalies)}" if len(found.anomalies) > 1 else ""
        console.print(f"missing or mixed{more}: {first.run}: {first.text}")
    console.print(f"{counted_words(len(found.runs), 'run')}; report in {folder / 'report.html'}")
