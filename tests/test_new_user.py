"""The path of a new user, from positions of ships in a CSV to sensors on a map."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.typed import ENVIRONMENT

PROGRAM = """\
import csv, itertools
import trackmdp as tm

ships = tm.load_tracks("ais.csv", (16, 24), cell=500, step=60, safe_cost=5, memory="displacement")
run = tm.train(ships, "model_based")
tm.export(run, "policy.geojson")
first, *later = [(float(row["LAT"]), float(row["LON"])) for row in csv.DictReader(open("one.csv"))]
tracker = run.policy.tracker(at=first)
for at in later:
    on = tracker.positions()  # latitude and longitude of the sensors to switch on
    cell = ships.cell_of(*at)
    print(len(on), on[0], cell if tracker.sees(cell) else "missed", sep="; ")
    tracker.report(cell if tracker.sees(cell) else None)
print(run.evaluation.accuracy)
"""
"""At most 15 lines of Python."""


def ais(file: Path, ships: int, seed: int) -> None:
    """Ships on three lanes off 54.5 N, 11 E, a report a minute, as AIS comes."""
    rng, rows = np.random.default_rng(seed), ["MMSI,BaseDateTime,LAT,LON"]
    north, east = 111_200.0, 111_200.0 * np.cos(np.radians(54.5))
    for ship in range(ships):
        way, speed = rng.choice([-1, 1]), rng.uniform(4, 8)
        x, y, minute = -5500.0 * way, 2000.0 * rng.integers(-1, 2) + rng.normal(0, 150), 0
        while abs(x) < 5600:
            stamp = np.datetime64("2026-01-01T00:00:00") + np.timedelta64(minute, "m")
            rows.append(f"{219_000_000 + ship},{stamp},{54.5 + y / north:.6f},{11 + x / east:.6f}")
            x, y = x + way * speed * 60 + rng.normal(0, 40), y + rng.normal(0, 60)
            minute += 1
    file.write_text("\n".join(rows) + "\n")


@pytest.mark.slow
def test_from_a_csv_of_positions_to_sensors_on_a_map(tmp_path: Path) -> None:
    """At most 15 lines and 60 seconds of processor time."""
    pytest.importorskip("pyproj")
    assert len(PROGRAM.splitlines()) <= 15
    ais(tmp_path / "ais.csv", 150, seed=0)
    ais(tmp_path / "one.csv", 1, seed=7)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    # Of the processor, not of the clock: other processes on the machine do not count.
    assert spent <= 60
    *steps, accuracy = done.stdout.splitlines()
    assert len(steps) == len((tmp_path / "one.csv").read_text().splitlines()) - 2
    located = [line for line in steps if not line.endswith("missed")]
    assert len(located) > 0.6 * len(steps)
    assert 0.8 < float(accuracy) < 1
    assert '"type": "FeatureCollection"' in (tmp_path / "policy.geojson").read_text()
