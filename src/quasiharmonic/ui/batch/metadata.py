"""Values of a record that describe one solved problem: sizes, stages, the map, its distortion, times, memory, versions.

The functions ``describe_…`` return fields of a record, and `time_phase` adds one. `records.COLUMNS` lists all fields.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from quasiharmonic import __version__
from quasiharmonic.energies.measures import distortion
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.ui.batch.records import Record, describe_contents
from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.outcome import replace_nonfinite

# Written to /proc/self/clear_refs, this number resets the peak resident memory (VmHWM) of the process; see proc(5).
_RESET_PEAK = "5"


def describe_sizes(problems: list[Problem]) -> Record:
    """Return the total sizes of the problems of a mesh's islands."""
    return {
        "vertices": sum(problem.n for problem in problems),
        "triangles": sum(len(problem.F) for problem in problems),
        "fixed": sum(len(problem.fixed) for problem in problems),
        "pins": sum(len(problem.domain.pins) for problem in problems),
        "loops": sum(len(problem.domain.loops) for problem in problems),
        "islands": len(problems),
    }


def describe_search(results: Sequence[MapResult], status: Status) -> Record:
    """Return status, stages and linear solver of the maps of a mesh's islands."""
    stages = [stage for result in results for stage in result.stages]
    return {
        "status": status.name.lower(),
        "iterations": sum(stage.n_iterations for stage in stages),
        "stages": json.dumps([stage.to_dict() for stage in stages]),
        "linear_solver": results[0].linear_solver,
    }


def describe_map(path: Path, required: str, certified: bool, bijective: bool, inverted: int | None) -> Record:
    """Return the exact results for a written map, which was required to be ``"injective"`` or ``"bijective"``.

    The number of inverted triangles is None if charts may be mirrored.
    """
    return {
        "outcome": required if certified else f"not {required}",
        "certified": certified,
        "bijective": bijective,
        "flips_after": inverted,
        **describe_contents(path.read_bytes()),
    }


def describe_distortion(V: FloatArray, F: IntArray, uv: FloatArray) -> Record:
    """Return the distortion of a map; empty if no triangle has an area in the rest mesh."""
    found = distortion(V, F, uv)
    if len(found.flat) == len(F):
        return {}
    values = {"mips": found.statistics("mips").mean, "isometric": found.statistics("isometric").maximum}
    return {name: replace_nonfinite(value) for name, value in values.items()}


@contextmanager
def time_phase(record: Record, phase: str) -> Iterator[None]:
    """Add the wall time of a block to the given phase of a record."""
    began = time.perf_counter()
    try:
        yield
    finally:
        name = f"seconds_{phase}"
        record[name] = record.get(name, 0.0) + time.perf_counter() - began


@cache
def list_versions() -> str:
    """Return the versions of Python and packages as JSON."""
    packages = {name: version(name) for name in ("numpy", "scipy")}
    return json.dumps({"quasiharmonic": __version__, "python": platform.python_version(), **packages})


def reset_peak() -> None:
    """Reset the peak memory of this process, where the system supports it (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text(_RESET_PEAK, encoding="utf-8")


def measure_peak() -> int | None:
    """Return the peak resident memory in bytes; None if the system does not report it.

    On Linux it is the peak since `reset_peak`, on other systems since the start of this process.
    """
    with suppress(OSError, IndexError):
        return 1024 * int(Path("/proc/self/status").read_text(encoding="utf-8").split("VmHWM:")[1].split()[0])
    try:
        import resource
    except ImportError:
        return _measure_peak_on_windows()
    max_rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return max_rss if sys.platform == "darwin" else 1024 * max_rss


def _measure_peak_on_windows() -> int | None:
    try:
        import psutil
    except ImportError:
        return None
    return getattr(psutil.Process().memory_info(), "peak_wset", None)
