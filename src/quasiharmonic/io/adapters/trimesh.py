"""Conversion of a mesh and its map to an object of trimesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray, pad_to_space
from quasiharmonic.util.optional import explain_missing

if TYPE_CHECKING:
    from trimesh import Trimesh


def make_trimesh(
    V: FloatArray, F: IntArray, uv: FloatArray, *, like: Any = None, rows: IntArray | None = None
) -> Trimesh:
    """Return a trimesh.Trimesh with the map as texture coordinates; vertices and triangles keep their order.

    A planar mesh is placed at z = 0. From a trimesh.Trimesh ``like``, of whose vertices ``rows`` (n,) were made, come
    colours and attributes of vertices, attributes of faces, the material and the metadata. ImportError if trimesh is
    not installed.
    """
    with explain_missing("to_trimesh needs trimesh", "trimesh"):
        import trimesh
    made = trimesh.Trimesh(vertices=pad_to_space(V), faces=F, process=False)
    if not isinstance(like, trimesh.Trimesh):
        made.visual = trimesh.visual.TextureVisuals(uv=uv.copy())  # type: ignore[no-untyped-call]
        return made
    visual: Any = like.visual
    material = getattr(visual, "material", None)
    made.visual = trimesh.visual.TextureVisuals(uv=uv.copy(), material=material)  # type: ignore[no-untyped-call]
    colours = visual.vertex_colors if visual.kind == "vertex" else getattr(visual, "vertex_attributes", {}).get("color")
    if colours is not None:
        made.visual.vertex_attributes["color"] = np.asarray(colours)[rows]
    made.vertex_attributes.update({name: np.asarray(of)[rows] for name, of in like.vertex_attributes.items()})
    made.face_attributes.update({name: np.array(of) for name, of in like.face_attributes.items()})
    made.metadata.update(like.metadata)
    return made
