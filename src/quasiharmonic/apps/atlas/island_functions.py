"""Map, flatten, improve and pack the islands of a map with seams, like the functions of the same names."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.atlas_verdict import is_mirrored
from quasiharmonic.apps.atlas.mapped_atlas import (
    MappedAtlas,
    MappedIsland,
    each_island,
    fit_in_place,
    name_island,
    orient_islands,
)
from quasiharmonic.apps.flattening import free_boundary
from quasiharmonic.apps.flattening.piece import fit_unit_square, place_in_row
from quasiharmonic.energies.deformation import positive_weights, signed_areas
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.curves.boundary_curves import sliding_curves
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.objects import MeshLike, as_seamed_mesh
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.solver.mapping import solve
from quasiharmonic.solver.search.harmonising import harmonise_map
from quasiharmonic.targets import outline
from quasiharmonic.targets.boundary.boundary_to import fit_boundary
from quasiharmonic.targets.boundary.corner_pins import CornerSpec
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_bool,
    check_non_negative,
    check_range,
    index_array,
    map_array,
    names_of,
)
from quasiharmonic.util.options import HarmoniseOptions, PolishOptions


def polish(
    mesh: SeamedMesh | MeshLike,
    *,
    free: bool = False,
    fixed: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    islands: Collection[int] | None = None,
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
        Fixed vertices of the mesh, on all islands that contain them; the boundaries by default. Not with ``free``. With
        ``slide``, these vertices do not slide, and boundary vertices that are not listed slide; by default all do.
    weights : (f,) array, optional
        Weight of each triangle's distortion.
    islands : collection of int, optional
        Indices of the islands that change, in the order of ``mesh.islands``; all by default.
    **rest
        Options of `quasiharmonic.polish`, or with ``free`` of `quasiharmonic.flatten`: ``energy``,
        ``max_iterations``, ``tol``, ``linear_solver``, ``callback``; without ``free`` also ``slide``.

    Returns
    -------
    MappedAtlas

    Raises
    ------
    ValueError
        If an island is not injective or not a surface; the message names its first triangle.

    See Also
    --------
    quasiharmonic.polish : A map without seams.
    atlas.harmonise : Energies that are no barriers.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> atlas.polish(atlas.SeamedMesh(V, F, uv=V)).success
    True
    """
    mesh = as_seamed_mesh(mesh)
    _reject_weld(rest)
    check_bool("free", free)
    weights = None if weights is None else positive_weights(weights, len(mesh.F))
    if free and fixed is not None:
        raise ValueError("fixed and free exclude each other: omit one of them")
    checked = _check_fixed(mesh, fixed)

    def lower(island: Island) -> MapResult:
        own: dict[str, Any] = {} if weights is None else {"weights": weights[island.triangles]}
        if free:
            result = free_boundary.flatten(island.V, island.F, start=island.uv, **own, **rest)
            return replace(result, uv=fit_in_place(island, result.uv))
        slide = rest.get("slide", False)
        if slide is False or checked is None:
            return polish_map(_domain(island, checked), island.uv, PolishOptions(**own, **rest))
        held = _select_fixed(island, checked)
        domain = Domain(island.V, island.F, np.union1d(held, _select_fixed(island, None)))
        curves = sliding_curves(slide, domain.loops, island.uv).with_fixed(held)
        return polish_map(domain, island.uv, PolishOptions(**own, **rest | {"slide": curves}))

    return each_island(mesh, lower, only=islands)


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

    See Also
    --------
    quasiharmonic.harmonise : A map without seams.
    atlas.polish : Faster for barriers.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> atlas.harmonise(atlas.SeamedMesh(V, F, uv=V * [2, 1]), energy="arap").success
    True
    """
    mesh = as_seamed_mesh(mesh)
    checked = _check_fixed(mesh, fixed)
    return each_island(
        mesh, lambda island: harmonise_map(_domain(island, checked), island.uv, HarmoniseOptions(**rest))
    )


def injective_map(
    mesh: SeamedMesh | MeshLike,
    *,
    fixed: ArrayLike | None = None,
    to: str | os.PathLike[str] | list[FloatArray] | None = None,
    corners: Mapping[int, int] | Literal["auto"] | None = None,
    reference: Any = None,
    islands: Collection[int] | None = None,
    **rest: Any,
) -> MappedAtlas:
    """Map every island again with a fixed boundary; see `quasiharmonic.injective_map`.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
    fixed : (k,) array of int, optional
    islands : collection of int, optional
        As for `polish`.
    to : str, path, or list of (k, 2) arrays, optional
        Outline to which the boundaries are mapped, such as ``"letter:R"``, or its contours: each island gets a copy
        beside the one before. Holes of the outline are filled for an island without holes.
    corners : mapping of int to int or "auto", optional
        For ``to``: the number of the outline's corner for each of some vertices of the mesh, or corners by angle.
    reference, **rest
        Options of `quasiharmonic.injective_map`.

    Returns
    -------
    MappedAtlas
        If an island has no injective map, its result reports it.

    See Also
    --------
    quasiharmonic.injective_map : A surface without seams.
    quasiharmonic.targets : The outlines.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(4, 4)
    >>> atlas.injective_map(atlas.SeamedMesh(V, F), to="disk").success
    True
    """
    mesh = as_seamed_mesh(mesh)
    checked = _check_fixed(mesh, fixed)
    if to is None and corners is not None:
        raise ValueError("corners need an outline: give one by to")
    if to is not None and checked is not None:
        raise ValueError("an outline fixes the boundary: omit fixed or to")
    contours = [] if to is None else to if isinstance(to, list) else outline(to)
    copies = count()
    spec = None if corners is None else CornerSpec("auto" if corners == "auto" else tuple(corners.items()))

    def pose(island: Island) -> Problem:
        if to is None:
            own = _select_fixed(island, checked)
            return Problem(island.V, island.F, own, island.uv[own], reference=reference)
        chosen = None if spec is None else spec.within(island.vertices)
        return fit_boundary(
            island.V, island.F, contours, corners=chosen, reference=reference, beside=next(copies)
        ).problem

    return each_island(mesh, lambda island: solve(pose(island), **rest), reflect=to is None, only=islands)


def flatten(
    mesh: SeamedMesh | MeshLike,
    *,
    start: bool = False,
    fixed: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    unit_square: bool = False,
    gap: float = 0.0,
    islands: Collection[int] | None = None,
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
    islands : collection of int, optional
        Indices of the islands that are flattened, in the order of ``mesh.islands``; all by default. With a choice, each
        keeps its centre, direction and area, and the other islands keep their positions. Islands may then overlap.

    Returns
    -------
    MappedAtlas
        In the surface's unit of length, or in the unit square. After Ctrl-C the remaining islands keep their positions,
        and the others keep their centre, direction and area.

    See Also
    --------
    quasiharmonic.flatten : One surface without seams.
    atlas.pack : Packs the islands afterwards.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> mapped = atlas.flatten(atlas.SeamedMesh(V, F).cut([[1, 4], [4, 7]]))
    >>> mapped.success, len(mapped.islands)
    (True, 2)
    """
    mesh = as_seamed_mesh(mesh)
    _reject_weld(rest)
    check_bool("start", start)
    check_bool("unit_square", unit_square)
    check_non_negative("gap", gap)
    weights = None if weights is None else positive_weights(weights, len(mesh.F))
    checked = _check_fixed(mesh, fixed)
    if islands is not None and unit_square:
        raise ValueError("some islands cannot be scaled to the unit square alone: omit unit_square or islands")
    if checked is not None and unit_square:
        raise ValueError("fixed vertices determine the size of the map: omit unit_square")
    if checked is not None and mesh.uv is None:
        raise ValueError("the fixed vertices have no target positions: the mesh has no texture coordinates")

    def lay(island: Island) -> MapResult:
        own: dict[str, Any] = {} if weights is None else {"weights": weights[island.triangles]}
        if start:
            own["start"] = island.uv
        pins = _select_fixed(island, checked) if checked is not None else np.empty(0, dtype=np.int64)
        if pins.size:
            own |= {"fixed": pins, "target": island.uv[pins]}
        result = free_boundary.flatten(island.V, island.F, **own, **rest)
        if islands is None or pins.size or np.isnan(island.uv).any():
            return result
        uv = fit_in_place(island, result.uv)
        return replace(result, uv=uv, certificate=certify(island.F, uv))

    if islands is not None:
        return each_island(mesh, lay, reflect=start, only=islands)
    faces = orient_islands(mesh, reflect=start)
    if checked is not None and checked.size and len(faces) > 1 and not any(mirrored for _, mirrored in faces):
        return _flatten_together(mesh, checked, weights, start, {"gap": gap, **rest})
    mapped = each_island(mesh, lay, reflect=start)
    uv = [island.result.uv for island in mapped.islands]
    if left := [island.uv for island in mesh.islands[len(uv) :]]:
        # After Ctrl-C the remaining islands keep their maps, so the others return to their places.
        uv = [fit_in_place(island, places) for island, places in zip(mesh.islands, uv, strict=False)]
        return replace(mapped, mesh=mesh.with_places([*uv, *left]))
    if checked is None and len(uv) > 1:
        uv = place_in_row(uv, gap)
    if unit_square:
        sizes = np.cumsum([len(places) for places in uv])[:-1]
        uv = np.split(fit_unit_square(np.concatenate(uv)), sizes)
    return replace(mapped, mesh=mesh.with_places(uv))


def _reject_weld(rest: dict[str, Any]) -> None:
    """Raise ValueError for ``weld``, which would close the seams inside islands."""
    if "weld" in rest:
        raise ValueError("islands are not welded one by one: omit weld, and weld the mesh first (SeamedMesh.weld)")


def _flatten_together(
    mesh: SeamedMesh, fixed: IntArray, weights: FloatArray | None, start: bool, rest: dict[str, Any]
) -> MappedAtlas:
    """Flatten several islands of which some have fixed vertices as one mesh, so that they do not overlap."""
    islands = mesh.islands
    for island in islands:
        with name_island(island, len(islands)):
            free_boundary.check_flattenable(island.V, island.F)
    # Without seams, use the mesh's numbering, so that messages name the mesh's elements.
    order, by_mesh = (np.argsort(_concatenate(islands, name), kind="stable") for name in ("vertices", "triangles"))
    number = np.argsort(order)
    ends = np.cumsum([len(island.V) for island in islands])
    numbers = np.split(number, ends[:-1])
    pins = [_select_fixed(island, fixed) for island in islands]
    own: dict[str, Any] = {} if weights is None else {"weights": weights[np.sort(_concatenate(islands, "triangles"))]}
    if start:
        own["start"] = _concatenate(islands, "uv")[order]
    result = free_boundary.flatten(
        _concatenate(islands, "V")[order],
        np.concatenate([of[island.F] for island, of in zip(islands, numbers, strict=True)])[by_mesh],
        fixed=np.concatenate([of[own_pins] for own_pins, of in zip(pins, numbers, strict=True)]),
        target=np.concatenate([island.uv[own_pins] for island, own_pins in zip(islands, pins, strict=True)]),
        **own,
        **rest,
    )
    # There is one result for all islands, so its stages, history and time are reported once.
    reports = [result, *[replace(result, stages=[], history=[], diagnosis=None, seconds=0.0) for _ in islands[1:]]]
    places = [result.uv[of] for of in numbers]
    done = [
        MappedIsland(island.triangles, False, replace(one, uv=uv, certificate=certify(island.F, uv)))
        for island, one, uv in zip(islands, reports, places, strict=True)
    ]
    return MappedAtlas(mesh.with_places(places), tuple(done))


def _concatenate(islands: Sequence[Island], name: str) -> Any:
    """Concatenate an attribute of all islands."""
    return np.concatenate([getattr(island, name) for island in islands])


def pack(
    mesh: SeamedMesh | MeshLike,
    *,
    resolution: int | tuple[int, int] = 1024,
    padding: float = 4,
    rotate: bool = True,
    stack: bool = False,
) -> SeamedMesh:
    """Pack islands into the unit square by their shapes, as large as possible and at one texel density.

    Parameters
    ----------
    mesh : SeamedMesh, or a mesh or path that stands for one
        Its islands are injective or mirrored. Mirrored islands stay mirrored.
    resolution, padding, rotate, stack
        As for `quasiharmonic.apps.atlas.packing.pack.pack_charts`: texels along a side of the texture, the minimum
        distance between islands in texels, and whether islands may be rotated and congruent ones share their position.

    Returns
    -------
    SeamedMesh
        Islands without area on the surface or in the plane have the average scale.

    Raises
    ------
    ValueError
        If an island has no positions or the islands do not fit; if an island has triangles so thin that rounding to
        positions in the square would invert them.

    See Also
    --------
    atlas.pack_charts : Packs arrays into one or several textures.
    atlas.flatten : Makes the islands.

    Examples
    --------
    >>> from quasiharmonic import atlas
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> packed = atlas.pack(atlas.flatten(atlas.SeamedMesh(V, F).cut([[1, 4], [4, 7]])).mesh)
    >>> bool(packed.uv.min() >= 0), bool(packed.uv.max() <= 1)
    (True, True)
    """
    # Packing needs scipy.spatial, which takes longer to load than most maps take.
    from quasiharmonic.apps.atlas.packing.pack import pack_charts

    mesh = as_seamed_mesh(mesh)
    islands = mesh.islands
    charts = _scale_to_surface(islands, _surface_areas(mesh))
    packing = pack_charts(charts, resolution=resolution, padding=padding, rotate=rotate, stack=stack)
    for i, (uv, F) in enumerate(charts):
        mirrored = packing.placements[i].mirrored
        lost = inverted_triangles(F[:, ::-1] if mirrored else F, packing.uv[i])
        lost = np.setdiff1d(lost, inverted_triangles(F, uv))
        if lost.size:
            raise ValueError(
                f"island {i}: its {names_of('triangle', 'triangles', lost)} would be inverted by rounding in the unit "
                "square, too thin for that: polish the map first, or do not pack it"
            )
    return mesh.with_places(packing.uv)


def _scale_to_surface(islands: Sequence[Island], surface: FloatArray) -> list[tuple[FloatArray, IntArray]]:
    """Islands with areas proportional to those on the surface, with all mirrored triangles turned over."""
    positions = [map_array(f"uv of island {i}", island.uv) for i, island in enumerate(islands)]
    # Scale by a power of two to about unit size, so that squares do not overflow.
    largest = max((float(np.abs(uv).max()) for uv in positions), default=0.0)
    positions = [np.ldexp(uv, -int(np.frexp(largest)[1])) for uv in positions]
    F = [
        island.F[:, ::-1] if is_mirrored(island.F, uv) else island.F
        for island, uv in zip(islands, positions, strict=True)
    ]
    plane = np.array([np.abs(signed_areas(rows, in_units(uv, 0))).sum() for uv, rows in zip(positions, F, strict=True)])
    known = (plane > 0) & (surface > 0)
    mean = surface[known].sum() / plane[known].sum() if known.any() else 1.0
    scales = np.sqrt(np.divide(surface, plane, out=np.full(len(plane), mean), where=known))
    return [(uv * scale, rows) for uv, scale, rows in zip(positions, scales.tolist(), F, strict=True)]


def _surface_areas(mesh: SeamedMesh) -> FloatArray:
    """Areas of the islands on the surface, in a unit near the surface's size."""
    area = rest_shapes(mesh.V, mesh.F).m
    return np.array([area[island.triangles].sum() for island in mesh.islands])


def _check_fixed(mesh: SeamedMesh, fixed: ArrayLike | None) -> IntArray | None:
    if fixed is None:
        return None
    array = index_array("fixed", fixed).ravel()
    check_range("fixed", array, len(mesh.V))
    return array


def _select_fixed(island: Island, fixed: IntArray | None) -> IntArray:
    """Fixed vertices of an island; its boundary by default."""
    if fixed is None:
        return np.unique(boundary_edges(island.F, len(island.vertices)))
    return np.flatnonzero(np.isin(island.vertices, fixed))


def _domain(island: Island, fixed: IntArray | None) -> Domain:
    domain = Domain(island.V, island.F, _select_fixed(island, fixed))
    domain.check_boundary_fixed()
    return domain
