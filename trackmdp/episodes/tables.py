"""Logged episodes as flat tables, for a spreadsheet or a data frame."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from trackmdp.episodes.messages import step_messages
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
        columns = [*_STEP, "mode"] if reader.run.modes else _STEP
        table = csv.DictWriter(stream, columns, extrasaction="ignore")
        table.writeheader()
        for row in rows:
            for message in step_messages(reader.read(row["episode"]), reader.run):
                step = json.loads(message)
                table.writerow(step | {"active": " ".join(map(str, step["active"]))})
    with files[1].open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(reader.rows[0]) if reader.rows else ["episode"])
        table.writeheader()
        table.writerows(rows)
    return files
