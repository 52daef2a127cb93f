"""Archives of results: one for each archive of problems, with the same names in the same order.

A tar file has ``NAME.obj`` or ``NAME.ply``, the map, and ``NAME.json``, the record, for each problem. Between them are
the material library of the map, ``NAME.texture.mtl``, and its images. A Parquet file has the columns of the records,
``obj`` or ``ply``, and ``files``, the library and the images. The metadata of both identify the input and the settings.
"""

from __future__ import annotations

import json
import os
import posixpath
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.untrusted import parse_json
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.places import fetch, read_start
from quasiharmonic.ui.batch.records import Record, load_pyarrow
from quasiharmonic.ui.batch.samples import KEYS, is_archive, is_parquet, results_name
from quasiharmonic.ui.batch.tar_stream import (
    END_MARK,
    Damage,
    Member,
    global_comment,
    open_tar,
    pack_comment,
    pack_member,
    read_members,
)
from quasiharmonic.util.options import MAP_FORMATS

#: Suffix of the name of unfinished results.
PART = ".part"
# Extension of a record.
_RECORD = ".json"
# Column of the material library and the images of a map.
_FILES = "files"
# Bytes at the start of a tar file with its metadata.
_MAX_ABOUT = 1 << 16
_MARK = b"quasiharmonic"
_ROWS = 64


class Result(NamedTuple):
    """Result of a problem in an archive."""

    key: str  # Name of the problem in the archive
    record: Record
    data: bytes | None  # The map, if there is one and it was asked for
    form: str  # Format of the map, one of `MAP_FORMATS`
    files: Mapping[str, bytes] = {}  # Material library and images of the map, by their names in its folder


def read_about(location: str) -> dict[str, Any] | None:
    """Return the metadata of an archive of results, a path or URL; None if it is missing or invalid."""
    try:
        if is_parquet(location):
            with TemporaryDirectory() as folder:
                text = _read_mark(fetch(location, Path(folder)))
        else:
            text = global_comment(read_start(location, _MAX_ABOUT) or b"") or ""
        about = parse_json(text)
    except (FileNotFoundError, ValueError):
        return None
    return about if isinstance(about, dict) and {"stamp", "settings", "outcomes"} <= set(about) else None


def _read_mark(path: Path) -> str:
    """Return the metadata of a Parquet file; empty if it is missing or damaged."""
    try:
        with load_pyarrow().ParquetFile(path) as parquet:
            return (parquet.schema_arrow.metadata or {}).get(_MARK, b"").decode()
    except (OSError, ValueError):
        return ""


def write_results(path: Path, about: dict[str, Any], found: Iterable[Result], form: str) -> None:
    """Write an archive of results with maps of one format; it appears when it is complete and on the disk."""
    if is_parquet(path):
        write_whole(path, lambda file: _write_parquet(file, json.dumps(about), found, form))
    else:
        write_whole(path, lambda file: _write_tar(file, json.dumps(about), found))


def _write_tar(file: BinaryIO, about: str, found: Iterable[Result]) -> None:
    file.write(pack_comment(about))
    for result in found:
        file.write(pack_result(*result))
    file.write(END_MARK)


def pack_result(key: str, record: Record, data: bytes | None, form: str, files: Mapping[str, bytes]) -> bytes:
    """Return the members of a result in a tar file: the map, if there is one, its files, and the record after them."""
    packed = b"" if data is None else pack_member(f"{key}.{form}", data)
    packed += b"".join(pack_member(posixpath.join(posixpath.dirname(key), name), files[name]) for name in files)
    return packed + pack_member(key + _RECORD, json.dumps(record, allow_nan=False).encode() + b"\n")


def _write_parquet(file: BinaryIO, about: str, found: Iterable[Result], form: str) -> None:
    load_pyarrow()
    import pyarrow

    schema = records.table_schema()
    schema = schema.insert(0, pyarrow.field(KEYS[0], pyarrow.string())).append(pyarrow.field(form, pyarrow.binary()))
    schema = schema.append(pyarrow.field(_FILES, pyarrow.map_(pyarrow.string(), pyarrow.binary())))
    rows = (
        {KEYS[0]: key, **records.table_row(record), form: data, _FILES: list(files.items()) or None}
        for key, record, data, _, files in found
    )
    records.write_parquet(file, schema.with_metadata({_MARK: about}), rows, _ROWS)


def find_map(folder: Path, problem: str) -> tuple[bytes, str] | None:
    """Return the map of a problem and its format from the archives of results in a folder; None if there is none."""
    parts = problem.split("/")
    for k in range(1, len(parts)):
        path, key = folder / results_name("/".join(parts[:k])), "/".join(parts[k:])
        if is_archive(parts[k - 1]) and path.is_file():
            return _parquet_map(path, key) if is_parquet(path) else _tar_map(path, key)
    return None


def _tar_map(path: Path, key: str) -> tuple[bytes, str] | None:
    names = {f"{key}.{form}": form for form in MAP_FORMATS}
    with open_tar(os.fspath(path)) as file:
        for member in read_members(file, names.__contains__):
            if isinstance(member, Member) and member.data is not None:
                return member.data, names[member.name]
    return None


def _parquet_map(path: Path, key: str) -> tuple[bytes, str] | None:
    with load_pyarrow().ParquetFile(path) as file:
        form = _form_of(file)
    table = load_pyarrow().read_table(path, columns=[form], filters=[(KEYS[0], "=", key)])
    data = table[form][0].as_py() if len(table) else None
    return None if data is None else (data, form)


def _form_of(file: Any) -> str:
    """Return the format of the maps in a Parquet file of results."""
    return next(form for form in MAP_FORMATS if form in file.schema_arrow.names)


def find_records(folder: Path) -> Iterator[Record]:
    """Yield the records in the archives of results in a folder, finished or not."""
    for path in sorted(folder.rglob("*")):
        if is_archive(path.name.removesuffix(PART)):
            for result in read_results(path, maps=False):
                yield result.record


def read_results(path: Path, *, maps: bool = True) -> Iterator[Result]:
    """Yield the results in an archive, their maps only if requested.

    Damaged ones are skipped. OSError if the archive cannot be opened.
    """
    if is_parquet(path):
        yield from _parquet_results(path, maps)
    else:
        with open_tar(os.fspath(path)) as file:
            yield from (one.result for one in read_tar_results(file, maps=maps) if one.result is not None)


class TarResult(NamedTuple):
    """Result in a tar file."""

    result: Result | None  # None if it is damaged
    start: int  # Offset of its first header
    end: int  # Offset after it


def read_tar_results(file: BinaryIO, *, maps: bool = True) -> Iterator[TarResult]:
    """Read the results of a tar file, which have the record after the map and its files."""
    mapped: Member | None = None
    files: dict[str, bytes] = {}
    for member in read_members(file, lambda name: maps or name.endswith(_RECORD)):
        if isinstance(member, Damage):
            yield TarResult(None, member.start, member.start)
            continue
        key, extension = os.path.splitext(member.name)
        if extension[1:] in MAP_FORMATS:
            mapped, files = member, {}
        elif extension == _RECORD:
            name, form = ("", "") if mapped is None else os.path.splitext(mapped.name)
            own = mapped if name == key else None
            record = records.parse_record(member.data or b"")
            data, start = (None, member.start) if own is None else (own.data, own.start)
            result = None if record is None else Result(key, record, data, form[1:], files if own else {})
            yield TarResult(result, start, member.end)
            mapped, files = None, {}
        elif member.data is not None:
            files[posixpath.basename(member.name)] = member.data


def _parquet_results(path: Path, maps: bool) -> Iterator[Result]:
    with load_pyarrow().ParquetFile(path) as file:
        form = _form_of(file)
        columns = [name for name in file.schema_arrow.names if maps or name not in (form, _FILES)]
        for rows in file.iter_batches(_ROWS, columns=columns):
            for row in rows.to_pylist():
                key, data, files = row.pop(KEYS[0]), row.pop(form, None), dict(row.pop(_FILES, None) or ())
                yield Result(key, {name: value for name, value in row.items() if value is not None}, data, form, files)
