"""Pictures of everything that people look at, to be looked at: ``python -m tests.screenshots FOLDER``.

A sweep of four short runs and its report; runs with sensors of one cell and of several, one of a policy that remembers
and one by blocks, each with its report and an episode; and recorded tracks: all on a desktop, on a phone and in the
dark. And what the commands print in a terminal of 80 columns. Takes Chromium and the extras `report` and `tracks`;
some four minutes on idle cores.
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
TERMINAL = {
    "80": (800, 300, "light")
}  # 80 letters are 770 pixels wide; the page is as high as its text
CITY = ("kernel.step=5", "grid.cell=50", "grid.size=[18,15]", "cost.sensor=0.1")
SHORT = ("algo.total_frames=60_000", "algo.frames_per_batch=10_000")
RUNS = {
    "run": ["cost.sensor=0.22"],
    "footprint": [
        "sensor=footprint",
        "sensor.radius=1",
        "sensor.spacing=2",
        "grid.size=8",
        "cost.sensor=0.22",
    ],
    "memory": [
        "algo=model_based",
        "kernel=heading",
        "task.memory=displacement",
        "grid.size=5",
        *SHORT,
    ],
    "blocks": ["grid.size=16", "cost.sensor=0.22", "partition.block=8"],
}


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
    sweep, tracks = folder / "sweep", folder / "tracks"
    city = f"kernel.path={Path(__file__).parent / 'data/city.csv'}"
    commands = {
        "tracks": [
            "train",
            "algo=model_based",
            "kernel=tracks",
            city,
            *CITY,
            f"hydra.run.dir={tracks}",
        ],
        "held-out": ["evaluate", f"run={tracks}", f"hydra.run.dir={tracks}/e"],
        "sweep": [
            "train",
            "-m",
            "seed=0,1",
            "cost.sensor=0.16,0.22",
            *SHORT,
            f"hydra.sweep.dir={sweep}",
        ],
        "report": ["report", f"sweep={sweep}"],
        "watch": ["report", f"sweep={sweep}", "watch=true"],
        "verify": ["verify", f"hydra.run.dir={folder / 'verify'}"],
        "solve": ["solve", "cost.sensor=0.22", f"hydra.run.dir={folder / 'solve'}"],
        "mistake": ["train", "algo.lr=3"],
        "help": ["train", "algo=ppo", "--help"],
        "commands": ["--help"],
    }
    pages = {"report": sweep / "report/report.html", "tracks": tracks / "e/tracks.html"}
    for name, words in RUNS.items():
        run, pages[f"{name}-episode"] = folder / name, folder / f"{name}.html"
        log = f"file={run}/e/episodes.mcap"
        commands |= {
            name: ["train", *words, f"hydra.run.dir={run}"],
            f"{name}-evaluate": [
                "evaluate",
                f"run={run}",
                "log=[mcap]",
                "episodes=20",
                f"hydra.run.dir={run}/e",
            ],
            f"{name}-list": ["replay", log],
            f"{name}-replay": ["replay", log, "episode=3", f"html={pages[f'{name}-episode']}"],
            f"{name}-report": ["report", f"sweep={run}"],
        }
        pages[f"{name}-report"] = run / "report/report.html"
    for name, words in commands.items():
        terminal_page(in_terminal(words), page := folder / f"terminal-{name}.html")
        pages[f"terminal-{name}"] = page
    with Browser(folder / "profile") as browser:
        for name, page in pages.items():
            for view, (width, height, scheme) in (
                TERMINAL if "terminal" in name else VIEWS
            ).items():
                browser.view(width, height, scheme)
                browser.open(page)
                if name.endswith("episode"):  # at its first miss
                    browser.ask("show(data.located.findIndex((seen) => !seen))")
                browser.shoot(folder / f"{name}-{view}.png")
    sys.stdout.write(f"{len(list(folder.glob('*.png')))} pictures in {folder}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
