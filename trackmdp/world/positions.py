"""Recorded positions of targets, report by report.

A reader takes an open file and returns `Positions`; what it must leave out it counts. Reading is left to well-kept
libraries (the extra `tracks`), each imported when a file of its kind is met.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trackmdp.world.model import Array

LONGEST = 2**30
"""Bytes of the longest file, and of the longest unfolded table of a Parquet file."""

NO_POSITION = "reports without a time or a position"
REPEATED = "reports at a time seen before"
IGNORED = "boxes marked as not to be counted"
NO_IDENTITY = "boxes of nobody known"

ALIASES = {
    "id": ("mmsi", "icao24", "track_id", "trackid", "track", "vehicle_id", "vehicle", "id"),
    "time": ("time", "timestamp", "# timestamp", "basedatetime", "base_date_time", "datetime", "t"),
    "x": ("x", "easting"),
    "y": ("y", "northing"),
    "lon": ("lon", "longitude", "lng", "long"),
    "lat": ("lat", "latitude"),
}
"""Our name -> the names of a column, in small letters: of AIS (MarineCadastre, Danish Maritime Authority), of ADS-B
(OpenSky), and the usual ones. The first that is there counts: in ADS-B `track` is a heading, in exports `id` a row."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Where targets were seen, report by report, ordered by target, piece and time, each time once.

    Attributes:
        track: `[P]` number of the target, 0 ... in the order of the sorted ids.
        piece: `[P]` number of the uninterrupted piece of a path as the file has it; not shared between targets.
        time: `[P]` seconds, of video frames.
        x: `[P]` to the right: metres, degrees of longitude, of videos pixels.
        y: `[P]` upwards: metres, degrees of latitude; of videos downwards, pixels.
        geographic: whether x and y are degrees.
        downwards: whether y grows downwards.
        dropped: why reports were left out -> how many.
    """

    track: np.ndarray
    piece: np.ndarray
    time: Array
    x: Array
    y: Array
    geographic: bool = False
    downwards: bool = False
    dropped: Mapping[str, int] = field(default_factory=dict)

    @property
    def read(self) -> int:
        """Reports in the file."""
        return len(self.time) + sum(self.dropped.values())


def table_of(
    ids: Any,
    times: Any,
    x: Any,
    y: Any,
    piece: Any = None,
    *,
    geographic: bool = False,
    downwards: bool = False,
    dropped: Mapping[str, int] | None = None,
) -> Positions:
    """`Positions` of columns as a file has them, in any order, some of them perhaps empty.

    Args:
        ids: of the targets, texts or numbers.
        times: seconds, or texts such as 2024-05-01T12:00:00Z.
        x: to the right, or degrees of longitude.
        y: upwards, or degrees of latitude.
        piece: numbers of the pieces that the file itself keeps apart; None: each target's path is one.
        geographic: whether x and y are degrees.
        downwards: whether y grows downwards.
        dropped: what was left out before.
    """
    import pandas as pd

    frame = pd.DataFrame({"id": ids, "time": _seconds(pd.Series(times)), "x": _number(x), "y": _number(y)})
    frame["piece"] = 0 if piece is None else piece
    # inf is no position either; AIS says 91 and 181 degrees where the receiver of a ship knows none.
    good = np.isfinite(frame[["time", "x", "y"]].to_numpy(dtype=np.float64)).all(axis=1) & frame["id"].notna()
    good &= ((frame["x"].abs() <= 180) & (frame["y"].abs() <= 90)) | (not geographic)
    kept = frame[good].copy()
    kept["track"] = np.unique(kept["id"].astype(str), return_inverse=True)[1]
    # By several columns pandas sorts stably: of two reports at one time the one that comes first in the file counts.
    kept = kept.sort_values(["track", "piece", "time"])
    once = ~kept.duplicated(["track", "piece", "time"])
    counts = {NO_POSITION: int((~good).sum()), REPEATED: int((~once).sum())}
    kept = kept[once].copy()
    kept["piece"] = kept[["track", "piece"]].ne(kept[["track", "piece"]].shift()).any(axis=1).cumsum() - 1
    kinds = dict.fromkeys(("track", "piece"), np.int64) | dict.fromkeys(("time", "x", "y"), np.float64)
    columns = {name: kept[name].to_numpy(kind) for name, kind in kinds.items()}
    return Positions(**columns, geographic=geographic, downwards=downwards, dropped={**(dropped or {}), **counts})


def _number(column: Any) -> Any:
    import pandas as pd

    return pd.to_numeric(pd.Series(column), errors="raise").astype(np.float64)


def _seconds(column: Any) -> Any:
    """Times as seconds; of texts and dates those since 1970, a zone that is not named being UTC.

    Raises:
        ValueError: a text is no time.
    """
    import pandas as pd

    if pd.api.types.is_numeric_dtype(column) or column.isna().all():
        return _number(column)
    first = str(column.dropna().iloc[0])
    # ISO 8601, as nearly all have it, or 31/12/2024 23:59:59 as the Danish AIS has it. Other orders of day and month
    # are not guessed.
    form = "%d/%m/%Y %H:%M:%S" if first[2:3] == "/" else "ISO8601"
    stamps = pd.to_datetime(column, utc=True, format=form)
    return (stamps - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
