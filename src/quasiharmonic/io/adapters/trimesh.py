"""Conversion of a mesh and its map to an object of trimesh."""

from __future__ import annotations

from typing import TYPE_CHECKING

from quasiharmonic.util.arrays import FloatArray, IntArray, pad_to_space
from quasiharmonic.util.optional import explain_missing

if TYPE_CHECKING:
    from trimesh import Trimesh


def make_trimesh(V: FloatArray, F: IntArray, uv: FloatArray) -> Trimesh:
    """Return a trimesh.Trimesh with the map as texture coordinates; vertices and triangles keep their order.

    A planar mesh is placed at z = 0. ImportError if trimesh is not installed.
    """
    with explain_missing("to_trimesh needs trimesh", "trimesh"):
        import trimesh
    made = trimesh.Trimesh(vertices=pad_to_space(V), faces=F, process=False)
    made.visual = trimesh.visual.TextureVisuals(uv=uv.copy())  # type: ignore[no-untyped-call]
    return made
