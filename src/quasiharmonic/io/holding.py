"""What each format has no room for, said before anything is written."""

from __future__ import annotations

import os
from pathlib import Path

from quasiharmonic.io.gltfwrite import not_in_gltf
from quasiharmonic.io.materials import missing_libraries
from quasiharmonic.io.meshdata import MeshData
from quasiharmonic.io.ply import not_in_ply

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
    own = []
    if (
        mesh.texture is not None
        and suffix in TEXTURED
        and any(line.startswith(b"usemtl") for line in mesh.statements.split(b"\n"))
    ):
        own = ["its own materials, in place of which the picture is"]
    further = [] if mesh.carried is None else mesh.carried.further()
    if suffix in (".glb", ".gltf"):
        return [*own, *not_in_gltf(mesh)]
    if suffix == ".ply":
        return not_in_ply(mesh)
    if suffix == ".off":
        return ["the surface: an OFF file has room for its map alone"]
    return [*own, *further, *(f"the materials of {name}, which is nowhere" for name in missing_libraries(path, mesh))]
