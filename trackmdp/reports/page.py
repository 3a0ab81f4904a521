"""A report: figures and tables of stored results, and the HTML page with them."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, TypeAlias

from trackmdp.notebook.card import counted_words
from trackmdp.reports import figures, idea, maps, tradeoffs
from trackmdp.reports.grouping import Study, study
from trackmdp.reports.results import Mapped, Results
from trackmdp.reports.style import Figure, Say
from trackmdp.reports.summaries import groups_table, outcome_table, runs_table, shortened
from trackmdp.reports.tables import Column, Table, paragraphs
from trackmdp.untrusted import printable

Part: TypeAlias = str | Table | Sequence[Figure]


@dataclass(frozen=True)
class Section:
    """A heading and the parts below it.

    Attributes:
        anchor: id on the page.
        heading: title.
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
    """A page: one line about the runs, sections, title."""

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
        """The page: one file, which loads nothing."""
        page = files("trackmdp.reports").joinpath("report.html").read_text(encoding="utf-8")
        links = (
            f'<li><a href="#{s.anchor}">{html.escape(s.heading)}</a></li>' for s in self.sections
        )
        texts = {
            "@TITLE@": html.escape(self.title),
            "@ABOUT@": html.escape(self.about),
            "@NAV@": "".join(links),
            "@BODY@": "\n".join(section.html() for section in self.sections),
        }
        # In one pass: a text may hold a mark itself, as the name of a folder.
        return printable(re.sub("|".join(texts), lambda mark: texts[mark[0]], page))


def build(
    results: Results,
    threshold: float | None = None,
    extra: Sequence[Section] = (),
    say: Say = lambda line: None,
) -> Report:
    """The report of stored results.

    Args:
        results: of the sweep.
        threshold: regret per step up to which runs are counted; None for no count.
        extra: further sections, shown before the list of all runs.
        say: receives progress.
    """
    caption = "Runs that are missing or differ from the others"
    lost = [[anomaly.run, anomaly.text] for anomaly in results.anomalies]
    table = Table("missing", caption, [Column("run"), Column("reason")], lost)
    missing = Section("missing", "Missing runs", [table] if lost else [])
    if not results.runs:
        return Report(_about(results), [missing])
    say("figures")
    grouped = study(results.runs)
    sections = [
        Section("outcome", "Outcome", _outcome(grouped, threshold)),
        missing,
        Section("idea", "Why few sensors are enough", _story(results.maps)),
        Section("prices", "Against the price of a sensor", _prices(grouped, threshold)),
        Section("learning", "Learning", _learning(grouped, threshold)),
        Section("maps", "Policies, cell by cell", _maps(results.maps)),
        *extra,
        Section("runs", "All runs", [groups_table(grouped, threshold), runs_table(grouped)]),
        Section("words", "Words", [_facts(paragraphs("trackmdp.reports", "words.txt"))]),
        Section("made", "How it was made", [_facts(_made(results.manifest))]),
    ]
    return Report(_about(results), [each for each in sections if each.parts])


def _part(part: Part) -> str:
    if isinstance(part, str):
        return part
    if isinstance(part, Table):
        return part.html()
    # Three in a row where that leaves no row with one alone.
    kind = "figures" if len(part) % 3 == 0 else "figures two"
    return f'<div class="{kind}">{"".join(figure.html() for figure in part)}</div>'


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _prose(name: str) -> str:
    return _paragraph(paragraphs("trackmdp.reports")[name])


def _about(results: Results) -> str:
    manifest = results.manifest
    planned = manifest.get("planned")
    found = len(results.runs)
    count = f"{found} of {planned} planned runs" if planned else counted_words(found, "run")
    machines = manifest.get("machines", ())
    where = "; ".join(f"{m.get('processor', '?')}, {m.get('cores', '?')} cores" for m in machines)
    hours = manifest.get("wall_seconds", 0) / 3600
    took = f"{hours:.1f} hours" if hours >= 1 else f"{60 * hours:.1f} minutes"
    return f"{count}, {took} of run time in all{', on ' + where if where else ''}."


def _outcome(grouped: Study, threshold: float | None) -> list[Part]:
    # Beside the first table: a method that was stopped early is easily taken for a weak one.
    short = "; ".join(shortened(grouped))
    note = f"Fewer env steps than by default: {short}."
    return [outcome_table(grouped, threshold), *([_paragraph(note)] if short else [])]


def _story(drawn: Sequence[Mapped]) -> list[Part]:
    """An example of a miss, by the best policy with one."""
    ordered = sorted(drawn, key=lambda each: float((each.bound - each.value).mean()))
    figure = next(filter(None, map(idea.idea_figure, ordered)), None)
    return [_prose("idea"), [figure]] if figure else []


def _prices(grouped: Study, threshold: float | None) -> list[Part]:
    parts: list[Part] = []
    for panel in figures.panels(grouped):
        drawn = (
            figures.against_price(grouped, panel, key, threshold) for key in figures.QUANTITIES
        )
        parts.append([*filter(None, (*drawn, tradeoffs.swept_figure(grouped, panel)))])
    # None on recordings, where no optimum is known.
    best = [_prose("best")] if "best known" in grouped.references() else []
    return [_prose("prices"), *best, *parts] if parts else []


def _learning(grouped: Study, threshold: float | None) -> list[Part]:
    drawn = [figures.learning(grouped, by) for by in ("frames", "seconds")]
    shown = [figure for figure in (*drawn, figures.profiles(grouped, threshold)) if figure]
    late = "".join(
        _paragraph(f"{method} learns at the end of a run, after {steps:,.0f} env steps: no curve.")
        for method, steps in figures.late_learners(grouped).items()
    )
    return [*([late] if late else []), *([shown] if shown else [])]


def _maps(drawn: Sequence[Mapped]) -> list[Part]:
    worlds = {each.world: [one for one in drawn if one.world == each.world] for each in drawn}
    if not worlds:
        return []
    ends = maps.shades(maps.missing(group) for group in worlds.values())
    values = [maps.missing_map(figures.slug(w), group, ends) for w, group in worlds.items()]
    sets = [maps.policy_map(figures.slug(f"{each.method}, {each.world}"), each) for each in drawn]
    large = any(len(each.value) > maps.MOST_MAP_CELLS for each in drawn)
    return [_prose("missing"), values, "" if large else _prose("sets"), sets]


def _made(manifest: Mapping[str, Any]) -> dict[str, str]:
    head = "Last command" if manifest.get("last") else "Command"
    facts = {head: manifest.get("line") or "not recorded"}
    for key, label in (("versions", "Versions"), ("machines", "Machine")):
        for entry in manifest.get(key, []):
            shown = (
                f"{name} {it}" for name, it in entry.items() if name != "runs" and it is not None
            )
            facts[f"{label}, {counted_words(entry['runs'], 'run')}"] = ", ".join(shown)
    times = (f"{manifest.get(f'{kind}_seconds', 0):,.0f} s {kind}" for kind in ("wall", "cpu"))
    return facts | {
        "Run time": ", ".join(times),
        "Intervals": paragraphs("trackmdp.reports")["intervals"],
        "All digits": "the CSV files beside this page",
    }


def _facts(facts: Mapping[str, str]) -> str:
    """A list of terms and texts."""
    items = (
        f"<div><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>" for k, v in facts.items()
    )
    return f'<dl class="facts">{"".join(items)}</dl>'
