"""Worker process that solves problems one after another.

It reads jobs from standard input and writes answers to standard output, both as lines of JSON. A problem ends either
with a record, written next to the map before the answer is sent, or with the death of this process.
`quasiharmonic.ui.batch.supervisor` records the death.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import io
from quasiharmonic.apps.atlas import island_functions as atlas
from quasiharmonic.apps.atlas.atlas_verdict import certify
from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas, each_island, merge_refined, orient_islands
from quasiharmonic.apps.flattening.free_boundary import check_flattenable
from quasiharmonic.energies.polishing import limit_polish, polish_result
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.io.errors import FileInUseError
from quasiharmonic.io.mesh_files import read_model
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.io.untrusted import use_bound
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.solver.mapping import solve
from quasiharmonic.solver.refinement import on_refinement
from quasiharmonic.targets.boundary.boundary_to import FittedProblem
from quasiharmonic.ui.batch import groups, island_problems, metadata, records
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.ui.batch.settings import search_stages
from quasiharmonic.ui.worker_pipes import open_pipes
from quasiharmonic.util.options import PolishOptions
from quasiharmonic.util.outcome import replace_nonfinite

#: Key of the message that a process sends after its imports.
READY = "ready"
# Seconds after the time limit at which the system ends this process, in case the supervisor is gone.
GRACE = 10.0


# A function that sends a message to the supervisor.
Tell = Callable[[dict[str, Any]], None]


def serve() -> None:
    """Solve the jobs from standard input until it is closed; then exit at once."""
    source, send = open_pipes()

    def tell(message: dict[str, Any]) -> None:
        send(json.dumps(message, allow_nan=False).encode() + b"\n")

    jobs: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_listen, args=(source, jobs), daemon=True).start()
    tell({READY: True})
    while True:
        job = json.loads(jobs.get())
        _alarm(job["time_limit"])
        began = time.perf_counter()
        try:
            if "together" in job:
                groups.solve_some(job["together"], tell)
                answer: dict[str, Any] = {"over": True}
            else:
                record = solve_files(job, tell)
                answer = {"outcome": record["outcome"], "seconds": record["seconds"]}
        except FileInUseError:
            # No record can be written, so the next run tries this problem again.
            answer = {"outcome": "error", "seconds": time.perf_counter() - began}
        except io.OutputError as error:
            answer = {"stop": str(error)}
        tell(answer)
        _alarm(None)


def _listen(source: BinaryIO, jobs: SimpleQueue[bytes]) -> None:
    for line in source:
        jobs.put(line)
    # The supervisor is gone, so the current job is not needed.
    os._exit(0)


def _alarm(limit: float | None) -> None:
    """Let the system end this process some time after the limit, even if it hangs in native code."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0.0 if limit is None else limit + GRACE)


def solve_files(job: dict[str, Any], tell: Tell) -> Record:
    """Solve one problem, write its map and its record, and return the record.

    The job has the paths ``mesh`` and ``fixed``, the ``folder`` for results, the ``settings`` as from
    `Settings.to_dict`, and the initial ``record``. ``tell`` is called with ``{"facts": …}`` when the size of the
    problem is known. OutputError if the map or the record cannot be written.
    """
    folder = Path(job["folder"])
    records.clear(folder)
    metadata.reset_peak()
    began = time.perf_counter()
    record: Record = {**job["record"], "versions": metadata.list_versions()}
    try:
        fill_record(job, folder, record, tell)
    except FileInUseError as error:
        record |= _describe_error(error)
    except io.OutputError:
        raise
    except MemoryError as error:
        record |= {"outcome": "memory", "certified": False, "error": str(error) or "out of memory"}
    except Exception as error:
        # Errors of the input are raised before the sizes are recorded.
        wrong_input = isinstance(error, ValueError) and "vertices" not in record
        record |= {"outcome": "invalid", "error": str(error)} if wrong_input else _describe_error(error)
    record["peak_memory"] = metadata.measure_peak()
    record["seconds"] = time.perf_counter() - began
    records.write_record(folder, record)
    return record


def fill_record(job: dict[str, Any], folder: Path, record: Record, tell: Tell) -> None:
    """Read, solve, write, certify and measure a problem; each result is recorded as soon as it is known."""
    settings = job["settings"]
    path = records.map_path(folder, settings["map_format"])
    with metadata.time_phase(record, "read"), use_bound(job["record"].get("memory_limit")):
        mesh = read_model(job["mesh"], settings["unwrap"] or {})
    if settings["unwrap"] is not None:
        _unwrap_model(mesh, settings["unwrap"], path, record, tell)
        return
    with metadata.time_phase(record, "read"):
        fixed = None if job["fixed"] is None else io.read_handles(job["fixed"], len(mesh.V))
    with metadata.time_phase(record, "setup"):
        if not settings["flatten"] and settings["to"] is None and mesh.FT is None:
            # Raises an error that names the missing data.
            io.problem_arrays(mesh, fixed)
        surface = island_problems.make_surface(mesh, settings)
    if settings["cut"]:
        record["cut_edges"] = len(surface.seams) - len(io.seamed(mesh).seams)
    if settings["flatten"]:
        found = _flatten_islands(surface, settings, record, tell)
        mapped = mesh.with_places(found.mesh)
    else:
        found, refined = _map_islands(surface, fixed, settings, record, tell)
        mapped = mesh.with_places(found.mesh)
        if any(refined):
            mapped = merge_refined(mesh, surface.islands, refined, found.places())
    if settings["pack"]:
        mapped = mapped.with_places(atlas.pack(io.mapped(mapped)))
    with metadata.time_phase(record, "write"):
        record |= _write_map(path, mapped, "bijective" if settings["flatten"] else "injective")
    with metadata.time_phase(record, "measure"):
        record |= metadata.describe_distortion(*io.without_idle(*io.cut_at_seams(mapped)))


def _unwrap_model(mesh: io.MeshData, options: dict[str, Any], path: Path, record: Record, tell: Tell) -> None:
    """Unwrap a model with options of `quasiharmonic.unwrap`, write it to ``path``, and record the certified facts."""
    # SciPy's subpackages that this needs would double the time in which workers for maps start.
    from quasiharmonic.apps.unwrapping.model_files import add_map, is_written, polygon_costs
    from quasiharmonic.apps.unwrapping.unwrap import unwrap

    sizes = {"vertices": len(mesh.V), "triangles": len(mesh.F)}
    tell({"facts": record | sizes})
    with metadata.time_phase(record, "map"):
        result = unwrap(mesh, edge_costs=polygon_costs(mesh), jobs=record.get("threads"), **options)
    changes = result.cleaned.changes.items()
    stretch = {"stretch": result.stretch.p99, "isometric": result.stretch.worst}
    record |= {
        **sizes,
        **{name: replace_nonfinite(value) for name, value in stretch.items()},
        "charts": result.n_charts,
        "seam_length": replace_nonfinite(result.seam_length),
        "utilisation": result.utilisation,
        "cleaned": ", ".join(f"{name}: {rows.size}" for name, rows in changes if rows.size) or None,
        "status": result.status.name.lower(),
    }
    with metadata.time_phase(record, "write"):
        records.write_map(path, add_map(mesh, result)[0])
        certified = result.success and is_written(io.read_mesh(path), result)
    record |= metadata.describe_map(path, "bijective", certified, certified, None)


def _map_islands(
    surface: SeamedMesh, fixed: NDArray[np.signedinteger] | None, settings: dict[str, Any], record: Record, tell: Tell
) -> tuple[MappedAtlas, list[Refined | None]]:
    """Map a surface onto a given boundary, island by island; return the maps and the refined meshes."""
    with metadata.time_phase(record, "setup"):
        posed = island_problems.make_problems(surface, fixed, settings)
    problems = [one.fitted.problem for one in posed]
    record |= metadata.describe_sizes(problems)
    tell({"facts": record})
    todo = iter(posed)
    # The problems are in the order in which islands are solved.
    found = each_island(
        surface, lambda island: _solve_island(*next(todo), settings, record), reflect=settings["to"] is None
    )
    results = [island.result for island in found.islands]
    record |= metadata.describe_search(results, found.status)
    if settings["refine"]:
        record["added_vertices"] = added = sum(result.added for result in results)
        record["vertices"] += added
        record["triangles"] += sum(2 * result.added for result in results)
        record["rung"] = results[-1].refinement_attempts[-1].name if len(results) == 1 else None
    if all(result.history for result in results):
        record["flips_before"] = sum(result.history[0].inverted for result in results)
    why = [result.diagnosis for result in results if not result.injective]
    if why:
        reasons = [reason.summary() for reason in why if reason is not None and reason.obstructions]
        record["error"] = "; ".join(reasons) or found.status.value
    return found, [result.refined for result in results]


def _solve_island(
    fitted: FittedProblem, slide: bool | BoundaryCurves, settings: dict[str, Any], record: Record
) -> MapResult:
    """Map one island, and lower its distortion if requested."""
    with metadata.time_phase(record, "map"):
        result = solve(
            fitted.problem,
            strategy=search_stages(settings),
            max_iterations=settings["max_iterations"],
            linear_solver=groups.solver_for(fitted.problem, settings["linear_solver"]),
            refine=settings["refine"],
        )
    if settings["polish"] is None or result.status is not Status.INJECTIVE:
        return result
    with metadata.time_phase(record, "polish"):
        fine = on_refinement(fitted.problem, result.refined)
        steps = limit_polish(settings["max_iterations"])
        return polish_result(fine, result, PolishOptions(energy=settings["polish"], max_iterations=steps, slide=slide))


def _flatten_islands(surface: SeamedMesh, settings: dict[str, Any], record: Record, tell: Tell) -> MappedAtlas:
    """Flatten a surface with free boundary, island by island."""
    with metadata.time_phase(record, "setup"):
        pieces = [
            piece
            for island, _ in orient_islands(surface, reflect=False)
            for piece in check_flattenable(island.V, island.F)
        ]
    record |= {"vertices": len(surface.V), "triangles": len(surface.F), "fixed": 0, "pins": 0}
    record |= {"loops": sum(len(piece.loops) for piece in pieces), "islands": len(surface.islands)}
    tell({"facts": record})
    with metadata.time_phase(record, "map"):
        found = atlas.flatten(
            surface,
            energy=settings["energy"] or "symmetric-dirichlet",
            start=settings["start"],
            max_iterations=settings["max_iterations"],
            linear_solver=settings["linear_solver"],
        )
    record |= metadata.describe_search([island.result for island in found.islands], found.status)
    energy = found.islands[0].result.history[-1].energy
    if len(pieces) == 1 and isfinite(energy):
        record["energy"] = energy
    bad = [result.certificate for result in (island.result for island in found.islands) if not result.injective]
    if bad:
        record["error"] = bad[0].summary()
    return found


def _write_map(path: Path, mesh: io.MeshData, required: str) -> Record:
    """Write a map, read it back, and certify that it is injective or bijective, as required."""
    records.write_map(path, mesh)
    V, F, uv = io.cut_at_seams(io.read_mesh(path))
    verdict = certify(SeamedMesh(V, F, F, uv))
    bijective = verdict.bijective and not len(verdict.overlapping)
    certified = bijective if required == "bijective" else verdict.injective
    return metadata.describe_map(path, required, certified, bijective, len(verdict.inverted))


def _describe_error(error: Exception) -> Record:
    """Return the record of an unexpected exception, with its source location."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    place = f"{Path(at.filename).name}, line {at.lineno}, in {at.name}"
    return {"outcome": "error", "certified": False, "error": f"{type(error).__name__}: {error} ({place})"}
