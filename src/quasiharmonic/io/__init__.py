"""Meshes, maps and problems in files.

The package builds on `geometry.mesh`. Each format is a module of `formats` or of `fem`; `adapters` accepts mesh objects
of other libraries. Start reading in `meshdata`, which is what every reader returns.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from numpy.typing import ArrayLike

from quasiharmonic.io.atomic import check_writable, new_folder, no_remains, write_whole
from quasiharmonic.io.errors import MeshFileError, OutputError
from quasiharmonic.io.formats.gltfmesh import read_gltf
from quasiharmonic.io.formats.gltfwrite import write_gltf
from quasiharmonic.io.formats.obj import read_obj, write_obj
from quasiharmonic.io.formats.off import read_off, write_off
from quasiharmonic.io.formats.ply import read_ply, write_ply
from quasiharmonic.io.formats.stl import read_stl
from quasiharmonic.io.handles import ProblemArrays, problem_arrays, problem_files, read_handles, read_problem
from quasiharmonic.io.losses import TEXTURED, not_held
from quasiharmonic.io.materials import companions
from quasiharmonic.io.meshdata import MeshData, check_mapped, in_plane, map_of, vertex_places
from quasiharmonic.io.per_triangle import FORMATS as PER_TRIANGLE_FORMATS
from quasiharmonic.io.per_triangle import write_per_triangle
from quasiharmonic.io.refined import refined_mesh
from quasiharmonic.io.seams import cut_at_seams, mapped, seamed, without_idle
from quasiharmonic.io.textures import Texture, checkerboard, read_texture

__all__ = [
    "MAP_WRITERS",
    "PER_TRIANGLE_FORMATS",
    "READERS",
    "TEXTURED",
    "MeshData",
    "MeshFileError",
    "OutputError",
    "ProblemArrays",
    "Texture",
    "check_mapped",
    "check_output",
    "check_writable",
    "checkerboard",
    "companions",
    "cut_at_seams",
    "map_of",
    "mapped",
    "new_folder",
    "no_remains",
    "not_held",
    "problem_arrays",
    "problem_files",
    "read_gltf",
    "read_handles",
    "read_mesh",
    "read_obj",
    "read_off",
    "read_ply",
    "read_problem",
    "read_stl",
    "read_texture",
    "refined_mesh",
    "seamed",
    "vertex_places",
    "without_idle",
    "write_gltf",
    "write_map",
    "write_mapped",
    "write_obj",
    "write_off",
    "write_per_triangle",
    "write_ply",
    "write_whole",
]


_Path = str | os.PathLike[str]
#: What a suffix means, in small letters: how to read a mesh, and how to write one with its map. A new format goes into
#: both, unless it has no room for a map.
READERS: dict[str, Callable[[_Path], MeshData]] = {
    ".obj": read_obj,
    ".off": read_off,
    ".ply": read_ply,
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".stl": read_stl,
}
MAP_WRITERS: dict[str, Callable[[_Path, MeshData], None]] = {
    ".obj": write_obj,
    # OFF has room for one set of coordinates only, and so for no seams.
    ".off": lambda path, mesh: write_off(path, in_plane(mesh)),
    ".ply": write_ply,
    ".glb": write_gltf,
    ".gltf": write_gltf,
}


def read_mesh(path: str | os.PathLike[str]) -> MeshData:
    """Read a triangle mesh, in the format that the suffix of its name says.

    Parameters
    ----------
    path : str or path-like
        An OBJ, OFF, PLY, GLB, glTF or STL file.

    Returns
    -------
    MeshData
        The mesh; see `read_obj`, `read_off`, `read_ply`, `read_gltf` and `read_stl`.

    Raises
    ------
    MeshFileError
        When the format is not supported, or the file cannot be read as what it should be.
    """
    return READERS[_suffix(path, "read")](path)


def write_map(path: str | os.PathLike[str], mesh: MeshData, uv: ArrayLike) -> None:
    """Write a mesh with a place for each vertex as its map; as `write_mapped`.

    Parameters
    ----------
    path : str or path-like
        Where to.
    mesh : MeshData
        The mesh, as `read_mesh` gave it.
    uv : (n, 2) float
        Place of every vertex in the plane.

    Raises
    ------
    MeshFileError, OutputError
        As `write_mapped`.
    ValueError
        When ``uv`` has another shape or is not finite.
    """
    write_mapped(path, mesh.with_map(uv))


def write_mapped(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write the map that a mesh carries, in the format that the suffix of the name says.

    OBJ, PLY and glTF get the mesh as it was read, with the map as its texture coordinates; OFF gets the map
    alone, as a mesh in the plane z = 0. Numbers are written such that reading them gives the same double,
    except in glTF, which has single precision. The file appears whole or not at all. What it will not hold of the
    mesh, `not_held` says.

    Parameters
    ----------
    path : str or path-like
        Where to.
    mesh : MeshData
        The mesh, as `read_mesh` gave it, with a map (`MeshData.with_map`, `MeshData.with_places`).

    Raises
    ------
    MeshFileError
        When the format is not supported, or has no room for seams.
    OutputError
        When it cannot be written; the old file is then untouched.
    """
    MAP_WRITERS[_suffix(path, "written")](path, mesh)


def check_output(path: str | os.PathLike[str]) -> None:
    """Say early whether `write_map` could write to ``path``.

    Raises
    ------
    MeshFileError
        When the format is not supported.
    OutputError
        When it cannot be written.
    """
    _suffix(path, "written")
    check_writable(path)


def _suffix(path: str | os.PathLike[str], done: str) -> str:
    suffix = Path(path).suffix.lower()
    known = READERS if done == "read" else MAP_WRITERS
    if suffix not in known:
        what = f"{suffix} files cannot be {done}" if suffix else "has no suffix, so its format is unknown"
        raise MeshFileError(path, what, remedy=f"supported: {', '.join(known)}")
    return suffix
