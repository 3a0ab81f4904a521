"""Pages and videos of simulated episodes, of one target or several."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trackmdp.durable import write_text
from trackmdp.episodes.episode import Recording
from trackmdp.errors import UserError
from trackmdp.notebook.card import Carded
from trackmdp.world.group import Group


class Showing(Carded):
    """A sequence of episodes, any of which can be shown."""

    problem: Any

    def __len__(self) -> int:
        raise NotImplementedError

    def shown(self, call: str, number: int) -> Recording:
        """An episode with its belief.

        Raises:
            UserError: there is no such episode; the line begins with `call`.
        """
        raise NotImplementedError

    def check(self, call: str, number: int) -> None:
        """Refuse the number of an episode that is not there; see `shown`."""
        if not 0 <= number < len(self):
            raise UserError(f"{call}: episode {number}, expected 0 to {len(self) - 1}")

    def page(self, file: str | Path, number: int = 0) -> Path:
        """Write an episode as a web page that needs no network, and return its path.

        Raises:
            UserError: there is no such episode.
        """
        from trackmdp.episodes.episode_page import page

        place = Path(file)
        write_text(place, page(self.problem, self.shown("page", number)))
        return place

    def video(self, file: str | Path, number: int = 0, *, speed: int = 4) -> Path:
        """Write an episode as a `.gif` or `.mp4` of `speed` steps per second, and return its path (extra `video`).

        Raises:
            UserError: there is no such episode, another ending, or a package is missing.
        """
        from trackmdp.episodes.video import write_video

        task = self.problem.task if isinstance(self.problem, Group) else self.problem
        write_video(Path(file), task, self.shown("video", number), speed)
        return Path(file)
