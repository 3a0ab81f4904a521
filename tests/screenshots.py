"""Pictures of everything that people look at, to be looked at: ``python -m tests.screenshots FOLDER``.

A sweep of four short runs, its report, the page of an episode and that of recorded tracks, each on a desktop, on a
phone and in the dark; and what the commands print in a terminal of 80 columns. Takes Chromium and the extras `report`
and `tracks`; about two minutes.
"""

from __future__ import annotations

import io
import os
import pty
import re
import sys
from pathlib import Path

from rich.console import Console
from rich.text import Text

from tests.episodes.browser import Browser

VIEWS = {"desktop": (1280, 900, "light"), "phone": (390, 844, "light"), "dark": (1280, 900, "dark")}
TERMINAL = {"80": (800, 300, "light")}  # 80 letters are 770 pixels wide; the page is as high as its text
CITY = ("kernel.step=5", "kernel.cell=50", "grid.size=[18,15]", "cost.sensor=0.1")
SHORT = ("algo.total_frames=60_000", "algo.frames_per_batch=10_000")


def in_terminal(words: list[str]) -> str:
    """What a command prints in a terminal of 80 columns, with its control sequences."""
    os.environ |= {"COLUMNS": "80", "LINES": "50", "TERM": "xterm-256color"}
    said: list[bytes] = []

    def read(descriptor: int) -> bytes:
        said.append(os.read(descriptor, 65536))
        return said[-1]

    pty.spawn([sys.executable, "-m", "trackmdp.app.cli", *words], read)
    return b"".join(said).decode(errors="replace")


def terminal_page(text: str, file: Path) -> None:
    """A page of what is left on the screen in the end."""
    lines, at = [""], 0
    # rich redraws with a carriage return, "erase the line" (2K) and "one line up" (1A), and nothing else
    for part in re.split(r"(\r?\n|\r|\x1b\[2K|\x1b\[1A)", text):
        if part in ("\n", "\r\n"):
            at += 1
            lines += [""] * (at == len(lines))
        elif part == "\x1b[1A":
            at -= 1
        elif part == "\x1b[2K":
            lines[at] = ""
        elif part != "\r":
            lines[at] += part
    screen = Console(width=80, record=True, file=io.StringIO())
    for line in lines:
        screen.print(Text.from_ansi(line))
    file.write_text(screen.export_html(), encoding="utf-8")


def main(folder: Path) -> None:
    """Make the pictures in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    sweep, run, episode, tracks = (folder / each for each in ("sweep", "run", "episode.html", "tracks"))
    city = f"kernel.path={Path(__file__).parent / 'data/city.csv'}"
    commands = {
        "train": ["train", "cost.sensor=0.22", f"hydra.run.dir={run}"],
        "evaluate": ["evaluate", f"run={run}", "log=[mcap]", "episodes=20", f"hydra.run.dir={run}/e"],
        "tracks": ["train", "algo=path_counts", "kernel=tracks", city, *CITY, f"hydra.run.dir={tracks}"],
        "held-out": ["evaluate", f"run={tracks}", f"hydra.run.dir={tracks}/e"],
        "sweep": ["train", "-m", "seed=0,1", "cost.sensor=0.16,0.22", *SHORT, f"hydra.sweep.dir={sweep}"],
        "report": ["report", f"sweep={sweep}"],
        "watch": ["report", f"sweep={sweep}", "watch=true"],
        "verify": ["verify", f"hydra.run.dir={folder / 'verify'}"],
        "solve": ["solve", "cost.sensor=0.22", f"hydra.run.dir={folder / 'solve'}"],
        "list": ["replay", f"file={run}/e/episodes.mcap"],
        "replay": ["replay", f"file={run}/e/episodes.mcap", "episode=3", f"html={episode}"],
        "mistake": ["train", "algo.lr=3"],
        "help": ["train", "algo=ppo", "--help"],
        "commands": ["--help"],
    }
    pages = {"report": sweep / "report/report.html", "episode": episode, "tracks": tracks / "e/tracks.html"}
    for name, words in commands.items():
        terminal_page(in_terminal(words), page := folder / f"terminal-{name}.html")
        pages[f"terminal-{name}"] = page
    with Browser(folder / "profile") as browser:
        for name, page in pages.items():
            for view, (width, height, scheme) in (TERMINAL if "terminal" in name else VIEWS).items():
                browser.view(width, height, scheme)
                browser.open(page)
                if name == "episode":  # at its first miss
                    browser.ask("show(data.located.findIndex((seen) => !seen))")
                browser.shoot(folder / f"{name}-{view}.png")
    sys.stdout.write(f"{len(list(folder.glob('*.png')))} pictures in {folder}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
