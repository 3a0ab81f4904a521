"""Positions in tables: CSV and Parquet, with the columns that people have, those of AIS and ADS-B among them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, BinaryIO

from trackmdp.world.files import first_line
from trackmdp.world.positions import ALIASES, LONGEST, Positions, table_of


def position_table(stream: BinaryIO) -> Positions:
    """A table of CSV or Parquet."""
    # Parquet begins with these four bytes, whatever the file is called.
    parquet = stream.read(4) == b"PAR1"
    stream.seek(0)
    names = _parquet_names(stream) if parquet else first_line(stream)
    columns = _chosen_columns(names)
    table = _read_parquet(stream, columns) if parquet else _read_csv(stream, names, columns)
    return table_of(*(table[name] for name in columns.values()), geographic="lon" in columns)


def _chosen_columns(names: Iterable[str]) -> dict[str, str]:
    """Our name -> the name in the file, of id, time and then the position.

    Raises:
        ValueError: one is missing, or there are both x, y and lon, lat.
    """
    known = {name.strip().lower(): name for name in names}
    found = {own: next((known[each] for each in usual if each in known), None) for own, usual in ALIASES.items()}
    pairs = [pair for pair in (("x", "y"), ("lon", "lat")) if all(found[name] for name in pair)]
    missing = [f"{name} ({', '.join(ALIASES[name])})" for name in ("id", "time") if not found[name]]
    if missing or len(pairs) != 1:
        wanted = [*missing, *(["either x, y or lat, lon"] if len(pairs) != 1 else [])]
        raise ValueError(f"columns {', '.join(known)[:80]}: expected {' and '.join(wanted)}")
    return {name: str(found[name]) for name in ("id", "time", *pairs[0])}


def _read_csv(stream: BinaryIO, names: Sequence[str], columns: Mapping[str, str]) -> Any:
    """The columns, of a stream whose first line has been read."""
    from pyarrow import csv

    here = stream.tell()
    if not stream.read(1):
        return {name: [] for name in columns.values()}
    stream.seek(here)
    # Ids as text: the 0012 of a transponder is not 12, and hexadecimal ones such as 4e5 are no powers of ten. Arrow,
    # since pandas takes a line with a column too many for a good one where only some columns are wanted.
    options = csv.ConvertOptions(
        include_columns=list(columns.values()), column_types={columns["id"]: "string"}, strings_can_be_null=True
    )
    return csv.read_csv(stream, csv.ReadOptions(column_names=names), convert_options=options).to_pandas()


def _parquet_names(stream: BinaryIO) -> list[str]:
    """The columns that hold one value for each row; lists may hold any number."""
    from pyarrow import parquet, types

    file = parquet.ParquetFile(stream)
    # Some bytes of a file may unfold to any number of equal values: its own claims are held against the limit first.
    groups = (file.metadata.row_group(place) for place in range(file.metadata.num_row_groups))
    widest = max(8, *(column.length for column in file.schema))  # of numbers, and of bytes of a fixed length
    _check_unfolded(max(sum(group.total_byte_size for group in groups), widest * file.metadata.num_rows))
    return [column.name for column in file.schema_arrow if not types.is_nested(column.type)]


def _read_parquet(stream: BinaryIO, columns: Mapping[str, str]) -> Any:
    from pyarrow import compute, parquet, types

    stream.seek(0)
    # Texts as a dictionary, as they are stored: one text of megabytes may be that of every row.
    table = parquet.read_table(stream, columns=list(columns.values()), read_dictionary=list(columns.values()))
    for place, column in enumerate(table.columns):
        if types.is_dictionary(column.type):
            lengths = [compute.take(compute.binary_length(part.dictionary), part.indices) for part in column.chunks]
            _check_unfolded(sum(compute.sum(each).as_py() or 0 for each in lengths))
            table = table.set_column(place, table.column_names[place], column.cast(column.type.value_type))
    return table.to_pandas()


def _check_unfolded(size: int) -> None:
    if size > LONGEST:
        raise ValueError(f"{size:,} bytes once unfolded, expected at most {LONGEST:,}")
