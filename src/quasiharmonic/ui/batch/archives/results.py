"""Archives of results: one for each archive of problems, with the same names in the same order.

A tar file has ``NAME.obj``, the map, and ``NAME.json``, the record, for each problem. A Parquet file has the columns of
the records and ``obj``. The metadata of both identify the input and the settings.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from quasiharmonic.io.lowlevel.atomic import write_whole
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.archives.samples import KEYS, PARQUET, is_archive
from quasiharmonic.ui.batch.archives.tar_stream import (
    END_MARK,
    Damage,
    Member,
    global_comment,
    open_tar,
    pack_comment,
    read_members,
)
from quasiharmonic.ui.batch.records import Record, load_pyarrow
from quasiharmonic.util.untrusted import parse_json

#: Suffix of the name of unfinished results.
PART = ".part"
#: Extensions of map and record.
MAP, RECORD = ".obj", ".json"
#: Bytes at the start of a tar file with its metadata.
MAX_ABOUT = 1 << 16
_MARK = b"quasiharmonic"
_ROWS = 64


def results_name(name: str) -> str:
    """Return the name of the results of an archive: results are not compressed."""
    for suffix in (".tar.gz", ".tgz"):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)] + ".tar"
    return name


def is_parquet(path: Path) -> bool:
    """Whether a path is that of a Parquet file."""
    return path.name.lower().endswith(PARQUET)


def read_about(path: Path) -> dict[str, Any] | None:
    """Return the metadata of an archive of results; None if it is missing or invalid."""
    try:
        if is_parquet(path):
            with load_pyarrow().ParquetFile(path) as parquet:
                text = (parquet.schema_arrow.metadata or {})[_MARK].decode()
        else:
            with open(path, "rb") as file:
                return parse_about(file.read(MAX_ABOUT))
    except (OSError, ValueError, KeyError):
        return None
    return _parse_text(text)


def parse_about(start: bytes) -> dict[str, Any] | None:
    """Return the metadata of a tar file of results with these first bytes; None if they are invalid."""
    return _parse_text(global_comment(start) or "")


def _parse_text(text: str) -> dict[str, Any] | None:
    try:
        about = parse_json(text)
    except ValueError:
        return None
    return about if isinstance(about, dict) and {"stamp", "settings", "outcomes"} <= set(about) else None


def describe(found: Iterable[Record], stamp: str, settings: str) -> dict[str, Any]:
    """Return the metadata of an archive of results.

    ``found`` are its records, ``stamp`` identifies the version of its archive of problems, and ``settings`` is their
    digest.
    """
    counts = Counter((one["outcome"], one.get("time_limit"), one.get("memory_limit")) for one in found)
    return {"stamp": stamp, "settings": settings, "outcomes": [[*kind, count] for kind, count in counts.items()]}


def outcomes(about: dict[str, Any]) -> Iterator[tuple[Record, int]]:
    """Yield outcome and limits of the records that the metadata count, and their numbers."""
    for outcome, time_limit, memory_limit, count in about["outcomes"]:
        yield {"outcome": outcome, "time_limit": time_limit, "memory_limit": memory_limit}, count


def write_tar(path: Path, about: dict[str, Any], members: Iterable[bytes]) -> None:
    """Write packed members as an archive of results; it appears when it is complete and on the disk."""

    def write(file: BinaryIO) -> None:
        file.write(pack_comment(json.dumps(about)))
        for member in members:
            file.write(member)
        file.write(END_MARK)

    write_whole(path, write)


def write_parquet(path: Path, about: dict[str, Any], results: Iterable[tuple[str, Record, bytes | None]]) -> None:
    """Write names, records and maps as an archive of results; it appears when it is complete and on the disk."""
    load_pyarrow()
    import pyarrow

    schema = records.table_schema()
    schema = schema.insert(0, pyarrow.field(KEYS[0], pyarrow.string())).append(pyarrow.field("obj", pyarrow.binary()))
    schema = schema.with_metadata({_MARK: json.dumps(about)})
    rows = ({KEYS[0]: key, **records.table_row(record), "obj": data} for key, record, data in results)
    write_whole(path, lambda file: records.write_parquet(file, schema, rows, _ROWS))


def find_map(folder: Path, problem: str) -> bytes | None:
    """Return the map of a problem from the archives of results in a folder; None if there is none."""
    parts = problem.split("/")
    for k in range(1, len(parts)):
        path, key = folder / results_name("/".join(parts[:k])), "/".join(parts[k:])
        if is_archive(parts[k - 1]) and path.is_file():
            return _parquet_map(path, key) if is_parquet(path) else _tar_map(path, key)
    return None


def _tar_map(path: Path, key: str) -> bytes | None:
    with open_tar(os.fspath(path)) as file:
        for member in read_members(file, lambda name: name == key + MAP):
            if isinstance(member, Member) and member.data is not None:
                return member.data
    return None


def _parquet_map(path: Path, key: str) -> bytes | None:
    table = load_pyarrow().read_table(path, columns=["obj"], filters=[(KEYS[0], "=", key)])
    return table["obj"][0].as_py() if len(table) else None


def find_records(folder: Path) -> Iterator[Record]:
    """Yield the records in the archives of results in a folder, finished or not."""
    for path in sorted(folder.rglob("*")):
        if is_archive(path.name.removesuffix(PART)):
            for _, record, _ in read_results(path, maps=False):
                yield record


def read_results(path: Path, *, maps: bool = True) -> Iterator[tuple[str, Record, bytes | None]]:
    """Yield name, record and, if requested, the map of the results in an archive.

    Damaged ones are skipped. OSError if the archive cannot be opened.
    """
    yield from _parquet_results(path, maps) if is_parquet(path) else _tar_results(path, maps)


class TarResult(NamedTuple):
    """Result in a tar file."""

    key: str
    record: Record | None  # None if it is damaged
    data: bytes | None  # The map, if there is one and it was asked for
    start: int  # Offset of its first header
    end: int  # Offset after it


def read_tar_results(file: BinaryIO, *, maps: bool = True) -> Iterator[TarResult | Damage]:
    """Read the results of a tar file, which have the record after the map."""
    mapped: Member | None = None
    for member in read_members(file, lambda name: maps or name.endswith(RECORD)):
        if isinstance(member, Damage):
            yield member
            continue
        key, extension = os.path.splitext(member.name)
        if extension == MAP:
            mapped = member
        elif extension == RECORD:
            own = mapped if mapped is not None and mapped.name == key + MAP else None
            record = records.parse_record(member.data or b"")
            data, start = (None, member.start) if own is None else (own.data, own.start)
            yield TarResult(key, record, data, start, member.end)
            mapped = None


def _tar_results(path: Path, maps: bool) -> Iterator[tuple[str, Record, bytes | None]]:
    with open_tar(os.fspath(path)) as file:
        for one in read_tar_results(file, maps=maps):
            if isinstance(one, TarResult) and one.record is not None:
                yield one.key, one.record, one.data


def _parquet_results(path: Path, maps: bool) -> Iterator[tuple[str, Record, bytes | None]]:
    with load_pyarrow().ParquetFile(path) as file:
        columns = [name for name in file.schema_arrow.names if maps or name != "obj"]
        for rows in file.iter_batches(_ROWS, columns=columns):
            for row in rows.to_pylist():
                key, data = row.pop(KEYS[0]), row.pop("obj", None)
                yield key, {name: value for name, value in row.items() if value is not None}, data
