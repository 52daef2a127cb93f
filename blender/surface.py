"""A Blender mesh as a surface with seams, and places back into its UV layer; nothing else of the mesh is touched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np

from quasiharmonic.mesh.polygons import Polygons, triangulated
from quasiharmonic.mesh.seams import SeamedMesh


class Refused(Exception):
    """What the user can do something about, in a sentence."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The mesh of an object.

    Attributes
    ----------
    mesh : SeamedMesh
        Its triangles, with a row of places for every loop; of triangles that are not chosen the rows are -1.
    polygons : Polygons
        The mesh's faces as rings of the triangles' corners.
    loops : (f, 3) int64
        The loop that each corner of a triangle is.
    """

    mesh: SeamedMesh
    polygons: Polygons
    loops: np.ndarray[Any, np.dtype[np.int64]]


def read(data: bpy.types.Mesh, *, chosen_only: bool) -> Surface:
    """Read a mesh, its active UV layer, and which faces are chosen.

    Parameters
    ----------
    data : bpy.types.Mesh
        In object mode.
    chosen_only : bool
        Leave out islands none of whose faces is selected, if a face is.

    Raises
    ------
    Refused
        When there are no faces, or a face is none.
    """
    if not len(data.polygons):
        raise Refused("The mesh has no faces")
    V = _numbers(data.vertices, "co", 3, np.float32).astype(np.float64)
    vertex = _numbers(data.loops, "vertex_index", 1, np.int32).astype(np.int64).ravel()
    starts = np.append(_numbers(data.polygons, "loop_start", 1, np.int32).ravel(), len(vertex)).astype(np.int64)
    try:
        T, polygons = triangulated(V, vertex, starts)
    except ValueError as error:
        raise Refused(f"The mesh has a {error}") from None
    layer = data.uv_layers.active
    uv = None if layer is None else _numbers(layer.uv, "vector", 2, np.float32).astype(np.float64)
    mesh = SeamedMesh(V, vertex[T], T, uv) if uv is not None else SeamedMesh(V, vertex[T])
    if chosen_only:
        mesh = _chosen(mesh, _numbers(data.polygons, "select", 1, np.bool_).ravel()[polygons.of_triangle])
    return Surface(mesh, polygons, T)


def require_map(surface: Surface) -> None:
    """Raise `Refused` where there is no UV layer."""
    if surface.mesh.uv is None:
        raise Refused("The mesh has no UV map: flatten it first")


def marked_seams(data: bpy.types.Mesh) -> np.ndarray[Any, np.dtype[np.int64]]:
    """The edges (k, 2) that are marked as seams, by vertices."""
    marked = np.array([edge.use_seam for edge in data.edges], dtype=np.bool_)
    return _numbers(data.edges, "vertices", 2, np.int32).astype(np.int64)[marked]


def write(data: bpy.types.Mesh, surface: Surface, mapped: SeamedMesh) -> SeamedMesh:
    """Write places into the active UV layer; one is made if there is none.

    Returns
    -------
    SeamedMesh
        The map as Blender has it, in single precision.
    """
    layer = data.uv_layers.active or data.uv_layers.new(name="UVMap")
    if layer is None:
        raise Refused("The mesh has no room for another UV map")
    places = _numbers(layer.uv, "vector", 2, np.float32)
    rows = mapped.FT[mapped.mapped]
    places[surface.loops[mapped.mapped]] = mapped.uv[rows]
    layer.uv.foreach_set("vector", np.ascontiguousarray(places, dtype=np.float32).ravel())
    data.update()
    return SeamedMesh(mapped.V, mapped.F, np.where(mapped.FT >= 0, surface.loops, -1), places.astype(np.float64))


def select_faces(data: bpy.types.Mesh, surface: Surface, triangles: np.ndarray[Any, np.dtype[np.int64]]) -> int:
    """Select the faces that some triangles are parts of, and no others; how many these are."""
    chosen = np.zeros(len(data.polygons), dtype=np.bool_)
    chosen[surface.polygons.of_triangle[triangles]] = True
    data.polygons.foreach_set("select", chosen)
    vertex = np.zeros(len(data.vertices), dtype=np.bool_)
    vertex[surface.mesh.F[triangles]] = True
    data.vertices.foreach_set("select", vertex)
    ends = _numbers(data.edges, "vertices", 2, np.int32)
    sides = np.sort(surface.mesh.F[triangles][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    keys = np.sort(ends, axis=1).astype(np.int64) @ [len(data.vertices), 1]
    data.edges.foreach_set("select", np.isin(keys, sides @ [len(data.vertices), 1]))
    return int(np.count_nonzero(chosen))


def contours(context: bpy.types.Context, thing: bpy.types.Object) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
    """Closed contours (k, 2) of a curve, text or mesh object, seen from above.

    Raises
    ------
    Refused
        When it has none.
    """
    evaluated = thing.evaluated_get(context.evaluated_depsgraph_get())
    try:
        data = evaluated.to_mesh()
    except RuntimeError:
        raise Refused(f"{thing.name} has no outline") from None
    points = _numbers(data.vertices, "co", 3, np.float32)[:, :2].astype(np.float64)
    ends = _numbers(data.edges, "vertices", 2, np.int32).astype(np.int64)
    if len(data.polygons):
        # Of what is filled, the edges of one face only.
        sides = _numbers(data.loops, "edge_index", 1, np.int32).ravel()
        ends = ends[np.bincount(sides, minlength=len(ends)) == 1]
    evaluated.to_mesh_clear()
    # Points that a filled curve has twice, where its faces meet its outline.
    where, same = np.unique(points.round(6), axis=0, return_inverse=True)
    found = [where[ring] for ring in _rings(same.ravel()[ends])]
    if not found:
        raise Refused(f"{thing.name} has no closed outline: choose a closed curve")
    return found


def _rings(ends: np.ndarray[Any, np.dtype[np.int64]]) -> list[list[int]]:
    """Vertices of the closed chains among some edges."""
    near: dict[int, list[int]] = {}
    for a, b in np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0).tolist():
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    rings, seen = [], set()
    for first in near:
        ring = [first]
        while first not in seen:
            seen.add(ring[-1])
            ahead = [v for v in near[ring[-1]] if v not in seen]
            if not ahead:
                if len(ring) > 2 and first in near[ring[-1]] and all(len(near[v]) == 2 for v in ring):
                    rings.append(ring)
                break
            ring.append(ahead[0])
    return rings


def _chosen(mesh: SeamedMesh, selected: np.ndarray[Any, np.dtype[np.bool_]]) -> SeamedMesh:
    """The islands in which a triangle is selected; all if none is."""
    if not selected.any() or selected.all():
        return mesh
    FT = np.full_like(mesh.FT, -1)
    for island in mesh.islands:
        if selected[island.triangles].any():
            FT[island.triangles] = mesh.FT[island.triangles]
    return SeamedMesh(mesh.V, mesh.F, FT, mesh.uv)


def _numbers(items: Any, name: str, width: int, kind: type) -> Any:
    values = np.empty(len(items) * width, dtype=kind)
    items.foreach_get(name, values)
    return values.reshape(-1, width)
