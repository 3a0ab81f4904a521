"""A report: the figures and tables of stored results, and the HTML page with them."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, TypeAlias

from trackmdp.reports import figures, idea, maps, summaries
from trackmdp.reports.grouping import Study, study
from trackmdp.reports.results import MotionTable, Results, Sensed
from trackmdp.reports.style import Figure, Say
from trackmdp.reports.tables import Table, paragraphs
from trackmdp.untrusted import printable
from trackmdp.world.model import grid_size

PROSE = paragraphs("trackmdp.reports")
# All of them would be dozens of figures; the policies that are not drawn are in `policies.npz`.
MAPPED = 2
"""Methods and worlds whose policies are drawn on the page."""


Part: TypeAlias = "str | Table | Sequence[Figure]"


@dataclass(frozen=True)
class Section:
    """A heading with what stands under it.

    Attributes:
        anchor: its id on the page.
        heading: its title.
        parts: HTML, tables, and rows of figures.
        files: tables that are written but not shown.
    """

    anchor: str
    heading: str
    parts: Sequence[Part]
    files: Sequence[Table] = ()

    def html(self) -> str:
        """The section as part of the page."""
        body = "\n".join(map(_part, self.parts))
        return f'<section id="{self.anchor}"><h2>{html.escape(self.heading)}</h2>{body}</section>'


@dataclass(frozen=True)
class Report:
    """All that is written."""

    about: str
    sections: Sequence[Section]
    title: str = "A sweep of trackmdp"

    @property
    def figures(self) -> list[Figure]:
        """Every figure, in the order of the page."""
        parts = [part for section in self.sections for part in section.parts]
        return [figure for part in parts if not isinstance(part, (str, Table)) for figure in part]

    @property
    def tables(self) -> list[Table]:
        """Every table but those of the figures, in the order of the page."""
        parts = [part for section in self.sections for part in (*section.parts, *section.files)]
        return [part for part in parts if isinstance(part, Table)]

    def html(self) -> str:
        """The page."""
        # One file without anything loaded from elsewhere: it can be mailed, and opened without a network.
        page = files("trackmdp.reports").joinpath("report.html").read_text(encoding="utf-8")
        nav = "".join(f'<li><a href="#{s.anchor}">{html.escape(s.heading)}</a></li>' for s in self.sections)
        body = "\n".join(section.html() for section in self.sections)
        texts = {"@TITLE@": html.escape(self.title), "@ABOUT@": self.about, "@NAV@": nav, "@BODY@": body}
        # in one pass: what is put in may hold a mark itself, as a folder's name
        return printable(re.sub("|".join(texts), lambda mark: texts[mark[0]], page))


def build(
    results: Results, threshold: float | None = None, extra: Sequence[Section] = (), say: Say = lambda line: None
) -> Report:
    """The report of stored results.

    Args:
        results: of the sweep.
        threshold: regret per step up to which runs are counted; None for no count.
        extra: further sections, shown before the list of all runs.
        say: told what is under way.
    """
    missing = Section("missing", "What is missing", [summaries.missing_table(results.anomalies)])
    if not results.runs:
        return Report(_about(results), [missing])
    say("figures")
    grouped = study(results.runs)
    outcome: list[Part] = [summaries.methods_table(grouped, threshold)]
    # Said beside the first table: a method that was stopped early is easily taken for a weak one.
    if cut := summaries.shortened(grouped):
        said = html.escape("; ".join(cut))
        outcome.append(f"<p>Fewer env steps than the algorithm's own options give it: {said}.</p>")
    sections = [Section("outcome", "Outcome", outcome)]
    sections += [missing] if results.anomalies else []
    sections += _idea(results, grouped)
    sections += [*_against_cost(grouped, threshold), *_learning(results, grouped, threshold), *_maps(results, grouped)]
    by_group = replace(summaries.groups_table(grouped, threshold), folded="By world and method")
    runs = Section("runs", "All runs", [by_group, replace(summaries.runs_table(grouped), folded="Every run")])
    made = Section("made", "How it was made", [_made(results.manifest)])
    return Report(_about(results), [*sections, *extra, runs, made])


def _part(part: Part) -> str:
    if isinstance(part, str):
        return part
    if isinstance(part, Table):
        return part.html()
    # Three in a row where that leaves no row with one alone.
    kind = "figures" if len(part) % 3 == 0 else "figures two"
    return f'<div class="{kind}">{"".join(figure.html() for figure in part)}</div>'


def _about(results: Results) -> str:
    manifest = results.manifest
    machines = manifest.get("machines") or []
    where = "; ".join(f"{m.get('processor', '?')}, {m.get('cores', '?')} cores" for m in machines)
    hours = float(manifest.get("wall_seconds", 0)) / 3600
    planned = manifest.get("planned")
    count = f"{len(results.runs)} of {planned} planned runs" if planned else f"{len(results.runs)} runs"
    took = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.1f} minutes"
    return html.escape(f"{count}, {took} of run time in all{', on ' + where if where else ''}.")


def _against_cost(grouped: Study, threshold: float | None) -> list[Section]:
    found = figures.panels(grouped)
    if not found:
        return []
    note = f"<p>{PROSE['prices']}</p>"
    above = [figures.against_cost(grouped, panel) for panel in found]
    # No regret where a world has no proved bound, as one on recorded tracks.
    bounded = [panel for panel in found if not any(math.isnan(grouped.upper(world)) for world in panel.worlds)]
    below = [figures.regret_against_cost(grouped, panel, threshold) for panel in bounded]
    return [Section("figures", "Against the price of a sensor", [below, note, above])]


def _learning(results: Results, grouped: Study, threshold: float | None) -> list[Section]:
    drawn = [figures.curves(grouped, results.curves, by) for by in ("frames", "seconds")]
    shown = [figure for figure in (*drawn, figures.profiles(grouped, threshold)) if figure]
    return [Section("learning", "Learning curves and profiles", [shown])] if shown else []


def _idea(results: Results, grouped: Study) -> list[Section]:
    """An example of a miss, by the first policy that is kept and allows for one."""
    for (world, method), run in ((group, run) for group, runs in grouped.groups.items() for run in runs):
        if run.name in results.policies and run.name in results.motions:
            size, where = grid_size(run.settings["grid.size"]), f"{method}, {world}, seed {run.seed} (n = 1)"
            if drawn := idea.idea_figure(results.policies[run.name], results.motions[run.name], size, where):
                return [Section("idea", "Why few sensors are enough", [[drawn]])]
    return []


def _maps(results: Results, grouped: Study) -> list[Section]:
    """Policies and values in the first and the last world."""
    found = list[tuple[str, str, Sensed, MotionTable, tuple[int, int]]]()
    # The first and the last world differ most, since worlds are in the order of Z and c; a dict, as they may be the
    # same.
    for world in dict.fromkeys((grouped.worlds[0], grouped.worlds[-1])):
        motion = next((results.motions[r.name] for r in grouped.in_world(world) if r.name in results.motions), None)
        for method in grouped.methods[:MAPPED]:
            run = next((run for run in grouped.of(world, method) if run.name in results.policies), None)
            if run is not None and motion is not None:
                name, where = figures.slug(f"{method}-{world}"), f"{method}, {world}, seed {run.seed} (n = 1)"
                found.append((name, where, results.policies[run.name], motion, grid_size(run.settings["grid.size"])))
    if not found:
        return []
    scales = maps.value_scales((policy, motion) for _, _, policy, motion, _ in found)
    note = f"<p>{PROSE['maps']}</p>"
    large = any(len(policy.value) > maps.MOST_MAP_CELLS for _, _, policy, _, _ in found)
    values, sets = [maps.value_map(*each, scales) for each in found], [maps.policy_map(*each) for each in found]
    return [Section("maps", "Policies and values, cell by cell", [values, "" if large else note, sets])]


def _made(manifest: Any) -> str:
    facts = {"Command": manifest.get("line") or "not recorded"}
    for key, label in (("versions", "Versions"), ("machines", "Machine")):
        for entry in manifest.get(key, []):
            text = ", ".join(f"{name} {value}" for name, value in entry.items() if name != "runs" and value is not None)
            facts[f"{label}, {entry['runs']} runs"] = text
    seconds = [f"{manifest.get(key, 0):,.0f} s {key.split('_')[0]}" for key in ("wall_seconds", "cpu_seconds")]
    facts["Run time"] = ", ".join(seconds)
    facts["Intervals"] = PROSE["intervals"]
    items = "".join(f"<div><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>" for k, v in facts.items())
    return f'<dl class="facts">{items}</dl><p class="faint">Numbers in full: the CSV files beside this page.</p>'
