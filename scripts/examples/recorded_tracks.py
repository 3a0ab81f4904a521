"""Recorded positions of city traffic: learn from most vehicles, value on those held out, without a motion model."""

from __future__ import annotations

from pathlib import Path

import trackmdp as tm

CITY = Path(__file__).parents[2] / "tests" / "data" / "city.csv"
"""719 vehicles of a simulated town (Eclipse SUMO), every 5 s: id, time in seconds, x and y in metres."""


def main() -> None:
    """Print figures on the held-out tracks, each with its 95 % interval."""
    for memory in ("cell", "displacement"):
        # 18 x 15 cells of 50 m; finding a vehicle that was lost costs as much as 25 sensors. Files of AIS, ADS-B, GPX,
        # GeoJSON, MOT-Challenge and SUMO are loaded in the same way; lat and lon are projected.
        tracks = tm.load_tracks(CITY, (18, 15), step=5, cell=50, cost=0.2, safe_cost=5, t_max=1, memory=memory)
        run = tm.train(tracks, "path_counts", seed=0)
        if memory == "cell":
            print(", ".join(f"{count:,} {what}" for what, count in tracks.loaded.items() if count))
        for name, figures in run.summary["held_out"]["figures"].items():
            reward, located = figures["reward_per_step"], figures["accuracy"]["mean"]
            subject = f"learned, remembers {memory}" if name == "policy" else name
            if name == "policy" or memory == "cell":
                interval = f"95 % {reward['low']:.3f} ... {reward['high']:.3f}"
                print(f"{subject:32} reward per step {reward['mean']:7.3f}   {interval}   located {located:.1%}")


if __name__ == "__main__":
    main()
