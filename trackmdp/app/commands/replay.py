"""`replay`: list, play, verify and recover logged episodes, and write them as a web page or as tables."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from trackmdp.config import ReplayConfig
from trackmdp.episodes.extracts import write_page, write_tables
from trackmdp.episodes.layouts import write_layout
from trackmdp.episodes.player import play
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.episodes.schema import versions_apart
from trackmdp.errors import RunError, UserError
from trackmdp.notebook.card import counted_words
from trackmdp.training.display import make_console, table


def run(cfg: ReplayConfig, folder: Path) -> None:  # noqa: ARG001  every file has a name of its own
    """List, play, verify, recover or export the log `cfg.file`.

    Raises:
        RunError: an episode did not come out the same.
    """
    console = make_console(cfg.quiet)
    file = Path(cfg.file)
    if cfg.recover:
        saved = recover(file)
        file = saved.file
        console.print(f"{counted_words(saved.episodes, 'episode')} -> {file}")
        for line in saved.damaged:
            console.print(f"lost: {line}")
    with EpisodeReader(file) as reader:
        # First: other versions of NumPy or torch may draw other numbers, which is not damage.
        if apart := versions_apart(reader.said):
            console.print(f"made by other versions: {apart}")
        asked = _exports(console, cfg, reader)
        if cfg.verify:
            _verify(console, cfg, reader)
        if asked or cfg.verify or cfg.recover:
            return
        if cfg.episode is None:
            _list(console, reader)
        else:
            play(console, reader.read(cfg.episode), reader.world().single, cfg.speed)


def _exports(console: Console, cfg: ReplayConfig, reader: EpisodeReader) -> bool:
    """Write the page, the tables and the layout that are asked for; returns whether any was."""
    if not reader.rows and (cfg.html or cfg.csv):
        raise UserError(f"file={reader.file}: holds no episode")
    writers: dict[str, Callable[[Path], object]] = {
        "html": lambda path: write_page(reader, path, cfg.episode),
        "csv": lambda path: write_tables(reader, path, cfg.episode),
        "layout": lambda path: write_layout(path, reader.world()),
    }
    asked = {key: path for key in writers if (path := getattr(cfg, key)) is not None}
    for key, path in asked.items():
        try:
            writers[key](Path(path))
        except OSError as error:
            raise UserError(
                f"{key}={path}: cannot be written ({(error.strerror or str(error)).lower()})"
            ) from error
        console.print(f"{key} -> {path}")
    return bool(asked)


def _verify(console: Console, cfg: ReplayConfig, reader: EpisodeReader) -> None:
    numbers = None if cfg.episode is None else [reader.row(cfg.episode)["episode"]]
    with console.status("re-simulating"):
        verified = verify(reader, numbers=numbers)
    if verified.difference is not None:
        apart = versions_apart(reader.said)
        because = f"; made by other versions: {apart}" if apart else ""
        raise RunError(f"file={cfg.file}: {verified.difference}{because}")
    episodes = counted_words(verified.episodes, "episode")
    steps = counted_words(verified.steps, "step")
    console.print(f"{episodes}, {steps}: the same to the bit")


def _list(console: Console, reader: EpisodeReader) -> None:
    total = counted_words(sum(row["length"] for row in reader.rows), "step")
    episodes = counted_words(len(reader), "episode")
    problem, seed = reader.world(), reader.said.get("seed", "")
    task = problem.single
    grid = f"{task.rows}x{task.columns} grid"
    if problem.targets:
        grid += f" with {len(problem.targets)} targets"
    console.print(f"{episodes}, {total} on a {grid}, T_max {task.t_max}, seed {seed}")
    labels = [reader.policies[row["policy"]].get("label", "") for row in reader.rows]
    one = len(set(labels)) == 1
    if one:
        console.print(f"policy: {labels[0]}")
    entries = []
    for label, row in zip(labels, reader.rows, strict=True):
        number, steps, located, forced = (
            str(row[name]) for name in ("episode", "length", "detections", "forced")
        )
        end = "exited" if row["terminated"] else "truncated"
        own = [] if one else [label]
        entries.append([number, *own, steps, f"{row['return']:,.2f}", located, forced, end])
    names = ["episode", *([] if one else ["policy"]), "steps", "return", "located", "forced", "end"]
    console.print(table(str(reader.file), names, entries))
