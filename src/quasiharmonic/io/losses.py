"""List the data that a file format cannot store, before a file is written."""

from __future__ import annotations

import os
from pathlib import Path

from quasiharmonic.io.formats.gltfwrite import not_in_gltf
from quasiharmonic.io.formats.ply import not_in_ply
from quasiharmonic.io.meshdata import MeshData

#: Suffixes of files that can have a texture.
TEXTURED = ".obj", ".glb", ".gltf"


def not_held(path: str | os.PathLike[str], mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that the file will not contain.

    Parameters
    ----------
    path : str or path-like
        The file; the suffix of its name selects the format.
    mesh : MeshData
        The mesh to write.

    Returns
    -------
    list of str
        Descriptions for messages; empty if nothing is lost.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".off":
        return ["the surface: only the map is written"]
    if suffix == ".ply":
        return not_in_ply(mesh)
    painted = mesh.texture is not None and any(line.startswith(b"usemtl") for line in mesh.statements.split(b"\n"))
    lost = ["its own materials, which the image replaces"] if painted else []
    if suffix in (".glb", ".gltf"):
        return lost + not_in_gltf(mesh)
    if mesh.carried is not None:
        lost += [what for what in mesh.carried.further() if not (lost and what == "materials")]
    return lost
