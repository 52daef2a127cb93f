"""What each format has no room for, said before anything is written."""

from __future__ import annotations

import os
from pathlib import Path

from quasiharmonic.io.gltfwrite import not_in_gltf
from quasiharmonic.io.meshdata import MeshData
from quasiharmonic.io.ply import not_in_ply


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
    further = [] if mesh.carried is None else mesh.carried.further()
    if suffix in (".glb", ".gltf"):
        return not_in_gltf(mesh)
    if suffix == ".ply":
        return not_in_ply(mesh)
    if suffix == ".off":
        return ["the surface: an OFF file has room for its map alone"]
    return further
