"""The form of the episodes of a log: of one target, or of several."""

from __future__ import annotations

from trackmdp.episodes.group_messages import GroupForm
from trackmdp.episodes.messages import Form
from trackmdp.episodes.schema import LoggedRun
from trackmdp.sensing.coverage import Coverage


def form_of(run: LoggedRun, coverage: Coverage | None = None) -> Form:
    """The form of the episodes of the log `run`; see `Form`."""
    return (GroupForm if run.kinds else Form)(run, coverage)
