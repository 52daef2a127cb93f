"""Read and write mesh files; the suffix of the file name selects the format.

A file can have several texture coordinates: `select_channel` reads a channel, and `place_map` writes one.

A problem is a mesh with an initial map, and a list of fixed vertices. Its format is that of the Locally Injective
Mappings Benchmark (Du et al. 2020): a folder with ``input.obj`` and ``handles.txt``. The texture coordinates of
``input.obj`` are the target positions, and ``handles.txt`` lists the fixed vertices.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.atomic import check_writable
from quasiharmonic.io.errors import MeshFileError, check_path, report_damage
from quasiharmonic.io.formats.gltf.reader import CarriedGltf, read_channel, read_gltf
from quasiharmonic.io.formats.ply import CarriedPly, read_second_places
from quasiharmonic.io.models.mesh_maps import vertex_places, with_corner_map
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.registry import find_format, find_function
from quasiharmonic.io.untrusted import content_lines, integer, read_text
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_integer,
    check_range,
    index_array,
    triangle_names,
    vertex_names,
)
from quasiharmonic.util.hints import with_extra


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


def separates_instances(path: str | os.PathLike[str], options: Mapping[str, Any]) -> bool:
    """Return whether options of `unwrap` require that each occurrence of a mesh in a file becomes a mesh of its own."""
    separate = options.get("instances") == "own" or bool(options.get("lightmap"))
    return separate and Path(path).suffix.lower() in (".glb", ".gltf")


def read_model(path: str | os.PathLike[str], options: Mapping[str, Any]) -> MeshData:
    """Read a model for `unwrap` with these options."""
    return read_gltf(path, instances="own") if separates_instances(path, options) else read_mesh(path)


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
    """Read the file that `write_mapped` has written for ``mesh``.

    The result is that of `read_mesh`, with the map of the channel that ``mesh`` has as its map. A FreeSurfer patch
    without a surface beside it gets the triangles of ``mesh``.
    """
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


def select_channel(mesh: MeshData, channel: int) -> MeshData:
    """Return a mesh that was read from a file with the texture coordinates of another channel as its map.

    Channel k is ``TEXCOORD_k`` in glTF files. In PLY files, channel 1 is ``texcoord1`` of the faces. Written to a file,
    the map is in this channel again.

    Raises
    ------
    MeshFileError
        If the file does not have this channel.
    """
    check_integer("channel", channel, minimum=0)
    return place_map(_find_channel(mesh, channel), mesh, channel)


def place_map(mapped: MeshData, mesh: MeshData, channel: int) -> MeshData:
    """Return ``mapped`` with its map in a channel of texture coordinates; the channels below are those of ``mesh``.

    Both meshes have the same triangles. Triangles without coordinates in a channel below get those of the map.

    Raises
    ------
    MeshFileError
        If such a triangle has no coordinates in the map either, or ``mesh`` lacks a channel below.
    """
    below = tuple(_find_channel(mesh, k).corner_uv.copy() for k in range(channel))
    for k, corners in enumerate(below):
        bare = np.flatnonzero(np.isnan(corners).any(axis=(1, 2)))
        corners[bare] = mapped.corner_uv[bare]
        bare = bare[np.isnan(corners[bare]).any(axis=(1, 2))]
        if bare.size:
            raise MeshFileError(
                mesh.source,
                f"has no texture coordinates {k} in {triangle_names(bare)} (0-based), but channel "
                f"{channel} requires those below it",
                remedy=f"write channel {k} first",
            )
    return replace(mapped, lower_maps=below)


def _find_channel(mesh: MeshData, channel: int) -> MeshData:
    """Return the mesh with a channel as its map."""
    if channel == len(mesh.lower_maps):
        return mesh
    carried, corners = mesh.carried, None
    if channel < len(mesh.lower_maps):
        corners = mesh.lower_maps[channel]
    elif isinstance(carried, CarriedGltf):
        corners = read_channel(carried, channel)
    elif isinstance(carried, CarriedPly) and channel == 1:
        corners = read_second_places(mesh, carried)
    if corners is None:
        raise MeshFileError(
            mesh.source,
            f"has no texture coordinates {channel}",
            remedy=f"give a channel of the file (the first is 0), or write channel {channel} first",
        )
    return with_corner_map(mesh, corners)


#: Names of the mesh in the folder of a problem, the first that exists counts.
INPUTS = "input.obj", "input.ply"


class ProblemArrays(NamedTuple):
    """The arrays of a `quasiharmonic.Problem`.

    Attributes
    ----------
    V : (n, 3) float64
        Rest positions.
    F : (f, 3) int64
        Triangles.
    fixed : (k,) int64
        Fixed vertices.
    target : (k, 2) float64
        Target positions of the fixed vertices.
    """

    V: FloatArray
    F: IntArray
    fixed: IntArray
    target: FloatArray


def read_problem(source: str | os.PathLike[str], fixed: str | os.PathLike[str] | None = None) -> ProblemArrays:
    """Read a mapping problem.

    Parameters
    ----------
    source : str or path-like
        A folder with ``input.obj`` or ``input.ply`` and, optionally, ``handles.txt``; or a mesh file alone.
    fixed : str or path-like, optional
        A list of fixed vertices that replaces the folder's list. Without any list, the boundary is fixed.

    Returns
    -------
    ProblemArrays
        ``V, F, fixed, target``. The target positions are the texture coordinates of ``fixed``.

    Raises
    ------
    MeshFileError
        If a file cannot be read, or a fixed vertex has no target position.
    """
    mesh_path, fixed_path = problem_files(source, fixed)
    mesh = read_mesh(mesh_path)
    return problem_arrays(mesh, None if fixed_path is None else read_handles(fixed_path, len(mesh.V)))


def problem_files(
    source: str | os.PathLike[str], fixed: str | os.PathLike[str] | None = None
) -> tuple[Path, Path | None]:
    """Return the paths of a problem's mesh and, if there is one, of its list of fixed vertices.

    Parameters
    ----------
    source : path
        A mesh file, or a folder with ``input.obj`` or ``input.ply``, and optionally ``handles.txt``.
    fixed : path, optional
        A list of fixed vertices that replaces the folder's list.

    Returns
    -------
    mesh : Path
    fixed : Path or None
        The files may be missing; reading them then raises an error.
    """
    check_path("source", source)
    if fixed is not None:
        check_path("fixed", fixed)
    mesh_path = Path(source)
    if mesh_path.is_dir():
        folder, mesh_path = mesh_path, mesh_path / INPUTS[0]
        if not os.path.lexists(mesh_path) and os.path.lexists(folder / INPUTS[1]):
            mesh_path = folder / INPUTS[1]
        # lexists: a broken link counts as a list, so that reading it raises an error.
        if fixed is None and os.path.lexists(folder / "handles.txt"):
            fixed = folder / "handles.txt"
    return mesh_path, None if fixed is None else Path(fixed)


def problem_arrays(mesh: MeshData, fixed: IntArray | None = None) -> ProblemArrays:
    """Return the mapping problem of a mesh that has texture coordinates.

    Parameters
    ----------
    mesh : MeshData
        The mesh. It may have seams, except at fixed vertices.
    fixed : (k,) int64, optional
        Fixed vertices; the boundary by default.

    Returns
    -------
    ProblemArrays
        ``V, F, fixed, target``.

    Raises
    ------
    MeshFileError
        If there are no vertices to fix, or a fixed vertex has no or several target positions. The message names the
        first such vertices.
    """
    if mesh.FT is None:
        raise MeshFileError(
            mesh.source,
            "has no faces that refer to texture coordinates, so the fixed vertices have no target positions",
            remedy="export it with uv coordinates (in OBJ: vt lines and faces like 1/1 2/2 3/3)",
        )
    if fixed is None:
        fixed = np.unique(boundary_edges(mesh.F, len(mesh.V)))
        if not fixed.size:
            raise MeshFileError(mesh.source, "has no boundary to fix", remedy="cut it open, or give fixed vertices")
    else:
        fixed = index_array("fixed", fixed).ravel()
        check_range("fixed", fixed, len(mesh.V))
    uv, seam = vertex_places(mesh)
    for wrong, what, remedy in (
        (np.isnan(uv[fixed, 0]), "no texture coordinates", "give every fixed vertex a vt"),
        (seam[fixed], "more than one pair of texture coordinates", "cut the mesh along its seams first"),
    ):
        if wrong.any():
            which = vertex_names(fixed[wrong])
            raise MeshFileError(mesh.source, f"{what} for the fixed {which} (0-based)", remedy=remedy)
    return ProblemArrays(mesh.V, mesh.F, fixed, uv[fixed])


def read_handles(path: str | os.PathLike[str], n: int) -> IntArray:
    """Read a list of vertices: 0-based indices, one per line, with blank lines and ``#`` comments.

    Parameters
    ----------
    path : str or path-like
        The file.
    n : int
        Number of vertices of the mesh.

    Returns
    -------
    (k,) int64
        The vertices in the order of the file.

    Raises
    ------
    MeshFileError
        With the line, for a line that is not an integer, an index outside ``0 … n - 1``, or a repeated vertex. Also for
        an empty list.
    """
    # Each vertex is stored once, so the memory is bounded by the mesh size.
    seen: dict[int, int] = {}
    for line, text in content_lines(read_text(path)):
        with report_damage(path, line=line, remedy="give one vertex index per line"):
            vertex = integer(text)
        if not 0 <= vertex < n:
            raise MeshFileError(
                path, f"vertex {vertex} does not exist in a mesh of {n} vertices", line, "indices count from 0"
            )
        if vertex in seen:
            raise MeshFileError(path, f"vertex {vertex}, already named at line {seen[vertex]}, again", line)
        seen[vertex] = line
    if not seen:
        raise MeshFileError(path, "lists no vertices")
    return np.fromiter(seen, dtype=np.int64, count=len(seen))
