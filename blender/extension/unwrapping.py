"""Several objects as one model for `quasiharmonic.unwrap`, and its result in their UV layers and seams."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import bpy
import numpy as np

from quasiharmonic import unwrap
from quasiharmonic.apps.unwrapping.result import UnwrapResult
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

from . import surface
from .surface import Refused, Surface, numbers

# Factor on the cost of a seam inside a face, which Blender cannot store.
_INSIDE_FACE = 1e3
# Objects whose scales along the axes differ by a smaller share are scaled uniformly.
_UNIFORM = 1e-6


@dataclass(frozen=True, eq=False)
class Part:
    """The faces of one object that are unwrapped.

    Attributes
    ----------
    data : bpy.types.Mesh
    surface : Surface
        The whole mesh.
    chosen : (f,) bool
        Whether each triangle is unwrapped.
    V : (n, 3) float64
        Positions at the object's scale.
    seams, sharp : (s, 2) int64
        The marked seams, and the sharp edges.
    pinned : (f,) bool
        Whether an island has pinned UVs; it is not unwrapped.
    """

    data: bpy.types.Mesh
    surface: Surface
    chosen: BoolArray
    V: FloatArray
    seams: IntArray
    sharp: IntArray
    pinned: BoolArray

    @property
    def F(self) -> IntArray:
        """The chosen triangles (k, 3)."""
        return self.surface.mesh.F[self.chosen]

    def own(self, edges: IntArray) -> IntArray:
        """Return the edges (k, 2) among some that the chosen triangles have."""
        n = len(self.V)
        here = edge_keys(self.F, self.F[:, (1, 2, 0)], n)
        return edges[np.isin(edge_keys(edges[:, 0], edges[:, 1], n), here)]


def read_parts(objects: Sequence[bpy.types.Object], *, edited: bool) -> list[Part]:
    """Read the faces to unwrap: in edit mode the selected ones, or all visible ones if none is selected.

    A mesh that several objects share is read once, at the scale of the first of them. Objects without such faces are
    left out.

    Raises
    ------
    Refused
        If there are no such faces, or the scale of an object is not finite.
    """
    parts: list[Part] = []
    for thing in objects:
        data = thing.data
        if any(part.data == data for part in parts) or not len(data.polygons):
            continue
        if edited and numbers(data.polygons, "hide", 1, np.bool_).all():
            continue
        here = surface.read(data, edited=edited, chosen_only=False)
        matrix = np.array(thing.matrix_world)[:3, :3]
        if not np.isfinite(matrix).all():
            raise Refused(f"the scale or rotation of {thing.name} is not finite: clear it (Object > Clear)")
        V = here.mesh.V @ _stretch_of(matrix)
        seams, sharp = (surface.marked_edges(data, name) for name in ("use_seam", "use_edge_sharp"))
        parts.append(Part(data, here, here.selected, V, seams, sharp, _pinned_islands(here)))
    if not parts:
        hidden = edited and any(len(thing.data.polygons) for thing in objects)
        raise Refused("all faces are hidden" if hidden else "the mesh has no faces")
    if not any(part.chosen.any() for part in parts):
        parts = [replace(part, chosen=part.surface.shown) for part in parts]
    parts = [part for part in parts if part.chosen.any()]
    free = [replace(part, chosen=part.chosen & ~part.pinned) for part in parts]
    if not any(part.chosen.any() for part in free):
        raise Refused("all islands have pinned UVs, which stay: unpin some")
    return free


def _pinned_islands(here: Surface) -> BoolArray:
    """Whether each triangle (f,) belongs to an island with a pinned UV."""
    found = np.zeros(len(here.loops), dtype=np.bool_)
    if here.pinned.any():
        for island in here.mesh.islands:
            found[island.triangles] = here.pinned[here.loops[island.triangles]].any()
    return found


def unwrap_parts(
    parts: Sequence[Part],
    *,
    keep_seams: bool,
    hard_edges: bool,
    around: bool,
    callback: Callable[[Any], None],
    **options: Any,
) -> UnwrapResult:
    """Unwrap all parts as one model, into one texture.

    Parameters
    ----------
    parts : sequence of Part
    keep_seams : bool
        Cut at the marked seams of each part, or without any at the seams of its UVs.
    hard_edges : bool
        Cut at the sharp edges.
    around : bool
        Pass all triangles, of which those that are not chosen keep their UVs, and place new islands around them.
    callback : callable
    **options
        Options of `quasiharmonic.unwrap`.
    """
    V, F, costs, uv, faces = [], [], [], [], []
    seams, sharp = [], []
    first, right = 0, 0.0
    # Parts stand apart, because equal positions are joined. A power of two keeps the shifts exact.
    size = max(float(np.ptp(part.V, axis=0).max()) for part in parts) or 1.0
    step = 2.0 ** np.ceil(np.log2(2 * size)) if len(parts) > 1 else 0.0
    for part in parts:
        V.append(part.V + ([right - np.round(part.V[:, 0].min() / step) * step, 0, 0] if step else 0))
        whole = replace(part, chosen=np.ones_like(part.chosen)) if around else part
        F.append(whole.F + first)
        costs.append(_edge_costs(whole))
        faces.append(part.chosen)
        seams.append(part.own(part.seams) + first)
        sharp.append(part.own(part.sharp) + first)
        if around:
            old = part.surface.mesh.uv
            uv.append(np.zeros((*part.chosen.shape, 3, 2)) if old is None else old[part.surface.loops])
        elif keep_seams:
            uv.append(_seam_positions(part))
        first, right = first + len(part.V), right + 2 * step
    return unwrap(
        np.concatenate(V),
        np.concatenate(F),
        edge_costs=np.concatenate(costs),
        uv=np.concatenate(uv) if uv else None,
        hard_edges=np.concatenate(sharp) if hard_edges else None,
        **({"faces": np.concatenate(faces), "seams": np.concatenate(seams) if keep_seams else None} if around else {}),
        callback=callback,
        **options,
    )


def write_parts(parts: Sequence[Part], result: UnwrapResult, *, around: bool, mark_seams: bool) -> int:
    """Write the texture coordinates of all parts; mark their seams and unmark other edges.

    ``around`` is that of `unwrap_parts`.

    Returns
    -------
    int
        Number of faces that seams cross: Blender has only one position for each of their corners.
    """
    layers = [surface.require_layer(part.data) for part in parts]
    excluded = np.zeros(len(result.indices), dtype=np.bool_)
    excluded[result.cleaned.excluded] = True
    corners = result.uvs[result.indices].astype(np.float32)
    if around:
        chosen = np.concatenate([part.chosen for part in parts])
        corners, excluded = corners[chosen], excluded[chosen]
    ends = np.cumsum([np.count_nonzero(part.chosen) for part in parts])[:-1]
    corners = np.split(corners, ends)
    crossed = 0
    for part, layer, uv, without in zip(parts, layers, corners, np.split(excluded, ends), strict=True):
        loops = part.surface.loops[part.chosen]
        places = numbers(layer.uv, "vector", 2, np.float32)
        # A corner of several triangles takes the position of one that is not degenerate.
        places[loops[without]] = uv[without]
        places[loops[~without]] = uv[~without]
        differs = (places[loops[~without]] != uv[~without]).any(axis=(1, 2))
        face = part.surface.polygons.of_triangle[part.chosen]
        crossed += np.unique(face[~without][differs]).size
        surface.set_places(part.data, layer, places)
        if mark_seams:
            _mark_seams(part, places, np.unique(face))
    return crossed


def describe_others(parts: Sequence[Part]) -> str:
    """Return a sentence on the islands of the parts that were not unwrapped, once the others are written."""
    layers = [numbers(part.data.uv_layers.active.uv, "vector", 2, np.float32).astype(np.float64) for part in parts]
    surfaces = [part.surface for part in parts]
    return surface.describe_others(list(zip(surfaces, layers, (part.chosen for part in parts), strict=True)))


def _stretch_of(matrix: FloatArray) -> FloatArray:
    """Return the scale and shear (3, 3) of an object's matrix, without rotation and reflection."""
    _, scale, axes = np.linalg.svd(matrix)
    if not scale[-1] > 0:
        # An object that is flat has no area in some directions.
        return np.eye(3)
    if scale[0] - scale[-1] <= _UNIFORM * scale[0]:
        # An object without scale keeps its positions exactly.
        return np.eye(3) if abs(scale[0] - 1) <= _UNIFORM else scale[0] * np.eye(3)
    return np.asarray(axes.T @ np.diag(scale) @ axes)


def _edge_costs(part: Part) -> FloatArray:
    """Return the factors (k, 3) on the costs of seams: large inside faces."""
    mesh, n = part.surface.mesh, len(part.V)
    inside = part.surface.polygons.diagonals(mesh.F)
    at = np.isin(edge_keys(part.F, part.F[:, (1, 2, 0)], n), edge_keys(inside[:, 0], inside[:, 1], n))
    return np.where(at, _INSIDE_FACE, 1.0)


def _seam_positions(part: Part) -> FloatArray:
    """Return positions (k, 3, 2) that differ at the marked seams; without any, those of the UV layer."""
    mesh = part.surface.mesh
    seams = part.own(part.seams)
    if len(seams):
        row = SeamedMesh(mesh.V, part.F).cut(seams).FT
        return np.stack([row, np.zeros_like(row)], axis=2).astype(np.float64)
    if mesh.uv is None or part.surface.blank:
        return np.zeros((len(part.F), 3, 2))
    return mesh.uv[mesh.FT[part.chosen]]


def _mark_seams(part: Part, places: FloatArray, faces: IntArray) -> None:
    """Mark the edges of these faces whose sides have different positions; unmark their other edges inside the mesh."""
    data = part.data
    edge = numbers(data.loops, "edge_index", 1, np.int32).ravel().astype(np.int64)
    vertex = numbers(data.loops, "vertex_index", 1, np.int32).ravel()
    starts = part.surface.polygons.starts
    ahead = np.arange(len(edge)) + 1
    ahead[starts[1:] - 1] = starts[:-1]
    # Each side of an edge as the positions at its ends, smaller vertex first.
    swap = (vertex > vertex[ahead])[:, None]
    here, there = places, places[ahead]
    sides = np.concatenate([np.where(swap, there, here), np.where(swap, here, there)], axis=1)
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(np.diff(edge[order]) == 0)
    first, second = order[same], order[same + 1]
    apart = np.zeros(len(data.edges), dtype=np.bool_)
    apart[edge[first][(sides[first] != sides[second]).any(axis=1)]] = True
    chosen = np.zeros(len(part.surface.polygons), dtype=np.bool_)
    chosen[faces] = True
    mine = np.zeros(len(data.edges), dtype=np.bool_)
    mine[edge[np.repeat(chosen, np.diff(starts))]] = True
    mine &= np.bincount(edge, minlength=len(data.edges)) > 1
    seam = numbers(data.edges, "use_seam", 1, np.bool_).ravel()
    data.edges.foreach_set("use_seam", np.where(mine, apart, seam))
