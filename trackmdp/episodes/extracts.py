"""Episodes of a log as tables, and one of them as a web page."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from trackmdp.durable import write_text
from trackmdp.episodes.episode_page import page
from trackmdp.episodes.messages import step_messages
from trackmdp.episodes.reader import EpisodeReader


def write_page(reader: EpisodeReader, file: Path, number: int | None = None) -> None:
    """Write the page of episode `number`, by default the first of the log.

    Raises:
        UserError: there is no such episode.
        OSError: the file cannot be written.
    """
    wanted = reader.rows[0]["episode"] if number is None else number
    episode = reader.read(wanted)
    label = reader.policies[episode.policy].get("label", "")
    write_text(file, page(reader.world(), episode, label, str(reader.run.said.get("seed", ""))))


_STEP = (
    "episode",
    "t",
    "n",
    "last_cell",
    "active",
    "n_active",
    "forced",
    "target",
    "obs",
    "reward",
    "ep_return",
)


def write_tables(reader: EpisodeReader, folder: Path, number: int | None = None) -> None:
    """Write `steps.csv` and `episodes.csv` of all episodes, or of one.

    Cells are numbers, -1 for none; `active` holds the numbers of the sensors on, separated by blanks.
    """
    rows = [reader.row(number)] if number is not None else reader.rows
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "steps.csv").open("w", newline="", encoding="utf-8") as stream:
        columns = [*_STEP, "mode"] if reader.run.modes else _STEP
        table = csv.DictWriter(stream, columns, extrasaction="ignore")
        table.writeheader()
        for row in rows:
            for message in step_messages(reader.read(row["episode"]), reader.run):
                step = json.loads(message)
                table.writerow(step | {"active": " ".join(map(str, step["active"]))})
    with (folder / "episodes.csv").open("w", newline="", encoding="utf-8") as stream:
        table = csv.DictWriter(stream, list(reader.rows[0]) if reader.rows else ["episode"])
        table.writeheader()
        table.writerows(rows)
