"""Outlines to fit an island to: a rectangle, a disk, a letter, or an object of the scene seen from above."""

from __future__ import annotations

import bpy
import numpy as np

from quasiharmonic import targets
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.util.arrays import FloatArray, IntArray

from .surface import Refused, numbers

# Points of an outline closer than this fraction of its size are merged.
_SAME = 1e-6


def rectangle(height: float) -> list[FloatArray]:
    """Return the outline of a rectangle of width 1."""
    return [targets.rectangle(1.0, height)]


def disk() -> list[FloatArray]:
    """Return the outline of a disk in the unit square."""
    return _in_unit_square([targets.disk()])


def of_letter(letter: str) -> list[FloatArray]:
    """Return the outline of a letter in Blender's own font.

    Raises
    ------
    Refused
        If there is not exactly one letter, or its outline has several pieces or meets itself.
    """
    if len(letter.strip()) != 1:
        raise Refused("name a letter, and only one")
    text = bpy.data.curves.new("qhm letter", type="FONT")
    text.body = letter.strip()
    thing = bpy.data.objects.new("qhm letter", text)
    remedy = "choose another letter, or a text object in another font as curve"
    try:
        contours = of_object(thing)
    except ValueError as error:
        raise Refused(f"the outline of {text.body!r} in Blender's font is not valid: {remedy}. {error}") from None
    finally:
        bpy.data.objects.remove(thing)
        bpy.data.curves.remove(text)
    # Holes run clockwise.
    pieces = sum(targets.signed_area(contour) > 0 for contour in contours)
    if pieces > 1:
        raise Refused(f"{letter.strip()!r} is in {pieces} separate pieces in Blender's font: {remedy}")
    return contours


def of_named(context: bpy.types.Context, name: str) -> list[FloatArray]:
    """Return the outline of an object, by its name.

    Raises
    ------
    Refused
        If the object does not exist or has no outline.
    """
    thing = context.scene.objects.get(name)
    if thing is None:
        raise Refused(f"the scene has no object {name!r}: name a closed curve")
    return of_object(thing.evaluated_get(context.evaluated_depsgraph_get()))


def of_object(thing: bpy.types.Object) -> list[FloatArray]:
    """Return closed contours (k, 2), in the unit square, of a curve, text or mesh object seen from above.

    Raises
    ------
    Refused
        If the object has no outline.
    """
    try:
        data = thing.to_mesh()
    except RuntimeError:
        raise Refused(f"{thing.name} has no outline: choose a closed curve") from None
    turn = np.array(thing.matrix_world)[:2, :3]
    points = numbers(data.vertices, "co", 3, np.float32).astype(np.float64) @ turn.T
    ends = numbers(data.edges, "vertices", 2, np.int32).astype(np.int64)
    if len(data.polygons):
        # In filled areas, only edges of exactly one face belong to the outline.
        sides = numbers(data.loops, "edge_index", 1, np.int32).ravel()
        ends = ends[np.bincount(sides, minlength=len(ends)) == 1]
    thing.to_mesh_clear()
    if not len(ends):
        raise Refused(f"{thing.name} has no outline: choose a closed curve, without bevel")
    # A filled curve has duplicate points where its faces meet its outline.
    unit = np.ptp(points, axis=0).max() * _SAME or 1.0
    _, first, same = np.unique((points / unit).round(), axis=0, return_index=True, return_inverse=True)
    found = [_drop_spikes(points[first][ring]) for ring in _rings(same.ravel()[ends])]
    if not found:
        raise Refused(f"{thing.name} has no closed outline: choose a closed curve")
    return _in_unit_square(targets.nested(found))


def _in_unit_square(contours: list[FloatArray]) -> list[FloatArray]:
    every = np.concatenate(contours)
    low, size = every.min(axis=0), np.ptp(every, axis=0).max()
    return [(contour - low) / size for contour in contours]


def _drop_spikes(contour: FloatArray) -> FloatArray:
    """Return a contour (k, 2) without points at which it turns back onto itself; Blender's letter Q has one."""
    while len(contour) > 3:
        before, after = (np.roll(contour, step, axis=0) for step in (1, -1))
        back = ((before - contour) * (after - contour)).sum(axis=1) > 0
        spikes = np.flatnonzero(back & (orientation(before, contour, after) == 0))
        if not spikes.size:
            break
        contour = np.delete(contour, spikes[0], axis=0)
    return contour


def _rings(ends: IntArray) -> list[list[int]]:
    """Return the vertices of each closed chain of edges."""
    near: dict[int, list[int]] = {}
    for a, b in np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0).tolist():
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    rings, seen = [], set()
    for first in near:
        chain, here = [], first
        while here not in seen:
            seen.add(here)
            chain.append(here)
            here = next((v for v in near[here] if v not in seen), first)
        if len(chain) > 2 and first in near[chain[-1]] and all(len(near[v]) == 2 for v in chain):
            rings.append(chain)
    return rings
