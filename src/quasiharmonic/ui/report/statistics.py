"""Numbers of a report: records as arrays, and their statistics."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.untrusted import parse_json
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.problems import MARKER
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.ui.batch.results import find_records
from quasiharmonic.util.arrays import FloatArray

PHASES = "read", "setup", "map", "polish", "write", "measure"


@dataclass(frozen=True)
class BatchRun:
    """Records of a run, or of another program on the same problems."""

    name: str  # Name on the page
    rows: list[Record]  # The records
    results: Path | None  # Folder of the maps, if it exists
    about: Record  # Contents of the run's marker file; empty if there is none

    @property
    def wanted(self) -> str:
        """Requested property of the maps: ``"bijective"`` if boundaries were free or models unwrapped."""
        free = any(row.get("outcome") in ("bijective", "not bijective") for row in self.rows)
        return "bijective" if free or self.about.get("settings", {}).get("flatten") is True else "injective"

    def column(self, name: str) -> FloatArray:
        """Return a column of numbers, NaN where there is none; (records,)."""
        values = (row.get(name) for row in self.rows)
        return np.array([np.nan if not _is_number(v) else v for v in values], dtype=np.float64)

    @property
    def certified(self) -> NDArray[np.bool_]:
        """Mask of the records whose map is certified as requested."""
        return np.array([row.get("certified") is True for row in self.rows], dtype=np.bool_)

    def certified_column(self, name: str) -> FloatArray:
        """Return the numbers of the certified records in a column, NaN where there is none."""
        return self.column(name)[self.certified]


def load(source: str | os.PathLike[str]) -> BatchRun:
    """Read the records of a run from its folder or a table; ValueError if there are none or they cannot be read."""
    path = Path(source)
    if not path.exists():
        raise ValueError(f"{source}: no such folder or table of records")
    if not path.is_dir():
        rows = list(records.read_table(path))
        folder = path.parent
    else:
        folder = path
        table = next((path / name for name in records.TABLES if (path / name).exists()), None)
        rows = list(_read_records(path / "results") if table is None else records.read_table(table))
    if not rows:
        raise ValueError(f"there are no records in {source}: give the folder of a run or a table of records")
    results = folder / "results"
    return BatchRun(path.resolve().name, rows, results if results.is_dir() else None, _about(folder))


def _about(folder: Path) -> Record:
    """Return the contents of a run's marker file; empty if it is missing or invalid."""
    try:
        about = parse_json((folder / MARKER).read_bytes())
    except (OSError, ValueError):
        return {}
    return about if isinstance(about, dict) and isinstance(about.get("settings"), dict) else {}


def _read_records(results: Path) -> Iterable[Record]:
    """Yield the existing records of a run without a table."""
    for path in sorted(results.rglob(records.FILE)):
        record = records.read_record(path.parent)
        if record is not None:
            yield record
    yield from find_records(results)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def groups(run: BatchRun) -> list[BatchRun]:
    """Return the records by the first part of the problems' names, and all of them, each as a run of its own."""
    parts: dict[str, list[Record]] = {}
    for row in run.rows:
        folder, slash, _ = row["problem"].partition("/")
        parts.setdefault(folder if slash else "", []).append(row)
    # More than 40 groups, for example one per problem, are not useful.
    named = sorted(parts) if 1 < len(parts) <= 40 else []
    return [*(replace(run, name=name, rows=parts[name]) for name in named), replace(run, name="all")]


def quantile(values: FloatArray, share: float) -> float:
    """Return a quantile of the finite values, NaN if there are none."""
    finite = values[np.isfinite(values)]
    return float(np.quantile(finite, share)) if finite.size else float("nan")


def find_worst(values: FloatArray) -> float:
    """Return the largest value, including infinity; NaN if there are no values."""
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else float("nan")


def outcomes(run: BatchRun) -> list[tuple[str, int]]:
    """Return the number of records per outcome, in the order of `records.OUTCOMES`; unknown outcomes come last."""
    guesses = {True: "injective", False: "not injective"}
    counted = Counter(str(row.get("outcome") or guesses[row.get("certified") is True]) for row in run.rows)
    order = [*records.OUTCOMES, *sorted(set(counted) - set(records.OUTCOMES))]
    return [(name, counted[name]) for name in order if counted[name]]


def match_column(run: BatchRun, other: BatchRun, column: str) -> tuple[FloatArray, FloatArray]:
    """Return a column of both runs for the problems that both contain."""
    theirs = {row["problem"]: row.get(column) for row in other.rows}
    pairs = [
        (row[column], theirs[row["problem"]])
        for row in run.rows
        if _is_number(row.get(column)) and _is_number(theirs.get(row["problem"]))
    ]
    ours, others = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    return ours, others
