"""How the episodes of a log are written as messages, and read again: those of one target, or of several."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from trackmdp.episodes import group_messages, messages
from trackmdp.episodes.grids import grid_messages
from trackmdp.episodes.messages import Messages
from trackmdp.episodes.schema import LoggedRun
from trackmdp.world.coverage import Coverage


class Form(ABC):
    """The form of the episodes of a log.

    Args:
        run: the log.
        coverage: of its sensors; None where each sees its own cell.
    """

    def __init__(self, run: LoggedRun, coverage: Coverage | None = None) -> None:
        self.run, self.coverage = run, coverage

    @abstractmethod
    def row(self, episode: Any, first_tick: int) -> dict[str, Any]:
        """The `/episode` message."""

    @abstractmethod
    def steps(self, episode: Any) -> Iterator[bytes]:
        """The `/step` messages."""

    @abstractmethod
    def layers(self, episode: Any, first_tick: int) -> Iterator[dict[str, bytes]]:
        """Of each step the messages for viewers, by topic."""

    @abstractmethod
    def decode(self, row: dict[str, Any], said: Messages) -> Any:
        """The episode of a row and its messages."""


class OneTarget(Form):
    """Episodes of one target; see `Episode`."""

    def row(self, episode: Any, first_tick: int) -> dict[str, Any]:
        """See `Form`."""
        of_mode = {} if episode.mode is None else {"start_mode": episode.start_mode}
        return of_mode | messages.row_of(episode, episode.start, self.run.t_max, first_tick)

    def steps(self, episode: Any) -> Iterator[bytes]:
        """See `Form`."""
        return messages.step_messages(episode, self.run)

    def layers(self, episode: Any, first_tick: int) -> Iterator[dict[str, bytes]]:
        """See `Form`."""
        covered = None if self.coverage is None else self.coverage.cells(episode.action)
        return grid_messages(episode, self.run.size, first_tick, covered)

    def decode(self, row: dict[str, Any], said: Messages) -> Any:
        """See `Form`."""
        return messages.decode(row, said, self.run)


class SeveralTargets(Form):
    """Episodes of several targets; see `GroupEpisode`."""

    def row(self, episode: Any, first_tick: int) -> dict[str, Any]:
        """See `Form`."""
        return messages.row_of(episode, episode.start.tolist(), self.run.t_max, first_tick)

    def steps(self, episode: Any) -> Iterator[bytes]:
        """See `Form`."""
        return group_messages.group_steps(episode, self.run)

    def layers(self, episode: Any, first_tick: int) -> Iterator[dict[str, bytes]]:
        """See `Form`."""
        return group_messages.group_layers(episode, self.run, first_tick)

    def decode(self, row: dict[str, Any], said: Messages) -> Any:
        """See `Form`."""
        return group_messages.decode_group(row, said, self.run)


def form_of(run: LoggedRun, coverage: Coverage | None = None) -> Form:
    """The form of the episodes of the log `run`."""
    return SeveralTargets(run, coverage) if run.kinds else OneTarget(run, coverage)
