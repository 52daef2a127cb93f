"""Mesh objects of Blender, for benchmarks of its operators; requires bpy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray

# Face attribute with the number of the triangle.
_NUMBER = "triangle"


@contextmanager
def mesh_object(V: FloatArray, F: IntArray) -> Iterator[bpy.types.Object]:
    """Yield an active mesh object with an empty UV layer, in object mode; remove it at the end.

    Blender does not accept some degenerate and repeated triangles. They are left out.
    """
    data = bpy.data.meshes.new("model")
    data.from_pydata(V.tolist(), [], F.tolist())
    number = data.attributes.new(_NUMBER, "INT", "FACE")
    number.data.foreach_set("value", np.arange(len(F), dtype=np.int32))
    data.validate()
    data.uv_layers.new()
    thing = bpy.data.objects.new("model", data)
    bpy.context.collection.objects.link(thing)
    bpy.context.view_layer.objects.active = thing
    try:
        yield thing
    finally:
        bpy.data.objects.remove(thing)
        bpy.data.meshes.remove(data)


@contextmanager
def all_faces_edited() -> Iterator[None]:
    """Edit the active object, with all faces selected."""
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    try:
        yield
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")


def read_corners(thing: bpy.types.Object, F: IntArray) -> FloatArray:
    """Return the UVs (f, 3, 2) at the corners of the triangles.

    A triangle that Blender has left out has those of a triangle with the same vertices, or zeros.
    """
    data = thing.data
    assert len(data.loops) == 3 * len(data.polygons)
    number, uv = np.empty(len(data.polygons), dtype=np.int32), np.empty(2 * len(data.loops), dtype=np.float32)
    at = np.empty(len(data.loops), dtype=np.int32)
    data.attributes[_NUMBER].data.foreach_get("value", number)
    data.uv_layers[0].uv.foreach_get("vector", uv)
    data.loops.foreach_get("vertex_index", at)
    # Blender may begin a triangle at another corner, so corners are found by their vertices.
    order = np.argsort(at.reshape(-1, 3), axis=1)
    sorted_uv = np.take_along_axis(uv.astype(np.float64).reshape(-1, 3, 2), order[:, :, None], axis=1)
    _, same = np.unique(np.sort(F, axis=1), axis=0, return_inverse=True)
    by_vertices = np.zeros((len(F), 3, 2))
    by_vertices[same.ravel()[number]] = sorted_uv
    corners = by_vertices[same.ravel()]
    corners[number] = sorted_uv
    rank = np.argsort(np.argsort(F, axis=1), axis=1)
    return np.take_along_axis(corners, rank[:, :, None], axis=1)
