"""One process that solves problems one after another: jobs come on standard input, answers go to standard output.

Both are lines of JSON. Nothing a problem does is let out: it ends in a record, which is written next to the
map before the answer is given, or in the death of this process, which `quasiharmonic.batch.supervisor` records.
"""

from __future__ import annotations

import faulthandler
import json
import os
import platform
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import __version__, io
from quasiharmonic.batch import records
from quasiharmonic.batch.records import Record
from quasiharmonic.curves import Curve, Rails
from quasiharmonic.energy.measures import distortion
from quasiharmonic.energy.polishing import polish_map
from quasiharmonic.energy.sliding import moved_onto
from quasiharmonic.exact.certificate import certify
from quasiharmonic.flattening.flattened import flatten, flattenable
from quasiharmonic.mesh.topology import boundary_loops
from quasiharmonic.problem import Problem
from quasiharmonic.result import MapResult, Stage, Status
from quasiharmonic.search.solving import solve

#: What a process says when it has imported what it needs.
READY = "ready"
# Seconds beyond the time limit after which the system ends this process, should nobody be left to do so.
GRACE = 10.0


def serve() -> None:
    """Solve what comes on standard input until that ends, whatever is going on then."""
    # Ctrl-C reaches the whole group; the parent decides what becomes of this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)
    # What libraries print must not come between the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="ascii")
    os.dup2(2, 1)

    def tell(message: dict[str, Any]) -> None:
        try:
            answers.write(json.dumps(message, allow_nan=False) + "\n")
            answers.flush()
        except OSError:
            # Whoever listened has gone, which is no fault of the problem and must not get into its record.
            os._exit(0)

    jobs: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(jobs,), daemon=True).start()
    tell({READY: True})
    while True:
        job = json.loads(jobs.get())
        _alarm(job["time_limit"])
        try:
            record = solve_files(job, tell)
        except io.OutputError as error:
            tell({"stop": str(error)})
        else:
            tell({"outcome": record["outcome"], "seconds": record["seconds"]})
        _alarm(None)


def _listen(jobs: SimpleQueue[bytes]) -> None:
    # Not sys.stdin, which the interpreter cannot close at its end while it is being waited at.
    with os.fdopen(os.dup(0), "rb") as source:
        for line in source:
            jobs.put(line)
    # Whoever gave the jobs has gone, and nobody waits for the one at hand.
    os._exit(0)


def _alarm(limit: float | None) -> None:
    """Have the system end this process some time after the limit: also if it hangs where no thread can see its end."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0 if limit is None else limit + GRACE)


def solve_files(job: dict[str, Any], tell: Callable[[dict[str, Any]], None]) -> Record:
    """Solve one problem and write its map and its record.

    Parameters
    ----------
    job : dict
        ``mesh`` and ``fixed``, paths; ``folder``, where results go; ``settings``, as `Settings.to_dict` has them;
        ``record``, what is known of the record beforehand.
    tell : callable
        Called with ``{"facts": …}`` once it is known how large the problem is.

    Returns
    -------
    dict
        The record as written.

    Raises
    ------
    OutputError
        When map or record cannot be written, which is no fault of the problem.
    """
    folder = Path(job["folder"])
    records.clear(folder)
    _forget_peak()
    began = time.perf_counter()
    record: Record = {**job["record"], "versions": _versions()}
    try:
        fill_record(job, folder, record, tell)
    except io.OutputError:
        raise
    except MemoryError as error:
        record |= {"outcome": "memory", "certified": False, "error": str(error) or "out of memory"}
    except Exception as error:
        # What is wrong with the input shows before its sizes are known.
        wrong_input = isinstance(error, ValueError) and "vertices" not in record
        record |= {"outcome": "invalid", "error": str(error)} if wrong_input else _unexpected(error)
    record["peak_memory"] = _peak()
    record["seconds"] = time.perf_counter() - began
    records.write_record(folder, record)
    return record


def fill_record(job: dict[str, Any], folder: Path, record: Record, tell: Callable[[dict[str, Any]], None]) -> None:
    """Read, solve, write, judge, measure; what is found goes into the record as soon as it is known."""
    settings = job["settings"]
    with _timed(record, "read"):
        mesh = io.read_mesh(job["mesh"])
        fixed = None if job["fixed"] is None else io.read_handles(job["fixed"], len(mesh.V))
    if settings["flatten"]:
        found = _flattened(mesh, settings, record, tell)
    else:
        found = _mapped(mesh, fixed, settings, record, tell)
    with _timed(record, "write"):
        record |= _written(records.map_path(folder), mesh, found, "bijective" if settings["flatten"] else "injective")
    with _timed(record, "measure"):
        record |= _measured(mesh, found)


def _mapped(
    mesh: io.MeshData,
    fixed: NDArray[np.signedinteger] | None,
    settings: dict[str, Any],
    record: Record,
    tell: Callable[[dict[str, Any]], None],
) -> MapResult:
    """Map a mesh onto a given boundary."""
    with _timed(record, "setup"):
        arrays = io.problem_arrays(mesh, fixed) if settings["to"] is None else _onto(settings["to"], mesh)
        problem = Problem(*arrays, reference=settings["reference"])
        slide = _along(settings["to"]) if settings["slide"] else False
        if slide is not False:
            problem = moved_onto(slide, problem)
    record |= {"vertices": problem.n, "triangles": len(problem.F), "fixed": len(problem.fixed)}
    record |= {"pins": len(problem.domain.pins), "loops": len(problem.domain.loops)}
    tell({"facts": record})
    with _timed(record, "map"):
        result = solve(
            problem,
            strategy=settings["strategy"],
            max_iterations=settings["max_iterations"],
            linear_solver=settings["linear_solver"],
        )
    stages, found = result.stages, result
    if settings["polish"] is not None and result.status is Status.INJECTIVE:
        with _timed(record, "polish"):
            found = polish_map(
                problem.domain,
                result.uv,
                energy=settings["polish"],
                linear_solver=settings["linear_solver"],
                slide=slide,
            )
        stages = stages + found.stages
    record |= _told(found, stages, result.linear_solver)
    record["flips_before"] = result.history[0].flipped if result.history else None
    if result.status is not Status.INJECTIVE:
        why = result.diagnosis
        record["error"] = result.status.value if why is None or not why.obstructions else why.summary()
    return found


def _flattened(
    mesh: io.MeshData, settings: dict[str, Any], record: Record, tell: Callable[[dict[str, Any]], None]
) -> MapResult:
    """Lay a mesh flat, its boundary free."""
    with _timed(record, "setup"):
        pieces = flattenable(mesh.V, mesh.F)
    record |= {"vertices": len(mesh.V), "triangles": len(mesh.F), "fixed": 0, "pins": 0}
    record["loops"] = sum(len(piece.loops) for piece in pieces)
    tell({"facts": record})
    with _timed(record, "map"):
        result = flatten(
            mesh.V,
            mesh.F,
            energy=settings["energy"] or "symmetric-dirichlet",
            max_iterations=settings["max_iterations"],
            linear_solver=settings["linear_solver"],
        )
    record |= _told(result, result.stages, result.linear_solver)
    if len(pieces) == 1 and isfinite(result.history[-1].energy):
        record["energy"] = result.history[-1].energy
    if not result.certificate.bijective:
        record["error"] = result.certificate.summary()
    return result


def _told(result: MapResult, stages: list[Stage], linear_solver: str) -> Record:
    """What a record says of how a map was found."""
    return {
        "status": result.status.name.lower(),
        "iterations": sum(stage.iterations for stage in stages),
        "stages": json.dumps([stage.to_dict() for stage in stages]),
        "linear_solver": linear_solver,
    }


def _onto(to: str, mesh: io.MeshData) -> io.ProblemArrays:
    """The problem of laying a plain mesh's boundary along an outline."""
    from quasiharmonic.targets import boundary_to, filled

    contours = _outline(to, _changed(to))
    if len(boundary_loops(mesh.F, len(mesh.V))) == 1:
        contours = filled(contours)
    return io.ProblemArrays(mesh.V, mesh.F, *boundary_to(mesh.V, mesh.F, contours))


def _along(to: str | None) -> bool | Rails:
    """What the boundary slides along."""
    return True if to is None else Rails(_curves(to, _changed(to)))


def _changed(to: str) -> int:
    """When an outline was changed; files are read anew when they have."""
    return os.stat(to).st_mtime_ns if os.path.isfile(to) else 0


@cache
def _outline(to: str, _changed: int) -> list[NDArray[np.float64]]:
    from quasiharmonic.targets import outline

    return outline(to)


@cache
def _curves(to: str, _changed: int) -> list[Curve]:
    from quasiharmonic.targets import outline_curves

    return outline_curves(to)


def _written(path: Path, mesh: io.MeshData, result: MapResult, wanted: str) -> Record:
    """Write a map, and judge the file as a reader gets it: whether it is what is wanted, injective or bijective."""
    # Waiting for the disk would take longer than most problems. What a power failure takes is found by its length.
    io.write_obj(path, mesh.with_map(result.uv), durable=False)
    written = io.read_mesh(path)
    certificate = certify(written.F, io.map_of(written))
    certified = certificate.bijective if wanted == "bijective" else certificate.injective
    return {
        "outcome": wanted if certified else f"not {wanted}",
        "certified": certified,
        "bijective": certificate.bijective,
        "flips_after": len(certificate.flipped) + len(certificate.degenerate),
        "map_bytes": path.stat().st_size,
    }


def _measured(mesh: io.MeshData, result: MapResult) -> Record:
    measured = distortion(mesh.V, mesh.F, result.uv)
    if len(measured.flat) == len(mesh.F):
        return {}
    values = {"mips": measured.summary("mips").mean, "isometric": measured.summary("isometric").maximum}
    return {name: value if isfinite(value) else None for name, value in values.items()}


def _unexpected(error: Exception) -> Record:
    """An exception that no input should raise, with its place."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(at.filename).name}, line {at.lineno}, in {at.name}"
    return {"outcome": "error", "certified": False, "error": f"{type(error).__name__}: {error} ({place})"}


@contextmanager
def _timed(record: Record, phase: str) -> Iterator[None]:
    began = time.perf_counter()
    try:
        yield
    finally:
        record[f"seconds_{phase}"] = time.perf_counter() - began


@cache
def _versions() -> str:
    packages = {name: version(name) for name in ("numpy", "scipy")}
    return json.dumps({"quasiharmonic": __version__, "python": platform.python_version(), **packages})


def _forget_peak() -> None:
    """Let the highest memory use be counted anew, where the system can do that (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak() -> int | None:
    """Highest resident memory, bytes: since `_forget_peak` on Linux, of the process elsewhere; None if nobody knows."""
    with suppress(OSError, IndexError):
        return 1024 * int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
