"""GPS tracks of your own on cells in metres: learn from most, value on those held out, without a motion model."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import trackmdp as tm
from trackmdp.examples import example_file

CITY = example_file("city.csv")
"""719 vehicles of a simulated town (Eclipse SUMO), every 5 s: id, time in seconds, x and y in metres."""


def gps(file: Path) -> Path:
    """The town as receivers would have recorded it near 48 N, 11 E: id, time, and degrees in place of metres."""
    number, time, x, y = np.loadtxt(CITY, delimiter=",", skiprows=1).T
    lat, lon = 48 + y / 111_208, 11 + x / 74_627  # metres of a degree there
    table = np.stack([number, time, lat, lon], axis=1)
    np.savetxt(
        file,
        table,
        fmt=["%d", "%d", "%.6f", "%.6f"],
        delimiter=",",
        header="id,time,lat,lon",
        comments="",
    )
    return file


def main(file: Path) -> None:
    """Print figures on the held-out tracks, each with its 95 % interval."""
    for memory in ("cell", "displacement"):
        # 18 x 15 cells of 50 m; finding a vehicle that was lost costs as much as 25 sensors. Positions in metres, files
        # of AIS, ADS-B, GPX, GeoJSON, MOT-Challenge and SUMO are loaded in the same way.
        tracks = tm.load_tracks(
            file, (18, 15), step=5, cell=50, cost=0.2, safe_cost=5, t_max=1, memory=memory
        )
        run = tm.train(tracks, "model_based", seed=0)
        if memory == "cell":
            print(", ".join(f"{count:,} {what}" for what, count in tracks.loaded.items() if count))
        for name, figures in run.summary["held_out"]["figures"].items():
            reward, located = figures["reward_per_step"], figures["accuracy"]["mean"]
            subject = f"learned, remembers {memory}" if name == "policy" else name
            if name == "policy" or memory == "cell":
                interval = f"95 % {reward['low']:.3f} ... {reward['high']:.3f}"
                print(
                    f"{subject:32} reward per step {reward['mean']:7.3f}   {interval}   located {located:.1%}"
                )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        main(gps(Path(folder) / "tracks.csv"))
