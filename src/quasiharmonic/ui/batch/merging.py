"""Merge the tables of records of several runs, such as the shards of an array, into one."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from quasiharmonic.io.errors import check_path
from quasiharmonic.io.lowlevel.atomic import new_folder, write_whole
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.problems import MARKER
from quasiharmonic.ui.batch.shards import WHOLE, Shard, lock_folder, lock_name, marker_name, shard_of, table_name
from quasiharmonic.util.untrusted import parse_json


class Merged(NamedTuple):
    """Result of a merge.

    Attributes
    ----------
    total : int
        Number of records.
    solved : int
        Number of problems with a map certified as requested.
    missing : tuple of str
        Shards without a table, as ``"i/n"``.
    """

    total: int
    solved: int
    missing: tuple[str, ...]


def merge(sources: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str], *, table: str = "csv") -> Merged:
    """Join the tables of the shards of a data set, or of several runs, into the table of one run.

    Parameters
    ----------
    sources : sequence of paths
        Folders of runs. Each has tables of shards, ``records-i-of-n.csv`` or ``.parquet``, or one table ``records``.
    output : path
        Folder for the table, ``records.csv`` or ``.parquet``; created if necessary. It may be one of the sources.
    table : {"csv", "parquet"}
        Format of the table.

    Returns
    -------
    Merged
        Number of records, and the shards whose tables are missing.

    Raises
    ------
    ValueError
        If a folder has no tables, the tables have different settings, the tables belong to different numbers of
        shards, or two of them belong to the same shard.
    MeshFileError
        If a table cannot be read.
    OutputError
        If the table cannot be written.
    ImportError
        If a table is Parquet and pyarrow is not installed.
    """
    check_path("output", output)
    folders = [Path(os.path.abspath(one)) for one in sources]
    folder = Path(os.path.abspath(output))
    target = folder / table_name(WHOLE, table)
    records.check_table(target)
    tables, missing = _find_tables(folders, target)
    marker = _common_marker(tables)
    found = {"total": 0, "solved": 0}

    def rows() -> Iterator[records.Record]:
        for path in tables:
            for record in records.read_table(path):
                found["total"] += 1
                found["solved"] += record.get("outcome") in records.SOLVED
                yield record

    lock = lock_name(WHOLE)
    with new_folder(folder, leftovers=frozenset({lock})), lock_folder(folder, lock):
        if not (folder / MARKER).exists():
            write_whole(folder / MARKER, marker)
        records.write_table(target, rows())
    return Merged(found["total"], found["solved"], missing)


def _find_tables(folders: Sequence[Path], target: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the tables of some folders, in the order of the shards, and the shards that have none."""
    shards: dict[Shard, Path] = {}
    others = []
    for folder in folders:
        here = {shard: path for path in sorted(folder.glob("records-*")) if (shard := shard_of(path.name)) is not None}
        whole = [folder / name for name in records.TABLES if (folder / name).exists() and folder != target.parent]
        if not here and not whole:
            raise ValueError(f"{folder}: there is no table of records of a finished run or shard")
        for shard, path in here.items():
            if shard in shards:
                raise ValueError(f"{shards[shard]} and {path} belong to the same shard: omit one of the folders")
            shards[shard] = path
        others += [] if here else whole[:1]
    counts = {shard.total for shard in shards}
    if len(counts) > 1:
        numbers = " and ".join(map(str, sorted(counts)))
        raise ValueError(f"the tables belong to {numbers} shards: delete those of one number")
    missing = [Shard(i, n) for n in counts for i in range(1, n + 1) if Shard(i, n) not in shards]
    ordered = [shards[shard] for shard in sorted(shards)]
    return ordered + others, tuple(f"{shard.number}/{shard.total}" for shard in missing)


def _common_marker(tables: Sequence[Path]) -> bytes:
    """Return the contents of the marker files of the tables; ValueError if their settings differ."""
    first: tuple[Path, dict[str, Any]] | None = None
    contents = b""
    for table in tables:
        marker = table.with_name(marker_name(shard_of(table.name) or WHOLE))
        if not marker.exists():
            marker = table.with_name(MARKER)
        try:
            here = marker.read_bytes()
            settings = parse_json(here)["settings"]
            settings.items()
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{table.parent} is not the folder of a run: it has no valid {marker.name}") from error
        if first is None:
            first, contents = (table, settings), here
        others = first[1]
        differing = [name for name in {**others, **settings} if others.get(name) != settings.get(name)]
        if differing:
            listed = ", ".join(f"{name} ({others.get(name)} and {settings.get(name)})" for name in differing)
            raise ValueError(
                f"{first[0]} and {table} have different settings, {listed}: solve one of them again with the settings "
                "of the other"
            )
    return contents
