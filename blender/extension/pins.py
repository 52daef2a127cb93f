"""Pinned UVs: which vertices of an island they hold, and maps that keep them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import MIRROR
from quasiharmonic.apps.atlas.mapped_atlas import each_island, fit_in_place
from quasiharmonic.apps.flattening.free_boundary import flatten
from quasiharmonic.apps.flattening.piece import place_in_row
from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.options import PolishOptions

from .surface import Refused, Surface, reflect_single

Report = Callable[[Any], None]

# Space between pinned islands and the others, relative to the size of the pinned ones.
_GAP = 0.05


def find_pins(surface: Surface, island: Island) -> tuple[IntArray, FloatArray]:
    """Return the pinned vertices (k,) of an island and their positions (k, 2).

    Raises
    ------
    Refused
        If a vertex of the island is pinned at two positions.
    """
    if not surface.pinned.any():
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    loops = surface.loops[island.triangles]
    at = surface.pinned[loops]
    # Loops at the same position have one row, that of the first of them.
    rows = surface.mesh.FT[island.triangles][at]
    pairs = np.unique(np.stack([island.F[at], rows], axis=1), axis=0)
    vertices, count = np.unique(pairs[:, 0], return_counts=True)
    if (count > 1).any():
        vertex = int(island.vertices[vertices[np.argmax(count > 1)]])
        raise Refused(f"vertex {vertex} is pinned at two positions, and no seam parts it: unpin one of them")
    return vertices, surface.mesh.uv[pairs[:, 1]]


def list_pinned(surface: Surface) -> IntArray:
    """Return the pinned vertices (k,) of the islands to change, in the numbering of the mesh."""
    return np.unique(surface.mesh.F[surface.pinned[surface.loops] & (surface.mesh.FT >= 0)])


def flatten_with_pins(surface: Surface, mesh: SeamedMesh, energy: str, reports_progress: Report) -> SeamedMesh:
    """Flatten every island; islands with pins keep them, and the others stand in a row beside these.

    Parameters
    ----------
    surface : Surface
    mesh : SeamedMesh
        The islands, as triangles of ``surface.mesh``; positions are not used.
    energy : str
        The name of an energy, as in `quasiharmonic.flatten`.
    reports_progress : callable

    Raises
    ------
    Refused
        If no map with the pins of an island is found.
    """
    pins = {int(island.triangles[0]): find_pins(surface, island) for island in mesh.islands}
    old = surface.mesh
    densities = {
        island.triangles[0]: _density(island, old.uv[old.FT[island.triangles]]) or 1.0 for island in mesh.islands
    }

    def lay(island: Island) -> MapResult:
        fixed, target = pins[int(island.triangles[0])]
        if not fixed.size:
            return _complete(flatten(island.V, island.F, energy=energy, callback=reports_progress))
        return flatten_pinned(island, fixed, target, densities[island.triangles[0]], energy, reports_progress)

    done = each_island(mesh, lay, reflect=False)
    parts = [island.result.uv for island in done.islands]
    held = [pins[int(island.triangles[0])][0].size > 0 for island in done.islands]
    return mesh.with_places(_place_beside(mesh.islands, parts, held))


def flatten_pinned(
    island: Island,
    fixed: IntArray,
    target: FloatArray,
    density: float,
    energy: str,
    reports_progress: Report,
    *,
    start: bool = False,
) -> MapResult:
    """Flatten an island with a free boundary and fixed vertices.

    With ``start`` the descent starts from the island's positions, at the scale ``density``. Otherwise several fixed
    vertices determine the scale, and a single one uses ``density``.
    """
    if not start and len(np.unique(target, axis=0)) > 1:
        free = _complete(flatten(island.V, island.F, callback=reports_progress)).uv[fixed]
        spread = [float(np.linalg.norm(points - points.mean(axis=0))) for points in (target, free)]
        density = spread[0] / spread[1]
    initial = {"start": island.uv} if start else {}
    result = _complete(
        flatten(
            island.V * density,
            island.F,
            fixed=fixed,
            target=target,
            energy=energy,
            callback=reports_progress,
            **initial,
        )
    )
    if not result.injective:
        reason = result.status.value if result.diagnosis is None else result.diagnosis.summary()
        raise Refused(f"no map without inverted faces keeps these pins. {reason}")
    return result


def reduce_stretch(
    surface: Surface, mesh: SeamedMesh, *, free: bool, energy: str, reports_progress: Report
) -> SeamedMesh:
    """Reduce the stretch of every island with its pins fixed, and its boundary unless ``free`` is true."""

    def lower(island: Island) -> MapResult:
        # Positions of a mirrored island are reflected here.
        fixed, _ = find_pins(surface, island)
        if not free:
            held = np.union1d(fixed, boundary_edges(island.F, len(island.vertices)))
            options = PolishOptions(energy=energy, callback=reports_progress)
            return _complete(polish_map(Domain(island.V, island.F, held), island.uv, options))
        if fixed.size:
            density = _density(island, island.uv[island.F])
            return flatten_pinned(island, fixed, island.uv[fixed], density, energy, reports_progress, start=True)
        result = _complete(flatten(island.V, island.F, start=island.uv, energy=energy, callback=reports_progress))
        return replace(result, uv=fit_in_place(island, result.uv))

    upright = reflect_single(mesh)
    lowered = each_island(upright, lower).mesh
    return lowered if upright is mesh else SeamedMesh(lowered.V, lowered.F, lowered.FT, lowered.uv * MIRROR)


def hold_pins(problem: Problem, fixed: IntArray, target: FloatArray) -> Problem:
    """Return a problem with further fixed vertices; pins on the boundary replace its target positions."""
    if not fixed.size:
        return problem
    keep = ~np.isin(problem.fixed, fixed)
    return Problem(
        problem.V,
        problem.F,
        np.concatenate([problem.fixed[keep], fixed]),
        np.concatenate([problem.target[keep], target]),
    )


def _complete(result: MapResult) -> MapResult:
    """Return a result; raise KeyboardInterrupt if it was interrupted."""
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def _place_beside(islands: Sequence[Island], parts: list[FloatArray], held: list[bool]) -> list[FloatArray]:
    """Return positions in which islands that are not held stand to the right of those that are, at their scale."""
    fixed = [(island, uv) for island, uv, keep in zip(islands, parts, held, strict=True) if keep]
    loose = [k for k, keep in enumerate(held) if not keep]
    if not fixed or not loose:
        return parts
    density = float(np.mean([_density(island, uv[island.F]) for island, uv in fixed]))
    high = np.max([uv.max(axis=0) for _, uv in fixed], axis=0)
    low = np.min([uv.min(axis=0) for _, uv in fixed], axis=0)
    gap = _GAP * float((high - low).max())
    row = place_in_row([density * (parts[k] - parts[k].min(axis=0)) for k in loose], gap)
    placed = list(parts)
    for k, uv in zip(loose, row, strict=True):
        placed[k] = uv + np.array([high[0] + gap, low[1]])
    return placed


def _density(island: Island, corners: FloatArray) -> float:
    """Length in the plane per length on the surface, from the positions (k, 3, 2) of the corners; 0 without area."""
    in_space, in_plane = (points[:, 1:] - points[:, :1] for points in (island.V[island.F], corners))
    surface = np.linalg.norm(np.cross(in_space[:, 0], in_space[:, 1]), axis=1).sum()
    return float(np.sqrt(np.abs(np.linalg.det(in_plane)).sum() / surface))
