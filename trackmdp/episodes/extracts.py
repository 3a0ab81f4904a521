"""Episodes of a log as tables, and one of them as a web page."""

from __future__ import annotations

import codecs
import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from trackmdp.durable import whole_file, write_text
from trackmdp.episodes.episode_page import page
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.schema import schemas_of


def write_page(reader: EpisodeReader, file: Path, number: int | None = None) -> None:
    """Write the page of episode `number`, by default the first of the log.

    Raises:
        UserError: there is no such episode.
        OSError: the file cannot be written.
    """
    wanted = reader.rows[0]["episode"] if number is None else number
    episode = reader.read(wanted)
    label = reader.policies[episode.policy].get("label", "")
    write_text(file, page(reader.world(), episode, label, str(reader.said.get("seed", ""))))


_LEFT_OUT = {"target_x", "target_y", "first", "last"}
"""Of the steps: what follows from the other columns."""


def write_tables(reader: EpisodeReader, folder: Path, number: int | None = None) -> None:
    """Write `steps.csv` and `episodes.csv` of all episodes, or of one.

    Cells are numbers, -1 for none; `active` holds the numbers of the sensors chosen, of which none is on where
    `forced`, and a column of several targets a number of each, separated by blanks.
    """
    rows = [reader.row(number)] if number is not None else reader.rows
    folder.mkdir(parents=True, exist_ok=True)
    form = reader.form
    fields = schemas_of(form.problem)["/step"][1]["properties"]
    steps = (
        json.loads(message) for row in rows for message in form.steps(reader.read(row["episode"]))
    )
    _write(folder / "steps.csv", [name for name in fields if name not in _LEFT_OUT], steps)
    _write(folder / "episodes.csv", list(reader.rows[0]) if reader.rows else ["episode"], rows)


def _write(file: Path, columns: list[str], rows: Iterable[dict[str, Any]]) -> None:
    with whole_file(file) as stream:
        table = csv.DictWriter(codecs.getwriter("utf-8")(stream), columns, extrasaction="ignore")
        table.writeheader()
        for row in rows:
            listed = {
                name: " ".join(map(str, value))
                for name, value in row.items()
                if isinstance(value, list)
            }
            table.writerow(row | listed)
