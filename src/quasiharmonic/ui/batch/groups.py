"""Solve small problems of a data set together, in one worker process.

For meshes of some hundred triangles the overhead of NumPy calls exceeds the computation. So several problems are read,
and their first search stages run in a batch (`quasiharmonic.solver.search.first_stage`).
A problem solved here gets the same map and record as alone. All other problems are left untouched and solved
individually: unreadable files, meshes with several islands, large meshes, and searches that need more than one stage.
Failures here therefore cost only time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic import io
from quasiharmonic.io.errors import FileInUseError
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.linsolve import available
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.solver.search.first_stage import SMALL, Patterns, group_by_first_stage, run_first_stage
from quasiharmonic.solver.search.search import finish_search
from quasiharmonic.ui.batch import island_problems, metadata, records
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.ui.batch.settings import search_stages
from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.options import MapOptions

Job = dict[str, Any]


class _ReadProblem(NamedTuple):
    """Problem that has been read."""

    mesh: io.MeshData
    fixed: IntArray | None  # (k,): the fixed vertices, if the files list them
    record: Record  # Record so far


class _SingleIsland(NamedTuple):
    """Problem of a mesh with one island, and a function that returns the mesh with a given map."""

    problem: Problem
    mapped: Callable[[FloatArray], io.MeshData]


def solver_for(problem: Problem, linear_solver: str) -> str:
    """Return the linear solver for a problem: QDLDL for a small problem if the user did not choose one.

    With QDLDL a problem has the same map alone and in a batch, except for rounding: its elimination order may depend on
    the other problems. No other solver is faster at these sizes.
    """
    return "qdldl" if linear_solver == "auto" and len(problem.F) <= SMALL and "qdldl" in available() else linear_solver


def solve_some(jobs: Sequence[Job], tell: Callable[[dict[str, Any]], None]) -> None:
    """Solve several problems together where possible, and write maps and records of the solved ones.

    The jobs are as for `solve_files`, all with the same settings, which must satisfy `Settings.together`. ``tell`` is
    called with ``{"done": k, "outcome": …, "seconds": …}`` when the record of problem ``k`` is written. OutputError if
    a map or a record cannot be written.
    """
    metadata.reset_peak()
    settings, folders = jobs[0]["settings"], [Path(job["folder"]) for job in jobs]
    read: dict[int, _ReadProblem] = {}
    for k, job in enumerate(jobs):
        # The error is raised and recorded when the problem is solved individually.
        with suppress(Exception):
            one = read_problem(job)
            if len(one.mesh.F) <= SMALL:
                read[k] = one
    posed = _find_single_islands(read, settings)
    for k, result in _solve_first_stage({k: one.problem for k, one in posed.items()}, settings):
        record, certificate = read[k].record, result.certificate
        path = records.map_path(folders[k], settings["map_format"])
        record |= metadata.describe_sizes([posed[k].problem]) | metadata.describe_search([result], result.status)
        record |= {"flips_before": result.history[0].inverted, "seconds_map": result.seconds}
        try:
            records.clear(folders[k])
            with metadata.time_phase(record, "write"):
                records.write_map(path, posed[k].mapped(certificate.uv))
                V, F, uv = _read_map(io.read_mesh(path))
            # The same map has the same certificate.
            if not np.array_equal(F, certificate.F) or not np.array_equal(uv, certificate.uv):
                continue
            record |= metadata.describe_map(path, "injective", True, bool(certificate.bijective), 0)
            with metadata.time_phase(record, "measure"):
                record |= metadata.describe_distortion(V, F, uv)
            record["peak_memory"] = metadata.measure_peak()
            record["seconds"] = sum(value for name, value in record.items() if name.startswith("seconds_"))
            records.write_record(folders[k], record)
        except FileInUseError:
            continue  # tried again when the problem is solved individually
        tell({"done": k, "outcome": "injective", "seconds": record["seconds"]})


def read_problem(job: Job) -> _ReadProblem:
    """Read a problem; raise the errors of the readers."""
    record: Record = {**job["record"], "versions": metadata.list_versions()}
    with metadata.time_phase(record, "read"):
        mesh = io.read_mesh(job["mesh"])
        fixed = None if job["fixed"] is None else io.read_handles(job["fixed"], len(mesh.V))
    return _ReadProblem(mesh, fixed, record)


def _find_single_islands(read: dict[int, _ReadProblem], settings: dict[str, Any]) -> dict[int, _SingleIsland]:
    """Return the problems of the meshes that form a single problem on all their vertices."""
    posed = {}
    for k, one in read.items():
        with suppress(Exception), metadata.time_phase(one.record, "setup"):
            if settings["to"] is None and _plain(one, settings):
                posed[k] = _SingleIsland(_make_problem(one), one.mesh.with_map)
            elif settings["to"] is not None or one.mesh.FT is not None:
                surface = island_problems.make_surface(one.mesh, settings)
                islands = surface.islands
                if len(islands) == 1 and np.array_equal(islands[0].vertices, np.arange(len(one.mesh.V))):
                    problem = island_problems.make_problems(surface, one.fixed, settings)[0].fitted.problem
                    posed[k] = _SingleIsland(problem, partial(_with_map, one.mesh, surface))
    return posed


def _plain(one: _ReadProblem, settings: dict[str, Any]) -> bool:
    """Whether texture coordinates and vertices have the same indices, and the files list the fixed vertices."""
    mesh = one.mesh
    if settings["reference"] is not None or one.fixed is None or mesh.FT is None or mesh.vt is None:
        return False
    return len(mesh.vt) == len(mesh.V) and np.array_equal(mesh.FT, mesh.F)


def _make_problem(one: _ReadProblem) -> Problem:
    """Return the problem of a mesh whose texture coordinates are the positions of its vertices."""
    assert one.fixed is not None
    assert one.mesh.vt is not None
    held = np.unique(one.fixed)
    return Problem(one.mesh.V, one.mesh.F, held, one.mesh.vt[held])


def _with_map(mesh: io.MeshData, surface: SeamedMesh, uv: FloatArray) -> io.MeshData:
    return mesh.with_places(surface.with_places([uv]))


def _solve_first_stage(problems: dict[int, Problem], settings: dict[str, Any]) -> Iterator[tuple[int, MapResult]]:
    """Yield the problems that the first stage of their search solves, with their results."""
    for descent, some in group_by_first_stage(problems, search_stages(settings)):
        patterns = Patterns(solver_for(problems[some[0]], settings["linear_solver"]))
        options = MapOptions(max_iterations=settings["max_iterations"], linear_solver=settings["linear_solver"])
        found = run_first_stage([problems[k] for k in some], descent, patterns, options)
        for k, search in zip(some, found, strict=True):
            if search is not None and search.status is Status.INJECTIVE:
                result = finish_search(search, search_stages(settings))
                if result.injective:
                    yield k, result


def _read_map(mesh: io.MeshData) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return vertices, triangles and map of a file."""
    if mesh.vt is not None and len(mesh.vt) == len(mesh.V) and mesh.FT is not None and np.array_equal(mesh.FT, mesh.F):
        return mesh.V, mesh.F, mesh.vt
    return io.cut_at_seams(mesh)
