"""Read and write mesh files; the suffix of the file name selects the format."""

from __future__ import annotations

import os
from importlib.util import find_spec

from quasiharmonic.io.lowlevel.atomic import check_writable
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.registry import find_format, find_function
from quasiharmonic.util.optional import with_extra


def read_mesh(path: str | os.PathLike[str]) -> MeshData:
    """Read a triangle mesh from a file; its name selects the format.

    Formats are OBJ, OFF, PLY, GLB, glTF, STL, GIFTI (``.gii``, ``.gii.gz``), and FreeSurfer's surfaces (``lh.…``,
    ``rh.…``, ``.surf``) and patches (``….patch.3d``, ``….patch.flat``). See `read_obj`, `read_off`, `read_ply`,
    `read_gltf`, `read_stl`, `read_gifti`, `read_freesurfer` and `read_patch`.

    Raises
    ------
    MeshFileError
        If the format is not supported, or the file is not valid in its format.
    """
    return find_function(path, "read")(path)


def write_mapped(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write a mesh with its map; the suffix of the file name selects the format.

    OBJ, PLY and glTF files contain the mesh as it was read, with the map as its texture coordinates. OFF, GIFTI and
    FreeSurfer files contain the map alone, as a mesh in the plane z = 0. Numbers are written so that reading them
    returns the same doubles, except in glTF, GIFTI and FreeSurfer files, which have single precision. An error never
    leaves a partial file. `not_held` lists the data that the file will not contain.

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
    if mesh.lower_maps:
        find_format(path, "write_map", "channels")
    find_function(path, "write_map")(path, mesh)


def check_output(path: str | os.PathLike[str]) -> None:
    """Check before a computation whether `write_mapped` could write to ``path``.

    Raises
    ------
    MeshFileError
        If the format is not supported.
    OutputError
        If the file cannot be written.
    ImportError
        If the format needs a package that is not installed.
    """
    form = find_format(path, "write_map")
    if form.requires is not None and find_spec(form.requires) is None:
        raise ImportError(f"{form.name} files need {form.requires}: pip install {with_extra('neuro')}")
    check_writable(path)


def read_written(path: str | os.PathLike[str], mesh: MeshData) -> MeshData:
    """Read a file that `write_mapped` wrote of ``mesh``.

    As `read_mesh`, except for a FreeSurfer patch without a surface beside it, which has the mesh's triangles. The
    map is in the channel of the mesh's map.
    """
    from quasiharmonic.io.channels import select_channel

    read = find_format(path, "read").read_written
    found = read_mesh(path) if read is None else read(path, mesh)
    return select_channel(found, len(mesh.lower_maps)) if mesh.lower_maps else found


def not_held(path: str | os.PathLike[str], mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that `write_mapped` would not write; empty if nothing is lost.

    Raises
    ------
    MeshFileError
        If the format is not supported.
    """
    list_losses = find_format(path, "write_map").list_losses
    assert list_losses is not None
    return list_losses(mesh)
