"""Pages and videos of simulated episodes, of one target or several."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast, overload

import torch
from tensordict import TensorDict

from trackmdp.durable import write_text
from trackmdp.episodes.episode import Recording
from trackmdp.errors import UserError, output_of
from trackmdp.notebook.card import Carded

R = TypeVar("R", bound=Recording)


class Showing(Carded, Sequence[R]):
    """A sequence of simulated episodes, any of which can be shown.

    Attributes:
        problem: where they took place.
        seeds: of each of the E episodes.
    """

    problem: Any
    seeds: Sequence[int]

    def __len__(self) -> int:
        return len(self.seeds)

    @overload
    def __getitem__(self, which: int) -> R: ...
    @overload
    def __getitem__(self, which: slice) -> list[R]: ...
    def __getitem__(self, which: int | slice) -> R | list[R]:
        if isinstance(which, slice):
            return [self._episode(number) for number in range(len(self))[which]]
        return self._episode(range(len(self))[which])

    @abstractmethod
    def _episode(self, number: int) -> R:
        """An episode by its number, without belief."""

    @property
    @abstractmethod
    def _at_once(self) -> int:
        """Episodes that are completed together: memory stays bounded on large grids."""

    @abstractmethod
    def _completed(self, begin: int, end: int) -> Iterable[R]:
        """See `complete`; those from number `begin` to `end` - 1."""

    def complete(self) -> Iterator[R]:
        """The episodes with `belief`, and of one target with `probability`, computed for some of them at a time.

        Recorded tracks have no motion model; the belief of one target is 0 in all cells.
        """
        for begin in range(0, len(self), self._at_once):
            yield from self._completed(begin, min(begin + self._at_once, len(self)))

    def to_tensordict(self) -> TensorDict:
        """`[S]` the steps of all episodes, as of `Recording.to_tensordict`, and the number of each, `episode`."""
        parts = [
            each.to_tensordict(self.problem.task).set("episode", torch.full((len(each),), number))
            for number, each in enumerate(self)
        ]
        return cast(TensorDict, torch.cat(parts)) if parts else TensorDict({}, [0])

    def _shown(self, call: str, number: int) -> R:
        """A complete episode.

        Raises:
            UserError: there is no such episode; the line begins with `call`.
        """
        if not 0 <= number < len(self):
            raise UserError(f"{call}: episode {number}, expected 0 to {len(self) - 1}")
        return next(iter(self._completed(number, number + 1)))

    def page(self, file: str | Path, number: int = 0) -> Path:
        """Write an episode as a web page that needs no network, and return its path.

        Raises:
            UserError: there is no such episode, or the file cannot be written there.
        """
        from trackmdp.episodes.episode_page import page

        place = output_of(file, "page")
        write_text(place, page(self.problem, self._shown("page", number)))
        return place

    def video(self, file: str | Path, number: int = 0, *, speed: int = 4) -> Path:
        """Write an episode as a `.gif` or `.mp4` of `speed` steps per second, and return its path (extra `video`).

        Raises:
            UserError: there is no such episode, the file cannot be written there, another ending, or a package is
                missing.
        """
        from trackmdp.episodes.video import write_video

        place = output_of(file, "video")
        write_video(place, self.problem.single, self._shown("video", number), speed)
        return place
