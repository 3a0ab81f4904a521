"""A sweep by the command line and its report: `python scripts/examples/sweep.py FOLDER` (extra: report)."""

from __future__ import annotations

import sys
from pathlib import Path

from trackmdp.app.cli import main as trackmdp

WORLDS = (
    "grid.size=6",
    "kernel.support_size=3,5",
    "cost.sensor=0.16,0.22",
    "algo.total_frames=50_000",
)


def main(folder: Path) -> None:
    """Train in four worlds, each in a process of its own, and print where the page about them is."""
    train = ["train", "-m", *WORLDS, f"hydra.sweep.dir={folder}"]
    for words in (train, ["report", f"sweep={folder}"]):
        if status := trackmdp([*words, "quiet=true"]):
            sys.exit(status)
    print(folder / "report" / "report.html")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "multirun/example"))
