"""Map, flatten, improve and pack the islands of a map with seams, like the functions of the same names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.mapped import MappedAtlas, MappedIsland, each_island, faced, in_place_of, naming
from quasiharmonic.apps.atlas.packing import packed
from quasiharmonic.apps.atlas.verdict import is_mirrored
from quasiharmonic.apps.flattening import flattened
from quasiharmonic.apps.flattening.layout import in_unit_square, side_by_side
from quasiharmonic.energies.deformation import positive_weights
from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.adapters.objects import MeshLike, seamed_mesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.solver.search.harmonising import harmonise_map
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.util.arrays import FloatArray, IntArray, index_array, named


def polish(
    mesh: SeamedMesh | MeshLike,
    *,
    free: bool = False,
    fixed: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    **rest: Any,
) -> MappedAtlas:
    """Lower the distortion of every island of an injective map.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
        A map whose islands are injective; mirrored islands are allowed.
    free : bool
        Let the boundaries move. The centre, direction and area of each island are kept. Islands may then overlap.
    fixed : (k,) array of int, optional
        Fixed vertices of the mesh, on all islands that contain them; the boundaries by default. Not with ``free``.
    weights : (f,) array, optional
        Weight of each triangle's distortion.
    **rest
        Options of `quasiharmonic.polish`, or with ``free`` of `quasiharmonic.flatten`: ``energy``,
        ``max_iterations``, ``tolerance``, ``linear_solver``, ``callback``; without ``free`` also ``slide``.

    Returns
    -------
    MappedAtlas

    Raises
    ------
    ValueError
        If an island is not injective or not a surface; the message names its first triangle.
    """
    mesh = seamed_mesh(mesh)
    weights = None if weights is None else positive_weights(weights, len(mesh.F))
    if free and fixed is not None:
        raise ValueError("fixed and free exclude each other: omit one of them")
    held = _fixed(mesh, fixed)

    def lower(island: Island) -> MapResult:
        own: dict[str, Any] = {} if weights is None else {"weights": weights[island.triangles]}
        if free:
            result = flattened.flatten(island.V, island.F, start=island.uv, **own, **rest)
            return replace(result, uv=in_place_of(island, result.uv))
        domain = _domain(island, held)
        return polish_map(domain, island.uv, **own, **rest)

    return each_island(mesh, lower)


def harmonise(mesh: SeamedMesh | MeshLike, *, fixed: ArrayLike | None = None, **rest: Any) -> MappedAtlas:
    """Lower an energy of every island within the injective maps, with a fixed boundary; see `quasiharmonic.harmonise`.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
    fixed : (k,) array of int, optional
        As for `polish`.
    **rest
        Options of `quasiharmonic.harmonise`.

    Returns
    -------
    MappedAtlas
    """
    mesh = seamed_mesh(mesh)
    held = _fixed(mesh, fixed)
    return each_island(mesh, lambda island: harmonise_map(_domain(island, held), island.uv, **rest))


def injective_map(
    mesh: SeamedMesh | MeshLike, *, fixed: ArrayLike | None = None, reference: Any = None, **rest: Any
) -> MappedAtlas:
    """Map every island again with a fixed boundary; see `quasiharmonic.injective_map`.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
    fixed : (k,) array of int, optional
        As for `polish`.
    reference, **rest
        Options of `quasiharmonic.injective_map`.

    Returns
    -------
    MappedAtlas
        If an island has no injective map, its result reports it.
    """
    mesh = seamed_mesh(mesh)
    held = _fixed(mesh, fixed)

    def find(island: Island) -> MapResult:
        own = _held(island, held)
        return solve(Problem(island.V, island.F, own, island.uv[own], reference=reference), **rest)

    return each_island(mesh, find)


def flatten(
    mesh: SeamedMesh | MeshLike,
    *,
    start: bool = False,
    fixed: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    unit_square: bool = False,
    gap: float = 0.0,
    **rest: Any,
) -> MappedAtlas:
    """Flatten every island with a free boundary. Islands stand side by side and are not mirrored.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
        Its islands may be without positions.
    start : bool
        Start from the islands' current positions.
    fixed : (k,) array of int, optional
        Fixed vertices of the mesh, at their current positions. Islands with fixed vertices are mapped there, and the
        others are placed beside them without overlap.
    weights : (f,) array, optional
        Weight of each triangle's distortion.
    unit_square, gap, **rest
        Options of `quasiharmonic.flatten`.

    Returns
    -------
    MappedAtlas
        In the surface's unit of length, or in the unit square.
    """
    mesh = seamed_mesh(mesh)
    weights = None if weights is None else positive_weights(weights, len(mesh.F))
    held = _fixed(mesh, fixed)
    if held is not None and unit_square:
        raise ValueError("fixed vertices determine the size of the map: omit unit_square")
    if held is not None and mesh.uv is None:
        raise ValueError("the fixed vertices have no target positions: the mesh has no texture coordinates")

    def lay(island: Island) -> MapResult:
        own: dict[str, Any] = {} if weights is None else {"weights": weights[island.triangles]}
        if start:
            own["start"] = island.uv
        pins = _held(island, held) if held is not None else np.empty(0, dtype=np.int64)
        if pins.size:
            own |= {"fixed": pins, "target": island.uv[pins]}
        return flattened.flatten(island.V, island.F, **own, **rest)

    faces = faced(mesh, reflect=start)
    if held is not None and held.size and len(faces) > 1 and not any(mirrored for _, mirrored in faces):
        return _held_together(mesh, held, weights, start, {"gap": gap, **rest})
    mapped = each_island(mesh, lay, reflect=start)
    uv = [island.result.uv for island in mapped.islands]
    if held is None and len(uv) > 1:
        uv = side_by_side(uv, gap)
    if unit_square:
        sizes = np.cumsum([len(places) for places in uv])[:-1]
        uv = np.split(in_unit_square(np.concatenate(uv)), sizes)
    return replace(mapped, mesh=mesh.with_places(uv))


def _held_together(
    mesh: SeamedMesh, fixed: IntArray, weights: FloatArray | None, start: bool, rest: dict[str, Any]
) -> MappedAtlas:
    """Flatten several islands of which some have fixed vertices as one mesh, so that they do not overlap."""
    islands = mesh.islands
    for island in islands:
        with naming(island, len(islands)):
            flattened.flattenable(island.V, island.F)
    # Without seams, use the mesh's numbering, so that messages name the mesh's elements.
    order, by_mesh = (np.argsort(_joined(islands, name), kind="stable") for name in ("vertices", "triangles"))
    number = np.argsort(order)
    ends = np.cumsum([len(island.V) for island in islands])
    numbers = np.split(number, ends[:-1])
    pins = [_held(island, fixed) for island in islands]
    own: dict[str, Any] = {} if weights is None else {"weights": weights[np.sort(_joined(islands, "triangles"))]}
    if start:
        own["start"] = _joined(islands, "uv")[order]
    result = flattened.flatten(
        _joined(islands, "V")[order],
        np.concatenate([of[island.F] for island, of in zip(islands, numbers, strict=True)])[by_mesh],
        fixed=np.concatenate([of[held] for held, of in zip(pins, numbers, strict=True)]),
        target=np.concatenate([island.uv[held] for island, held in zip(islands, pins, strict=True)]),
        **own,
        **rest,
    )
    # There is one result for all islands, so its stages, history and time are reported once.
    told = [result, *[replace(result, stages=[], history=[], diagnosis=None, seconds=0.0) for _ in islands[1:]]]
    places = [result.uv[of] for of in numbers]
    done = [
        MappedIsland(island.triangles, False, replace(one, uv=uv, certificate=certify(island.F, uv)))
        for island, one, uv in zip(islands, told, places, strict=True)
    ]
    return MappedAtlas(mesh.with_places(places), tuple(done))


def _joined(islands: Sequence[Island], name: str) -> Any:
    """Concatenate an attribute of all islands."""
    return np.concatenate([getattr(island, name) for island in islands])


def pack(mesh: SeamedMesh | MeshLike, *, margin: float = 1 / 256) -> SeamedMesh:
    """Pack islands into the unit square at one texel density; see `quasiharmonic.apps.atlas.packing.packed`.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
        Its islands are injective or mirrored. Mirrored islands stay mirrored.
    margin : float
        Minimum space between two islands, as a fraction of the square's side.

    Returns
    -------
    SeamedMesh

    Raises
    ------
    ValueError
        If an island has no positions, or the islands do not fit with this margin.
    """
    mesh = seamed_mesh(mesh)
    islands = mesh.islands
    F = [island.F[:, ::-1] if is_mirrored(island.F, island.uv) else island.F for island in islands]
    return mesh.with_places(packed([island.uv for island in islands], F, _surface_areas(mesh), margin=margin))


def _surface_areas(mesh: SeamedMesh) -> FloatArray:
    """Areas of the islands on the surface, in a unit near the surface's size."""
    V = np.ldexp(mesh.V, -int(np.frexp(np.abs(mesh.V).max(initial=0.0))[1]))
    a, b, c = V[mesh.F].swapaxes(0, 1)
    along, across = b - a, c - a
    squared = (along**2).sum(axis=1) * (across**2).sum(axis=1) - (along * across).sum(axis=1) ** 2
    area = 0.5 * np.sqrt(np.maximum(squared, 0.0))
    return np.array([area[island.triangles].sum() for island in mesh.islands])


def _fixed(mesh: SeamedMesh, fixed: ArrayLike | None) -> IntArray | None:
    if fixed is None:
        return None
    array = index_array("fixed", fixed).ravel()
    absent = array[(array < 0) | (array >= len(mesh.V))]
    if absent.size:
        raise ValueError(f"fixed refers to {named('vertex', 'vertices', absent)}, which the mesh does not have")
    return array


def _held(island: Island, fixed: IntArray | None) -> IntArray:
    """Fixed vertices of an island; its boundary by default."""
    if fixed is None:
        return np.unique(boundary_edges(island.F, len(island.vertices)))
    return np.flatnonzero(np.isin(island.vertices, fixed))


def _domain(island: Island, fixed: IntArray | None) -> Domain:
    domain = Domain(island.V, island.F, _held(island, fixed))
    domain.check_boundary_fixed()
    return domain
