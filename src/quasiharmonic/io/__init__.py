"""Read and write meshes, maps and problems in files.

The package builds on `geometry.mesh`. Each format is a module of `formats` or of `fem`; `adapters` accepts mesh objects
of other libraries. Start reading in `meshdata`, whose `MeshData` every reader returns.
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
#: Readers of meshes and writers of mapped meshes by lower-case suffix. Add a new format to both, unless it cannot store
#: a map.
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
    # OFF stores one set of coordinates only, and so no seams.
    ".off": lambda path, mesh: write_off(path, in_plane(mesh)),
    ".ply": write_ply,
    ".glb": write_gltf,
    ".gltf": write_gltf,
}


def read_mesh(path: str | os.PathLike[str]) -> MeshData:
    """Read a triangle mesh; the suffix of the file name selects the format.

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
        If the format is not supported, or the file is not valid in its format.
    """
    return READERS[_suffix(path, "read")](path)


def write_map(path: str | os.PathLike[str], mesh: MeshData, uv: ArrayLike) -> None:
    """Write a mesh with one position per vertex as its map; see `write_mapped`.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    mesh : MeshData
        The mesh, as `read_mesh` returned it.
    uv : (n, 2) float
        Position of every vertex in the plane.

    Raises
    ------
    MeshFileError, OutputError
        As `write_mapped`.
    ValueError
        If ``uv`` has another shape or is not finite.
    """
    write_mapped(path, mesh.with_map(uv))


def write_mapped(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write a mesh with its map; the suffix of the file name selects the format.

    OBJ, PLY and glTF files contain the mesh as it was read, with the map as its texture coordinates. OFF files contain
    the map alone, as a mesh in the plane z = 0. Numbers are written so that reading them returns the same doubles,
    except in glTF, which has single precision. An error never leaves a partial file. `not_held` lists the data that the
    file will not contain.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    mesh : MeshData
        The mesh, as `read_mesh` returned it, with a map (`MeshData.with_map`, `MeshData.with_places`).

    Raises
    ------
    MeshFileError
        If the format is not supported, or cannot store the seams of the map.
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    """
    MAP_WRITERS[_suffix(path, "written")](path, mesh)


def check_output(path: str | os.PathLike[str]) -> None:
    """Check before a computation whether `write_map` could write to ``path``.

    Raises
    ------
    MeshFileError
        If the format is not supported.
    OutputError
        If the file cannot be written.
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
