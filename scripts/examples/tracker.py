"""A policy at work, driven from a CSV of detections: `tracker.py POLICY DETECTIONS`.

POLICY is the policy.npz of a run on recorded positions. DETECTIONS has a line for each step with the position of the
target, in columns lat and lon, or x and y; empty ones where nothing was seen. A position counts only if one of the
sensors that the tracker has switched on sees it. Without words both are made from the vehicles of a simulated town.
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
from pathlib import Path

import trackmdp as tm
from trackmdp.examples import example_file


def main(policy_file: Path, detections: Path) -> None:
    """Print each step, and in the end how often the target was located."""
    policy = tm.Policy.load(policy_file)
    tracker, steps, located, sensing, safe = None, 0, 0, 0, 0
    rows = list(csv.DictReader(detections.read_text("utf-8-sig").splitlines()))
    if len(ids := sorted({row["id"] for row in rows if row.get("id")})) > 1:
        raise tm.UserError(f"{detections}: ids {', '.join(ids[:3])}, expected one target")
    for line, row in enumerate(rows or [{}], 2):
        axes = ("lat", "lon") if "lat" in row else ("x", "y")
        at = tuple(float(row[name]) for name in axes if row.get(name))
        if len(at) == 1 or not (at or tracker):  # the first line is a detection
            raise tm.UserError(f"{detections}: line {line}: {row}, expected {' and '.join(axes)}")
        if tracker is None:
            tracker = policy.tracker(at=at)
            continue
        on, due = tracker.sensors(), tracker.safe
        try:
            cell = policy.task.cell_of(*at) if at else None
        except tm.UserError:
            tracker.exited()
            print(f"step {steps + 1}: left the grid")
            break
        seen = cell is not None and tracker.sees(cell)
        tracker.report(cell if seen else None)
        # As after a restart of the process: all that a tracker knows is a few numbers.
        tracker = tm.Tracker.restore(policy, json.loads(json.dumps(tracker.state())))
        steps, located = steps + 1, located + seen
        sensing, safe = sensing + len(on) * (not due), safe + due
        what = "safe action" if due else f"sensors {' '.join(map(str, on)) or 'none'}"
        print(f"step {steps}: {what}: {f'located in cell {cell}' if seen else 'missed'}")
    print(f"located in {located} of {steps} steps, {sensing} sensors on, {safe} safe actions")


def town(folder: Path) -> tuple[Path, Path]:
    """A policy learned from most vehicles, and the longest of the recordings held out."""
    city = example_file("city.csv")
    tracks = tm.load_tracks(city, (18, 15), step=5, cell=50, cost=0.2, safe_cost=5, t_max=1)
    policy, detections = folder / "policy.npz", folder / "detections.csv"
    tm.train(tracks, "model_based", seed=0).policy.save(policy)
    own, longest = tracks.held_out, int(tracks.held_out.lengths.argmax())
    cells = own.cells[own.first[longest] : own.first[longest + 1]].tolist()
    lines = ["x,y", *("{},{}".format(*tracks.place_of(cell)) for cell in cells)]
    detections.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return policy, detections


if __name__ == "__main__":
    if len(sys.argv) == 3:
        try:
            main(Path(sys.argv[1]), Path(sys.argv[2]))
        except (tm.UserError, OSError, ValueError) as error:
            sys.exit(f"tracker.py: {error}")
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(*town(Path(temporary)))
