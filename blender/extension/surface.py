"""Conversion of a Blender mesh to a surface with seams, and of positions back into the mesh's UV layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from quasiharmonic import atlas
from quasiharmonic.apps.atlas.atlas_verdict import MIRROR, is_mirrored
from quasiharmonic.atlas import AtlasVerdict
from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, count_of

from .rounding import in_single_precision

# Positions of a vertex that differ by at most this many spacings of single precision are merged. Blender's unwraps
# and primitives store them with different roundings in the loops of the vertex.
_ROUNDING = 4


class Refused(Exception):  # noqa: N818 (the name matches the messages)
    """An error that the user can resolve; the message is one sentence."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The mesh of an object.

    Attributes
    ----------
    mesh : SeamedMesh
        Its triangles, in Blender's own triangulation. Each corner refers to the row of the first loop at the same
        position; triangles that are not shown or not chosen have rows of -1. Positions are those of all loops.
    polygons : Polygons
        The mesh's faces, as rings of the triangles' corners.
    loops : (f, 3) int64
        The loop of each corner of each triangle.
    pinned : (l,) bool
        Whether the UV of each loop is pinned.
    shown, selected : (f,) bool
        Whether the face of each triangle is visible, and whether it is visible and selected. Outside of edit mode all
        faces are visible, and all are selected.
    """

    mesh: SeamedMesh
    polygons: Polygons
    loops: IntArray
    pinned: BoolArray
    shown: BoolArray
    selected: BoolArray

    @property
    def blank(self) -> bool:
        """Whether every visible face is an island, as in a new UV layer, where every face fills the square."""
        faces = np.unique(self.polygons.of_triangle[self.mesh.mapped])
        return len(faces) == len(self.mesh.islands) > 1

    def choose(self, mesh: SeamedMesh) -> SeamedMesh:
        """Return a mesh of the same triangles with the visible islands that have a selected triangle.

        If no triangle is selected, all visible islands are chosen.
        """
        mesh = restrict(mesh, self.shown)
        if not self.selected.any() or self.selected.all():
            return mesh
        chosen = np.zeros(len(mesh.F), dtype=np.bool_)
        for island in mesh.islands:
            chosen[island.triangles] = self.selected[island.triangles].any()
        return restrict(mesh, chosen)

    def with_all(self, uv: FloatArray) -> SeamedMesh:
        """Return the mesh with positions (l, 2) of all loops, also of those that are hidden or not chosen."""
        vertex = np.empty(len(uv), dtype=np.int64)
        vertex[self.loops] = self.mesh.F
        return SeamedMesh(self.mesh.V, self.mesh.F, _welded(vertex, uv.astype(np.float32))[self.loops], uv)


def read(data: bpy.types.Mesh, *, edited: bool, chosen_only: bool) -> Surface:
    """Read a mesh, its active UV layer and pins, and which faces are visible and selected.

    Parameters
    ----------
    data : bpy.types.Mesh
        In object mode.
    edited : bool
        Leave out hidden faces, as in edit mode.
    chosen_only : bool
        If any face is selected, leave out islands without selected faces.

    Raises
    ------
    Refused
        If the mesh has no faces, or all faces are hidden.
    """
    if not len(data.polygons):
        raise Refused("the mesh has no faces")
    V = numbers(data.vertices, "co", 3, np.float32).astype(np.float64)
    vertex = numbers(data.loops, "vertex_index", 1, np.int32).astype(np.int64).ravel()
    starts = np.append(numbers(data.polygons, "loop_start", 1, np.int32).ravel(), len(vertex)).astype(np.int64)
    data.calc_loop_triangles()
    T = numbers(data.loop_triangles, "loops", 3, np.int32).astype(np.int64)
    # Every corner of a face is a corner of one of its triangles.
    polygons = Polygons(np.unique(T, return_index=True)[1], starts)
    shown = selected = np.ones(len(T), dtype=np.bool_)
    if edited:
        face = polygons.of_triangle
        shown = ~numbers(data.polygons, "hide", 1, np.bool_).ravel()[face]
        selected = shown & numbers(data.polygons, "select", 1, np.bool_).ravel()[face]
    if not shown.any():
        raise Refused("all faces are hidden")
    layer, pinned = data.uv_layers.active, np.zeros(len(vertex), dtype=np.bool_)
    if layer is None:
        mesh = SeamedMesh(V, vertex[T])
    else:
        places = numbers(layer.uv, "vector", 2, np.float32)
        mesh = SeamedMesh(V, vertex[T], _welded(vertex, places)[T], places.astype(np.float64))
        if len(layer.pin):
            pinned = numbers(layer.pin, "value", 1, np.bool_).ravel()
    surface = Surface(mesh, polygons, T, pinned, shown, selected)
    return replace(surface, mesh=surface.choose(mesh) if chosen_only else restrict(mesh, shown))


def restrict(mesh: SeamedMesh, chosen: BoolArray) -> SeamedMesh:
    """Return a mesh without the positions of the triangles outside of a mask (f,)."""
    if chosen.all():
        return mesh
    return SeamedMesh(mesh.V, mesh.F, np.where(chosen[:, None], mesh.FT, -1), mesh.uv)


def require_map(surface: Surface) -> None:
    """Raise `Refused` if the mesh has no UV layer."""
    if surface.mesh.uv is None:
        raise Refused("the mesh has no UV map: flatten it first")


def require_local(thing: bpy.types.Object) -> None:
    """Raise `Refused` if the mesh of an object is linked from another file."""
    if thing.data.library is not None:
        raise Refused(f"{thing.name} is linked from another file, so its mesh cannot be changed: make it local")


def reflect_single(mesh: SeamedMesh) -> SeamedMesh:
    """Return the reflection of a map with a single island that is mirrored, and any other map as it is."""
    if len(mesh.islands) == 1 and is_mirrored(mesh.islands[0].F, mesh.islands[0].uv):
        return SeamedMesh(mesh.V, mesh.F, mesh.FT, mesh.uv * MIRROR)
    return mesh


def certify(mesh: SeamedMesh) -> AtlasVerdict:
    """Certify a map as `atlas.certify` does, but also call a single island mirrored if all its triangles are negative.

    In Blender the single island is often one of several, the chosen one.
    """
    upright = reflect_single(mesh)
    verdict = atlas.certify(upright)
    if upright is mesh:
        return verdict
    return replace(verdict, islands=tuple(replace(island, mirrored=True) for island in verdict.islands))


def describe_others(layers: Sequence[tuple[Surface, FloatArray, BoolArray]]) -> str:
    """Return a sentence on the islands of UV layers that were left unchanged, and on those that overlap new ones.

    Parameters
    ----------
    layers : sequence of tuple
        Of each mesh in the texture: its surface, the positions of its loops (l, 2), and whether each triangle changed.
    """
    changed = np.concatenate([mask for _, _, mask in layers])
    if changed.all():
        return ""
    vertices = np.cumsum([0, *(len(here.mesh.V) for here, _, _ in layers)])
    loops = np.cumsum([0, *(len(uv) for _, uv, _ in layers)])
    whole = [here.with_all(uv) for here, uv, _ in layers]
    verdict = atlas.certify(
        SeamedMesh(
            np.concatenate([one.V for one in whole]),
            np.concatenate([one.F + first for one, first in zip(whole, vertices[:-1], strict=True)]),
            np.concatenate([one.FT + first for one, first in zip(whole, loops[:-1], strict=True)]),
            np.concatenate([one.uv for one in whole]),
        )
    )
    new = np.array([changed[island.triangles].any() for island in verdict.islands])
    if new.all():
        return ""
    pairs = verdict.overlapping[new[verdict.overlapping].sum(axis=1) == 1]
    others = pairs[~new[pairs]] if len(pairs) else pairs
    said = f" {count_of('other island', 'other islands', np.count_nonzero(~new))} unchanged"
    return f"{said}, of which {len(np.unique(others))} overlap the new ones." if others.size else f"{said}."


def marked_edges(data: bpy.types.Mesh, mark: str) -> IntArray:
    """Return the edges (k, 2) with a mark, ``"use_seam"`` or ``"use_edge_sharp"``, by their vertices."""
    marked = numbers(data.edges, mark, 1, np.bool_).ravel()
    return numbers(data.edges, "vertices", 2, np.int32).astype(np.int64)[marked]


def write(data: bpy.types.Mesh, surface: Surface, mapped: SeamedMesh) -> SeamedMesh:
    """Write positions into the active UV layer; create a layer if there is none.

    Returns
    -------
    SeamedMesh
        The map as stored by Blender, in single precision.

    Raises
    ------
    Refused
        If the mesh has the maximum number of UV layers and none is active.
    """
    layer = require_layer(data)
    rounded = in_single_precision(mapped)
    places = numbers(layer.uv, "vector", 2, np.float32)
    places[surface.loops[rounded.mapped]] = rounded.uv[rounded.FT[rounded.mapped]]
    set_places(data, layer, places)
    return SeamedMesh(mapped.V, mapped.F, np.where(mapped.FT >= 0, surface.loops, -1), places.astype(np.float64))


def require_layer(data: bpy.types.Mesh) -> bpy.types.MeshUVLoopLayer:
    """Return the active UV layer; create one if there is none. Raise `Refused` if there is no room for it."""
    layer = data.uv_layers.active or data.uv_layers.new(name="UVMap")
    if layer is None:
        raise Refused("the mesh has no room for another UV map")
    return layer


def set_places(data: bpy.types.Mesh, layer: bpy.types.MeshUVLoopLayer, places: FloatArray) -> None:
    """Write the positions of all loops (l, 2) into a UV layer."""
    # Undo shares the array of layer.uv, so writing there could not be undone.
    data.attributes[layer.name].data.foreach_set("vector", places.astype(np.float32).ravel())
    data.update()


def select_faces(context: bpy.types.Context, found: Sequence[tuple[bpy.types.Mesh, Surface, IntArray]]) -> None:
    """Select faces of meshes and deselect all others of these, in object mode; switch to face selection."""
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    for data, here, faces in found:
        chosen = np.zeros(len(here.polygons), dtype=np.bool_)
        chosen[faces] = True
        # In face selection mode, edit mode selects the edges and vertices of these faces by itself.
        data.polygons.foreach_set("select", chosen)
    context.tool_settings.mesh_select_mode = (False, False, True)


def numbers(items: Any, name: str, width: int, kind: type) -> Any:
    """Return an attribute of all items of a Blender collection as an array (n, width) of Blender's own type."""
    values = np.empty(len(items) * width, dtype=kind)
    items.foreach_get(name, values)
    return values.reshape(-1, width)


def _welded(vertex: IntArray, places: FloatArray) -> IntArray:
    """Return for every loop the first loop of its vertex at the same position, up to rounding; (l,) int64."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    near = _ROUNDING * np.spacing(np.abs(places).max(axis=1))
    order = np.argsort(vertex, kind="stable")
    pairs = [np.empty((2, 0), dtype=np.int64)]
    for step in range(1, int(np.bincount(vertex).max())):
        one, other = order[:-step], order[step:]
        same = vertex[one] == vertex[other]
        one, other = one[same], other[same]
        pairs.append(np.stack([one, other])[:, (np.abs(places[one] - places[other]).max(axis=1) <= near[one])])
    ends = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(ends.shape[1], dtype=np.int8), tuple(ends)), shape=(len(vertex), len(vertex)))
    label = connected_components(graph, directed=False)[1]
    return np.unique(label, return_index=True)[1][label]
