"""Logged episodes as flat tables, for a spreadsheet or a data frame."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from trackmdp.episodes.episode import Episode
from trackmdp.episodes.limits import modes_of
from trackmdp.episodes.reader import EpisodeReader

_STEP = ("episode", "t", "n", "last_cell", "active", "n_active", "forced", "target", "obs", "reward", "ep_return")


def write_tables(reader: EpisodeReader, folder: Path, number: int | None = None) -> list[Path]:
    """Write `steps.csv` and `episodes.csv` of all episodes, or of one; returns the files.

    Cells are numbers, -1 for none; `active` holds the numbers of the sensors on, separated by blanks.
    """
    rows = [reader.row(number)] if number is not None else reader.rows
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / "steps.csv", folder / "episodes.csv"]
    with files[0].open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow([*_STEP, "mode"] if modes_of(reader.run) else _STEP)
        for row in rows:
            writer.writerows(_steps(reader.read(row["episode"]), reader.t_max))
    with files[1].open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(reader.rows[0]) if reader.rows else ["episode"])
        table.writeheader()
        table.writerows(rows)
    return files


def _steps(episode: Episode, t_max: int) -> Iterator[list[Any]]:
    forced, last = episode.forced(t_max), len(episode) - 1
    for t in range(len(episode)):
        active = episode.action[t].nonzero()[0].tolist()
        yield [
            episode.number,
            t,
            int(episode.misses[t]),
            int(episode.last_cell[t]),
            " ".join(map(str, active)),
            len(active),
            bool(forced[t]),
            -1 if episode.terminated and t == last else int(episode.target[t]),
            int(episode.observation[t]),
            float(episode.reward[t]),
            float(episode.returns[t]),
            *([] if episode.mode is None else [int(episode.mode[t])]),
        ]
