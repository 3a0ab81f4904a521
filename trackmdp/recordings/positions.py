"""Recorded positions of targets, report by report, and readers of the usual files.

A reader takes an open file and returns `Positions`; reports that are left out are counted. Reading is left to well-kept
libraries (the extra `tracks`), each imported when a file of its kind is met: tables of CSV and Parquet with their usual
columns, those of AIS and ADS-B among them, GeoJSON, GPX, MOT-Challenge text, SUMO's fcd-output.

Any error of a reader over a damaged file ends in one line (`track_files.read_positions`). XML is refused where it
declares a document type: no entity is ever expanded, and nothing is fetched.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, BinaryIO

import numpy as np

from trackmdp.arrays.files import first_line
from trackmdp.arrays.types import Array
from trackmdp.untrusted import parse_json

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
    piece: Any = 0,
    *,
    dropped: Mapping[str, int] | None = None,
    **are: Any,
) -> Positions:
    """`Positions` of columns as a file has them, in any order, some of them perhaps empty.

    Args:
        ids: of the targets, texts or numbers.
        times: seconds, or texts such as 2024-05-01T12:00:00Z.
        x: to the right, or degrees of longitude.
        y: upwards, or degrees of latitude.
        piece: numbers of the pieces that the file itself keeps apart; 0: each target's path is one.
        dropped: reports left out before.
        are: `geographic` and `downwards`, as of `Positions`.
    """
    import pandas as pd

    frame = pd.DataFrame(
        {"id": ids, "time": _seconds(pd.Series(times)), "x": _number(x, "x"), "y": _number(y, "y")}
    )
    frame["piece"] = piece
    # inf is no position either; AIS gives 91 and 181 degrees where the receiver of a ship knows none.
    finite = np.isfinite(frame[["time", "x", "y"]].to_numpy(dtype=np.float64)).all(axis=1)
    good = finite & frame["id"].notna()
    good &= ((frame["x"].abs() <= 180) & (frame["y"].abs() <= 90)) | (not are.get("geographic"))
    kept = frame[good].copy()
    kept["track"] = np.unique(kept["id"].astype(str), return_inverse=True)[1]
    # By several columns pandas sorts stably: of two reports at one time the one that comes first in the file counts.
    kept = kept.sort_values(["track", "piece", "time"])
    once = ~kept.duplicated(["track", "piece", "time"])
    counts = {NO_POSITION: int((~good).sum()), REPEATED: int((~once).sum())}
    kept = kept[once].copy()
    pieces = kept[["track", "piece"]]
    kept["piece"] = pieces.ne(pieces.shift()).any(axis=1).cumsum() - 1
    columns = {name: kept[name].to_numpy() for name in ("track", "piece", "time", "x", "y")}
    return Positions(**columns, **are, dropped={**(dropped or {}), **counts})


def _number(column: Any, name: str, expected: str = "a number") -> Any:
    """The numbers of a column, which `name` names where it has no name of its own.

    Raises:
        ValueError: one is no number.
    """
    import pandas as pd

    series = pd.Series(column)
    found = pd.to_numeric(series, errors="coerce").where(series.notna()).astype(np.float64)
    _refuse_entry(series, found, name, expected)
    return found


def _refuse_entry(column: Any, parsed: Any, name: str, expected: str) -> None:
    """Refuse the first entry of a column that could not be parsed: it is missing in `parsed`.

    Raises:
        ValueError: there is one; the message names the column and the entry.
    """
    wrong = np.flatnonzero(parsed.isna() & column.notna())
    if len(wrong):
        found = f"{column.name or name} of entry {wrong[0] + 1} is {column.iloc[wrong[0]]!r}"
        raise ValueError(f"{found}, expected {expected}") from None


def _seconds(column: Any) -> Any:
    """Times as seconds; of texts and dates those since 1970, a zone that is not named being UTC.

    Raises:
        ValueError: a text is no time.
    """
    import pandas as pd

    first = column.dropna().iloc[:1]
    # By the text, as of a file read without types: else 2000 would be a year, and a period a number of days.
    seconds = pd.to_numeric(first.astype(object).map(str), errors="coerce").notna().all()
    if seconds or first.empty:
        return _number(column, "time", "seconds or a time")
    # ISO 8601, as nearly all have it, or 31/12/2024 23:59:59 as the Danish AIS has it. Other orders of day and month
    # are not guessed.
    form = "%d/%m/%Y %H:%M:%S" if str(first.iloc[0])[2:3] == "/" else "ISO8601"
    try:
        stamps = pd.to_datetime(column, utc=True, format=form)
    except (TypeError, ValueError):
        dated = pd.to_datetime(column, utc=True, format=form, errors="coerce")
        _refuse_entry(column, dated, "time", "seconds or a time")
        raise
    return (stamps - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)


_PER_POINT = ("times", "coordTimes", "timestamps")
"""Properties of a line that hold one time for each of its points, as converters of GPX write them."""


def frame_positions(frame: Any, own: Sequence[str] = ()) -> Positions:
    """Positions in a DataFrame of pandas.

    Args:
        frame: a row for each report.
        own: names of its columns, such as ``id:device_id``; by default those of `ALIASES`.

    Raises:
        ValueError: a column is missing, or holds something else.
    """
    frame = frame.rename(columns=str)  # numbers, where a file had no line of names
    columns = _chosen_columns(frame.columns, own)
    return table_of(*(frame[name] for name in columns.values()), geographic="lon" in columns)


def position_table(stream: BinaryIO, own: Sequence[str] = ()) -> Positions:
    """A table of CSV or Parquet; `own` as of `frame_positions`."""
    # Parquet begins with these four bytes, under any file name.
    parquet = stream.read(4) == b"PAR1"
    stream.seek(0)
    names = _parquet_names(stream) if parquet else first_line(stream)
    columns = _chosen_columns(names, own)
    table = _read_parquet(stream, columns) if parquet else _read_csv(stream, names, columns)
    return table_of(*(table[name] for name in columns.values()), geographic="lon" in columns)


def _chosen_columns(names: Iterable[str], own: Sequence[str]) -> dict[str, str]:
    """Our name -> the name in the file, of id, time and then the position.

    Raises:
        ValueError: one is missing or there twice, or there are both x, y and lon, lat.
    """
    lowered = [name.strip().lower() for name in names]
    known = dict(zip(lowered, names, strict=True))
    given = {name: (each.lower(),) for name, _, each in (pair.partition(":") for pair in own)}
    usual = ALIASES | given
    there = ((ours, each) for ours in usual for each in reversed(usual[ours]) if each in known)
    found = {name: known[each] for name, each in there}  # the first one is the last set
    pairs = [pair for pair in (("x", "y"), ("lon", "lat")) if found.keys() >= {*pair}]
    pairs = [pair for pair in pairs if given.keys() & {*pair}] or pairs  # a file may have both
    missing = [
        f"{name} ({', '.join(usual[name][:3])})" for name in ("id", "time") if name not in found
    ]
    if missing or len(pairs) != 1:
        wanted = [*missing, *(["either x, y or lat, lon"] if len(pairs) != 1 else [])]
        hint = "" if own else ", or kernel.columns=[id:NAME,...]"
        header = ", ".join(known)[:80] or "none"
        raise ValueError(f"columns {header}: expected {' and '.join(wanted)}{hint}")
    chosen = {name: found[name] for name in ("id", "time", *pairs[0])}
    for name in chosen.values():
        if lowered.count(name.strip().lower()) > 1:
            raise ValueError(f"two columns called {name.strip()}, in small letters or capitals")
    return chosen


def _read_csv(stream: BinaryIO, names: Sequence[str], columns: Mapping[str, str]) -> Any:
    """The columns, of a stream after its first line."""
    from pyarrow import csv

    here = stream.tell()
    if not stream.read(1):
        return {name: [] for name in columns.values()}
    stream.seek(here)
    # Ids as text: the 0012 of a transponder is not 12, and hexadecimal ones such as 4e5 are no powers of ten. Arrow,
    # since pandas takes a line with a column too many for a good one where only some columns are wanted.
    options = csv.ConvertOptions(
        include_columns=list(columns.values()),
        column_types={columns["id"]: "string"},
        strings_can_be_null=True,
    )
    return csv.read_csv(
        stream, csv.ReadOptions(column_names=names), convert_options=options
    ).to_pandas()


def _parquet_names(stream: BinaryIO) -> list[str]:
    """The columns that hold one value for each row; lists may hold any number."""
    from pyarrow import parquet, types

    file = parquet.ParquetFile(stream)
    # Some bytes of a file may unfold to any number of equal values: its own claims are held against the limit first.
    groups = (file.metadata.row_group(place) for place in range(file.metadata.num_row_groups))
    widest = max(8, *(column.length for column in file.schema))  # a number, or bytes
    _check_unfolded(
        max(sum(group.total_byte_size for group in groups), widest * file.metadata.num_rows)
    )
    return [column.name for column in file.schema_arrow if not types.is_nested(column.type)]


def _read_parquet(stream: BinaryIO, columns: Mapping[str, str]) -> Any:
    from pyarrow import compute, parquet, types

    stream.seek(0)
    # Texts as a dictionary, as they are stored: every row may have the same text of megabytes.
    table = parquet.read_table(
        stream, columns=list(columns.values()), read_dictionary=list(columns.values())
    )
    for place, column in enumerate(table.columns):
        if types.is_dictionary(column.type):
            lengths = [
                compute.take(compute.binary_length(part.dictionary), part.indices)
                for part in column.chunks
            ]
            _check_unfolded(sum(compute.sum(each).as_py() or 0 for each in lengths))
            table = table.set_column(
                place, table.column_names[place], column.cast(column.type.value_type)
            )
    # What was an index of pandas is a column; ids beyond 2^53 stay whole where one is missing.
    return table.to_pandas(ignore_metadata=True, integer_object_nulls=True)


def _check_unfolded(size: int) -> None:
    if size > LONGEST:
        raise ValueError(f"{size:,} bytes once unfolded, expected at most {LONGEST:,}")


def geojson(stream: BinaryIO) -> Positions:
    """Features of GeoJSON (RFC 7946: degrees, longitude first) with times.

    A point has an id and a time among its properties; a line has a list of times there, one for each point, and is a
    target of its own where it has no id.
    """
    content = parse_json(stream.read(), "its content")
    features = content["features"] if content["type"] == "FeatureCollection" else [content]
    rows = [row for number, feature in enumerate(features) for row in _feature(feature, number)]
    return _of_rows(rows, geographic=True)


def _of_rows(rows: Sequence[tuple[Any, ...]], **are: Any) -> Positions:
    """`Positions` of rows id, time, x, y, piece; see `table_of`."""
    import pandas as pd

    # Else ids would be floats where one is missing, and two beyond 2^53 the same.
    frame = pd.DataFrame(rows, columns=("id", "time", "x", "y", "piece"), dtype=object)
    return table_of(*(frame[name] for name in frame), **are)


def _feature(feature: Mapping[str, Any], number: int) -> Iterator[tuple[Any, ...]]:
    """Rows id, time, longitude, latitude, piece."""
    # A feature without a geometry is allowed, and is nowhere.
    geometry, properties = feature["geometry"] or {}, feature.get("properties") or {}
    named = {name.lower(): value for name, value in properties.items()}
    own = next(
        (named[name] for name in ALIASES["id"] if named.get(name) is not None), feature.get("id")
    )
    kind = geometry.get("type")
    if kind == "Point":
        time = next((named[name] for name in ALIASES["time"] if name in named), None)
        yield own, time, *geometry["coordinates"][:2], 0
        return
    if kind not in ("LineString", "MultiLineString"):
        return
    single = kind == "LineString"
    lines = [geometry["coordinates"]] if single else geometry["coordinates"]
    per_point = {**properties, **properties.get("coordinateProperties", {})}
    times = next((per_point[name] for name in _PER_POINT if name in per_point), None)
    if times is None:
        raise ValueError(
            f"feature {number + 1}: expected a time for each point, as {' or '.join(_PER_POINT)}"
        )
    # Lines without an id must not become one target: two with the id 3 are two pieces of one path, two without are two.
    name = f"line {number}" if own is None else own
    for place, (line, stamps) in enumerate(zip(lines, [times] if single else times, strict=True)):
        for point, stamp in zip(line, stamps, strict=True):
            # Lines of other features with the same id are pieces of their own: 0 and 0.5, then 1, 1.33 and 1.67.
            yield name, stamp, *point[:2], number + place / len(lines)


def gpx(stream: BinaryIO) -> Positions:
    """The tracks of a GPX file, each a target; their segments, between which the receiver was off, stay apart."""
    import gpxpy
    from defusedxml.ElementTree import fromstring

    content = stream.read()
    fromstring(content, forbid_dtd=True)  # gpxpy's own parser would expand entities
    rows = [
        (number, point.time, point.longitude, point.latitude, piece)
        for number, track in enumerate(gpxpy.parse(content.decode("utf-8-sig")).tracks)
        for piece, segment in enumerate(track.segments)
        for point in segment.points
    ]
    return _of_rows(rows, geographic=True)


def mot(stream: BinaryIO) -> Positions:
    """Boxes of a tracker: frame, id, left, top, width, height, and perhaps confidence and more (MOT-Challenge).

    A target stands where the lower edge of its box has its middle. The unit of time is a frame, of length a pixel.
    """
    import pandas as pd

    table = pd.read_csv(stream, header=None, dtype="float64", encoding="utf-8-sig")
    if table.shape[1] < 6:
        raise ValueError(f"{table.shape[1]} columns, expected frame, id, left, top, width, height")
    frame, own, left, top, width, height = (table[place] for place in range(6))
    # In ground truth a confidence of 0 marks boxes that do not count; detections that no tracker has seen have the
    # id -1.
    ignored = (table[6] == 0) if table.shape[1] > 6 else frame != frame
    nobody = (own < 0) & ~ignored
    kept = ~ignored & ~nobody
    dropped = {IGNORED: int(ignored.sum()), NO_IDENTITY: int(nobody.sum())}
    columns = (own, frame, left + width / 2, top + height)
    return table_of(*(column[kept] for column in columns), downwards=True, dropped=dropped)


def sumo(stream: BinaryIO) -> Positions:
    """The output of SUMO's ``--fcd-output``: each time step with the vehicles and persons there, in metres."""
    from defusedxml.ElementTree import iterparse

    rows: list[tuple[Any, ...]] = []
    time: Any = None
    root = None
    # Not in pieces of 16 KiB, as iterparse asks for: expat before 2.6 looks through an unfinished value anew with each.
    pieces = SimpleNamespace(read=lambda _: stream.read(2**22))
    for event, element in iterparse(pieces, events=("start", "end"), forbid_dtd=True):
        if root is None:
            root = element
            if element.tag != "fcd-export":
                raise ValueError(f"<{element.tag}>, expected <fcd-export>")
        if event == "start":
            time = element.attrib["time"] if element.tag == "timestep" else time
        elif element.tag in ("vehicle", "person"):
            own = element.attrib
            rows.append((own["id"], float(time), own["x"], own["y"], 0))
        elif element.tag == "timestep":
            root.clear()  # finished elements are let go: files of gigabytes are usual
    return _of_rows(rows)
