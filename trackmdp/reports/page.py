"""A report: figures and tables made from stored results, and the page that shows them."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from trackmdp.paper import critique, settings, verdicts
from trackmdp.paper.calibration import DRAWS
from trackmdp.paper.openings import Openings
from trackmdp.paper.printed import pairs
from trackmdp.reports import figures, learning, maps
from trackmdp.reports.grouping import Study, study
from trackmdp.reports.results import Results
from trackmdp.reports.style import Figure
from trackmdp.reports.tables import Table

__all__ = ["Report", "build"]

MAPPED = 4
"""Policies that are drawn on the page."""


@dataclass
class Report:
    """All that is written; the page is put together from `sections`."""

    title: str
    about: str
    figures: list[Figure] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    sections: list[tuple[str, str, str]] = field(default_factory=list)

    def section(self, anchor: str, heading: str, *parts: str | Figure | Table | Sequence[Figure]) -> None:
        """Add a section of text, figures and tables."""
        shown = []
        for part in parts:
            if isinstance(part, str):
                shown.append(part)
            elif isinstance(part, Table):
                self.tables.append(part)
                shown.append(part.html())
            else:
                each = [part] if isinstance(part, Figure) else list(part)
                self.figures += each
                kind = "figures" if len(each) % 3 == 0 else "figures two"
                shown.append(f'<div class="{kind}">{"".join(figure.html() for figure in each)}</div>')
        self.sections.append((anchor, heading, "\n".join(shown)))

    def html(self) -> str:
        """The page."""
        template = files("trackmdp.reports").joinpath("report.html").read_text(encoding="utf-8")
        nav = "".join(
            f'<li><a href="#{anchor}">{html.escape(heading)}</a></li>' for anchor, heading, _ in self.sections
        )
        body = "\n".join(
            f'<section id="{anchor}"><h2>{html.escape(heading)}</h2>{content}</section>'
            for anchor, heading, content in self.sections
        )
        parts = {"@TITLE@": html.escape(self.title), "@ABOUT@": self.about, "@NAV@": nav, "@BODY@": body}
        for mark, text in parts.items():
            template = template.replace(mark, text)
        return template


def build(
    results: Results, openings: Openings | None, resamples: int, say: Callable[[str], None] = lambda line: None
) -> Report:
    """The report of stored results.

    Args:
        results: of the sweep.
        openings: what the paper leaves open, for a sweep in the paper's worlds.
        resamples: of every bootstrap.
        say: told what is under way.
    """
    grouped = study(results.runs)
    report = Report("The paper's sweep" if openings else "A sweep of trackmdp", _about(results))
    chosen = pairs(grouped) if openings else {}
    if not results.runs:
        report.section("missing", "What is missing", verdicts.missing_table(results.problems))
        return report
    say("figures")
    _outcome(report, results, grouped, chosen, resamples)
    _against_cost(report, grouped, chosen, resamples)
    if chosen:
        report.section("accuracy", "Table II: accuracy", verdicts.accuracy_table(grouped, chosen, resamples))
    _learning(report, results, grouped, resamples)
    _maps(report, results, grouped, chosen)
    if openings:
        _openings(report, grouped, chosen, openings)
    groups, runs = verdicts.groups_table(grouped, resamples), verdicts.runs_table(grouped)
    folded = [_folded("By world and method", groups, report), _folded("Every run", runs, report)]
    report.section("runs", "All runs", *folded)
    report.section("made", "How it was made", _made(results.manifest, resamples))
    return report


def _about(results: Results) -> str:
    manifest = results.manifest
    machines = manifest.get("machines") or []
    where = "; ".join(f"{m.get('processor', '?')}, {m.get('cores', '?')} cores" for m in machines)
    hours = float(manifest.get("wall_seconds", 0)) / 3600
    planned = manifest.get("planned")
    count = f"{len(results.runs)} of {planned} planned runs" if planned else f"{len(results.runs)} runs"
    took = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.1f} minutes"
    return html.escape(f"{count}, {took} of run time in all{', on ' + where if where else ''}.")


def _outcome(
    report: Report, results: Results, grouped: Study, chosen: dict[tuple[int, float], str], resamples: int
) -> None:
    parts: list[Any] = []
    if chosen:
        parts.append(_goals(verdicts.goals(grouped, chosen, resamples)))
        parts.append(verdicts.acceptance_table(grouped, chosen, resamples))
    report.section("outcome", "Outcome", *parts, verdicts.methods_table(grouped, resamples))
    if results.problems:
        note = '<p class="warn">Not all is as planned; the rest is shown.</p>'
        report.section("missing", "What is missing", note, verdicts.missing_table(results.problems))


def _goals(goals: Sequence[verdicts.Goal]) -> str:
    items = []
    for goal in goals:
        state = "met" if goal.pairs and goal.met == goal.pairs else "open"
        rest = f"Every single seed: in {goal.by_all}." if goal.pairs else "There is no run to judge by."
        listed = goal.missed if len(goal.missed) < goal.pairs else ()
        missed = f" Not in {html.escape('; '.join(listed))}." if listed else ""
        items.append(
            f'<li class="{state}"><b>{goal.met} of {goal.pairs}</b><span>pairs: {html.escape(goal.text)}</span>'
            f'<span class="faint">{rest}{missed}</span></li>'
        )
    return f'<ul class="goals">{"".join(items)}</ul>'


def _against_cost(report: Report, grouped: Study, chosen: dict[tuple[int, float], str], resamples: int) -> None:
    found = figures.panels(grouped, chosen)
    if not found:
        return
    heading = "Figures 3 to 5: AIHTR" if chosen else "Against the price of a sensor"
    note = (
        "<p>Learned policies: interquartile mean over seeds, bars are 95 % bootstrap intervals over seeds. Q_MDP, the "
        "bounds and the optimum are exact. Below, the distance to the proved upper bound tells the best apart.</p>"
    )
    above = [figures.against_cost(grouped, panel, resamples) for panel in found]
    bounded = [panel for panel in found if not any(math.isnan(grouped.upper(world)) for world in panel.worlds)]
    below = [figures.regret_against_cost(grouped, panel, resamples) for panel in bounded]
    report.section("figures", heading, note, above, below)


def _learning(report: Report, results: Results, grouped: Study, resamples: int) -> None:
    drawn = [learning.curves(grouped, results.curves, by, resamples) for by in ("frames", "seconds")]
    shown = [figure for figure in (*drawn, learning.profiles(grouped, resamples)) if figure]
    if shown:
        report.section("learning", "Learning curves and profiles", shown)


def _maps(report: Report, results: Results, grouped: Study, chosen: dict[tuple[int, float], str]) -> None:
    """Policies and values in the first and the last world, of at most two methods."""
    worlds = list(chosen.values()) or list(grouped.worlds)
    methods = [method for method in (verdicts.DEFAULT, verdicts.PAPERS) if method in grouped.methods]
    sets, values = list[Figure | None](), list[Figure | None]()
    for world in dict.fromkeys((worlds[-1], worlds[0])):
        motion = next((results.motions[r.name] for r in grouped.in_world(world) if r.name in results.motions), None)
        for method in methods or grouped.methods[:2]:
            run = next((run for run in grouped.of(world, method) if run.name in results.policies), None)
            if run is None or motion is None or len(sets) >= MAPPED:
                continue
            name = figures.slug(f"{method}-{world}")
            where = f"{method}, {world}, seed {run.seed} (n = 1)"
            sets.append(maps.policy_map(name, where, results.policies[run.name], motion))
            values.append(maps.value_map(name, where, results.policies[run.name], motion))
    shown = [[figure for figure in group if figure is not None] for group in (values, sets)]
    if any(shown):
        note = (
            "<p>Dot: where the target was located. Filled: sensor on. Pale: possible cell left out. "
            "Contrasting: sensor on where the target cannot be. The run is the one in the middle of its seeds.</p>"
        )
        report.section("maps", "Policies and values, cell by cell", shown[0], note, shown[1])


def _openings(report: Report, grouped: Study, chosen: dict[tuple[int, float], str], openings: Openings) -> None:
    best = settings.fit_table(openings.settings)
    border, t_max, *_, worst = best.rows[0]
    note = (
        f"<p>Nothing in the paper tells the settings apart but the printed accuracy of Q_MDP. Of those tried, border "
        f"{border} with T_max = {t_max} fits it best (within {worst:.2f} points for every Z, with {len(DRAWS)} draws "
        "only); the sweep keeps T_max = 1 and renormalize, this project's defaults.</p>"
    )
    report.section(
        "worlds",
        "The worlds, calibrated",
        f"<p>{html.escape(settings.RULE)}</p>",
        settings.calibration_figure(openings.candidates),
        note,
        best,
        settings.sensitivity_figures(openings.settings),
    )
    report.tables += [settings.candidates_table(openings.candidates), settings.sensitivity_table(openings.settings)]
    said = critique.points(grouped, chosen, openings.checks)
    text = "".join(f"<h3>{html.escape(head)}</h3><p>{html.escape(body)}</p>" for head, body in said)
    report.section(
        "critique",
        "Where the paper is silent or wrong",
        text,
        critique.bounds_table(grouped, chosen),
        critique.checks_table(openings.checks),
    )


def _folded(summary: str, table: Table, report: Report) -> str:
    report.tables.append(table)
    return f"<details><summary>{html.escape(summary)}</summary>{table.html()}</details>"


def _made(manifest: Any, resamples: int) -> str:
    facts = {"Command": manifest.get("line") or "not recorded"}
    for entry in manifest.get("versions", []):
        text = ", ".join(f"{name} {version}" for name, version in entry.items() if name != "runs")
        facts[f"Versions, {entry['runs']} runs"] = text
    for entry in manifest.get("machines", []):
        text = ", ".join(f"{name} {value}" for name, value in entry.items() if name != "runs" and value is not None)
        facts[f"Machine, {entry['runs']} runs"] = text
    seconds = [f"{manifest.get(key, 0):,.0f} s {key.split('_')[0]}" for key in ("wall_seconds", "cpu_seconds")]
    facts["Run time"] = ", ".join(seconds)
    facts["Intervals"] = f"95 %, bootstrap over seeds within each world, {resamples:,} resamples, seeded"
    items = "".join(f"<div><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>" for k, v in facts.items())
    return f'<dl class="facts">{items}</dl><p class="faint">Numbers in full: the CSV files beside this page.</p>'
