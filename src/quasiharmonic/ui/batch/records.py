"""Records of the outcome of every problem: one JSON file each, and all of them as a table.

A problem is finished when its record's file exists. Tables are written from these files in batches of rows.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Iterable, Iterator
from hashlib import blake2b
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from quasiharmonic.io.atomic import remove_file, write_whole, writing
from quasiharmonic.io.errors import MeshFileError, check_path, report_damage
from quasiharmonic.io.formats.obj import write_obj
from quasiharmonic.io.formats.ply import write_ply
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.untrusted import parse_json
from quasiharmonic.util.hints import explain_missing
from quasiharmonic.util.options import MAP_FORMATS

Record = dict[str, Any]

#: Outcomes of a problem, with descriptions.
OUTCOMES: dict[str, str] = {
    "injective": "certified injective",
    "not injective": "no injective map found",
    "bijective": "certified bijective",
    "not bijective": "no bijective map found",
    "invalid": "with unusable input",
    "error": "unexpected error",
    "timeout": "over the time limit",
    "memory": "over the memory limit",
    "crash": "process died",
}

#: Outcomes of solved problems, and outcomes determined by certifying the written map.
SOLVED = "injective", "bijective"
JUDGED = *SOLVED, "not injective", "not bijective"

#: Columns of a table, in order, with their types; every value may be empty.
COLUMNS: dict[str, type] = {
    "problem": str,
    "source": str,
    # One of `OUTCOMES`.
    "outcome": str,
    # Exact results for the written map. `certified`: injective, or bijective if the boundary is free, as requested.
    # `bijective`: whether it is bijective in either case.
    "certified": bool,
    "bijective": bool,
    # The name of a `quasiharmonic.Status`.
    "status": str,
    "vertices": int,
    "triangles": int,
    "fixed": int,
    "pins": int,
    "loops": int,
    # Number of islands, which are mapped separately, of edges cut to create them, and of vertices added by refinement.
    "islands": int,
    "cut_edges": int,
    "added_vertices": int,
    # The refinement stage that was reached, if refinement was allowed.
    "rung": str,
    # Inverted or degenerate triangles in the initial map of the search, and in the written map.
    "flips_before": int,
    "flips_after": int,
    "iterations": int,
    # The stages that ran, as JSON: see `quasiharmonic.results.Stage`.
    "stages": str,
    # Wall time from reading the file to writing the record, and of its phases.
    "seconds": float,
    "seconds_read": float,
    "seconds_setup": float,
    "seconds_map": float,
    "seconds_polish": float,
    "seconds_write": float,
    "seconds_measure": float,
    # Mean of σ₁/σ₂ + σ₂/σ₁ − 2 (§10), and the largest max(σ₁, 1/σ₂) after scaling to the surface's area.
    "mips": float,
    "isometric": float,
    # Of an unwrapped model: charts, length of the seams, stretch that 99 % of the surface keep, used share of the
    # texture, and what was cleaned.
    "charts": int,
    "seam_length": float,
    "stretch": float,
    "utilisation": float,
    "cleaned": str,
    # Final mean energy of the flattening of a connected surface.
    "energy": float,
    # Peak resident memory of the process, bytes.
    "peak_memory": int,
    "linear_solver": str,
    "threads": int,
    "time_limit": float,
    "memory_limit": int,
    # Versions of Python and packages, as JSON.
    "versions": str,
    "error": str,
    # Digest of the input and the settings.
    "key": str,
    # Length and digest of the written map.
    "map_bytes": int,
    "map_digest": str,
}

#: File names of the tables of a run.
TABLES = "records.csv", "records.parquet"
#: File name of the record in the folder of a problem's results.
FILE = "record.json"
# Start of the names of the material library of a map and its images.
_LIBRARY = "map-texture"
_ROWS = 1000
_NO_TABLE = "cannot be read as a table: "


def map_path(folder: Path, form: str) -> Path:
    """Return the path of a problem's map, in one of `MAP_FORMATS`, in the folder of its results."""
    return folder / f"map.{form}"


def write_map(path: Path, mesh: MeshData) -> None:
    """Write a map without waiting for the disk, which would take longer than most problems.

    `is_intact` detects truncated and damaged files. OutputError if it cannot be written.
    """
    (write_ply if path.suffix == ".ply" else write_obj)(path, mesh, durable=False)


def write_record(folder: Path, record: Record) -> None:
    """Write the record of a problem into the folder of its results; OutputError if it cannot be written."""
    write_whole(folder / FILE, json.dumps(record, allow_nan=False).encode() + b"\n", durable=False)


def read_record(folder: Path) -> Record | None:
    """Read the record of a problem; return None if it is missing or incomplete."""
    try:
        return parse_record((folder / FILE).read_bytes())
    except OSError:
        return None


def parse_record(data: bytes) -> Record | None:
    """Return the record in the contents of a file; None if it is incomplete."""
    try:
        record = parse_json(data)
    except ValueError:
        return None
    return record if isinstance(record, dict) and _is_whole(record) else None


def _is_whole(record: Record) -> bool:
    """Whether a record names its problem and outcome, and all values have the types of their columns."""

    def fits(value: Any, kind: type) -> bool:
        return value is None or isinstance(value, kind) or (kind is float and isinstance(value, int))

    named = bool(record.get("problem")) and bool(record.get("outcome"))
    return named and all(fits(record.get(column), kind) for column, kind in COLUMNS.items())


def clear(folder: Path) -> None:
    """Create the folder of a problem's results, and delete results of an earlier attempt, the record first.

    OutputError if the folder cannot be created or emptied, FileInUseError if another program has one of its files open.
    """
    with writing(f"results to {folder}"):
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            remove_results(folder)


def remove_results(folder: Path) -> None:
    """Delete the results in a folder, the record first; OSError if that fails."""
    maps = [map_path(folder, form) for form in MAP_FORMATS]
    for path in (folder / FILE, *maps, *folder.glob(".qhm-*.tmp"), *folder.glob(_LIBRARY + "*")):
        remove_file(path)


def describe_contents(data: bytes) -> Record:
    """Return the part of a record that identifies the contents of its map."""
    return {"map_bytes": len(data), "map_digest": blake2b(data, digest_size=8).hexdigest()}


def read_map(path: Path) -> bytes | None:
    """Return the contents of a map, its library or an image; None if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError:
        return None


def read_library(folder: Path, data: bytes, stem: str) -> tuple[bytes, dict[str, bytes]]:
    """Return a map, and its material library and images by name; the names begin with ``stem``."""
    contents = {path.name: read_map(path) for path in sorted(folder.glob(_LIBRARY + "*"))}
    found = {stem + name.removeprefix(_LIBRARY): file for name, file in contents.items() if file is not None}
    if not found:
        return data, {}
    named = re.compile(rb"^(mtllib|map_K[de]|norm) " + _LIBRARY.encode(), re.MULTILINE)

    def rename(text: bytes, count: int = 0) -> bytes:
        return named.sub(lambda match: match[1] + b" " + os.fsencode(stem), text, count)

    return rename(data, 1), {name: rename(file) if name.endswith(".mtl") else file for name, file in found.items()}


def is_intact(record: Record, data: bytes | None) -> bool:
    """Whether a record has no map, or these are the contents of its map."""
    return record.get("map_bytes") is None or (data is not None and describe_contents(data).items() <= record.items())


def write_table(path: str | os.PathLike[str], records: Iterable[Record]) -> None:
    """Write records as one table; the file is replaced only when complete, and memory use is constant.

    Parameters
    ----------
    path : path
        ``.csv`` or ``.parquet``.
    records : iterable of dict
        Values by the names of `COLUMNS`; missing values are left empty.

    Raises
    ------
    ValueError
        If the suffix is not supported.
    ImportError
        If the suffix is ``.parquet`` and pyarrow is not installed.
    OutputError
        If it cannot be written.
    """
    if _suffix(path) == ".csv":
        write_whole(path, lambda file: _write_csv(file, records))
    else:
        load_pyarrow()
        write_whole(path, lambda file: write_parquet(file, table_schema(), map(table_row, records), _ROWS))


def check_table(path: str | os.PathLike[str]) -> None:
    """Check whether a table of this name can be written; raise the errors of `write_table`."""
    if _suffix(path) == ".parquet":
        load_pyarrow()


def read_table(path: str | os.PathLike[str]) -> Iterator[Record]:
    """Read a table, one record at a time.

    Parameters
    ----------
    path : path
        ``.csv`` or ``.parquet``, from `write_table` or from another program.

    Yields
    ------
    dict
        Values by column, None where empty. Values of unknown columns are not converted.

    Raises
    ------
    MeshFileError
        If the file cannot be read as a table, has no column ``problem``, or a value does not have its column's type.
    ValueError
        If the suffix is not supported.
    ImportError
        If the suffix is ``.parquet`` and pyarrow is not installed.
    """
    rows = _csv_rows(path) if _suffix(path) == ".csv" else _parquet_rows(path)
    for number, row in enumerate(rows, 1):
        if row.get("problem") in (None, ""):
            raise MeshFileError(path, f"record {number} has no problem", remedy="a column `problem` is needed")
        yield {column: _convert(path, number, column, value) for column, value in row.items()}


def _suffix(path: str | os.PathLike[str]) -> str:
    check_path("path", path)
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise ValueError(f"{os.fspath(path)!r}: a table of records must be .csv or .parquet")
    return suffix


def load_pyarrow() -> Any:
    """Return the module `pyarrow.parquet`; ImportError with the install command if it is missing."""
    with explain_missing("Parquet needs pyarrow", extra="batch", hint=", or choose .csv"):
        import pyarrow.parquet
    return pyarrow.parquet


def _plain(value: Any) -> Any:
    """Return a value for a table; strings that are not valid Unicode are escaped."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _write_csv(file: BinaryIO, records: Iterable[Record]) -> None:
    text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
    table = csv.writer(text)
    table.writerow(COLUMNS)
    table.writerows([_plain(record.get(column)) for column in COLUMNS] for record in records)
    text.detach()


def table_schema() -> Any:
    """Return the pyarrow schema of a table."""
    import pyarrow

    names = {str: pyarrow.string(), bool: pyarrow.bool_(), int: pyarrow.int64(), float: pyarrow.float64()}
    return pyarrow.schema([(column, names[kind]) for column, kind in COLUMNS.items()])


def table_row(record: Record) -> Record:
    """Return the values of a record for all columns of a table."""
    return {column: _plain(record.get(column)) for column in COLUMNS}


def write_parquet(file: BinaryIO, schema: Any, rows: Iterable[Record], together: int) -> None:
    """Write rows with a pyarrow schema, some together, so that memory use is constant."""
    import pyarrow

    rest = iter(rows)
    with load_pyarrow().ParquetWriter(file, schema) as writer:
        while some := list(islice(rest, together)):
            writer.write_table(pyarrow.Table.from_pylist(some, schema=schema))


def _csv_rows(path: str | os.PathLike[str]) -> Iterator[Record]:
    damage = OSError, UnicodeDecodeError, csv.Error
    with report_damage(path, _NO_TABLE, damage), open(path, encoding="utf-8-sig", newline="") as file:
        for row in csv.DictReader(file):
            row.pop(None, None)  # values after the last column
            yield row


def _parquet_rows(path: str | os.PathLike[str]) -> Iterator[Record]:
    parquet = load_pyarrow()
    import pyarrow

    with report_damage(path, _NO_TABLE, (OSError, pyarrow.ArrowException)), parquet.ParquetFile(path) as file:
        for batch in file.iter_batches(_ROWS):
            yield from batch.to_pylist()


def _convert(path: str | os.PathLike[str], number: int, column: str, value: Any) -> Any:
    """Convert a table value to its column's type; CSV has only text, and other programs may use numbers as names."""
    if value is None or value == "":
        return None
    kind = COLUMNS.get(column)
    if kind is str:
        return str(value)
    if not isinstance(value, str) or kind is None:
        return value
    try:
        return {"true": True, "false": False}[value.lower()] if kind is bool else kind(value)
    except (ValueError, KeyError):
        raise MeshFileError(path, f"record {number}: {value!r} is not a valid {kind.__name__} for {column}") from None
