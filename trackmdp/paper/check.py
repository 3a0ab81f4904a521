"""One checked statement: its largest deviation, and the verdict that follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

NO_CASE = float("-inf")
"""Deviation of a statement that has no case in a world."""
_WORDS = {
    "holds": "hold",
    "no case": "have no case in this world",
    "open": "are open",
    "FAILS": "FAIL",
}


class Check(NamedTuple):
    """One statement and its largest deviation in a world.

    Attributes:
        name: the statement's place in the paper, or the part of the program that is checked.
        statement: the statement.
        deviation: largest deviation; 0 or less where an inequality holds everywhere, `NO_CASE` where there is no case.
        holds: whether the deviation is within the tolerance; see `judged`.
        expected: whether the statement is claimed here; the paper's looser forms are shown, not claimed.
        note: figures or conditions.
        closed: whether the solver's bracket is closed; else a deviation may be the solver's, and is no counter-example.
    """

    name: str
    statement: str
    deviation: float
    holds: bool = False
    expected: bool = True
    note: str = ""
    closed: bool = True

    def judged(self, scale: float) -> Check:
        """The check with `holds`: whether the deviation is at most `scale`."""
        return self._replace(holds=self.deviation <= scale)

    def of_cases(self, due: int) -> Check:
        """The check, failed if it has looked at no case where there are `due` cases, counted in another way."""
        if self.deviation > NO_CASE or not due:
            return self
        return self._replace(deviation=float("inf"), note=f"looked at none of {due} cases")

    @property
    def verdict(self) -> str:
        """`holds`, `FAILS`, `no case`, `open` (the solver's bracket is open), or not claimed."""
        if self.deviation == NO_CASE:
            return "no case"
        if not self.holds and not self.closed:
            return "open"
        if self.expected:
            return "holds" if self.holds else "FAILS"
        return "not claimed; holds here" if self.holds else "not claimed; does not hold"

    @property
    def passed(self) -> bool:
        """Whether nothing that is claimed is refuted."""
        return self.verdict != "FAILS"


def summarize_checks(found: Sequence[Check]) -> str:
    """The number of claims by verdict, and of the forms that are not claimed, in one line."""
    claims = [check.verdict for check in found if check.expected]
    counts = {verdict: claims.count(verdict) for verdict in _WORDS}
    parts = [
        f"{count} {_WORDS[verdict]}"
        for verdict, count in counts.items()
        if count or verdict in ("holds", "FAILS")
    ]
    loose = [check.holds for check in found if not check.expected]
    return (
        f"of {len(claims)} claims {', '.join(parts)}; "
        f"of {len(loose)} looser forms, not claimed, {loose.count(False)} do not hold"
    )
