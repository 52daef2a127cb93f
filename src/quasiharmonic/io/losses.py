"""What each format has no room for, said before anything is written."""

from __future__ import annotations

import os
from pathlib import Path

from quasiharmonic.io.formats.gltfwrite import not_in_gltf
from quasiharmonic.io.formats.ply import not_in_ply
from quasiharmonic.io.meshdata import MeshData

#: Suffixes of files that can have a texture.
TEXTURED = ".obj", ".glb", ".gltf"


def not_held(path: str | os.PathLike[str], mesh: MeshData) -> list[str]:
    """What a mesh has that a file written of it will not have.

    Parameters
    ----------
    path : str or path-like
        The file; the suffix of its name says the format.
    mesh : MeshData
        What is going to be written.

    Returns
    -------
    list of str
        In words; empty where nothing is lost.
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
