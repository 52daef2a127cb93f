"""Read problem files: a mesh with an initial map, and a list of fixed vertices.

The format is that of the Locally Injective Mappings Benchmark (Du et al. 2020): a folder with ``input.obj`` and
``handles.txt``. The texture coordinates of ``input.obj`` are the target positions, and ``handles.txt`` lists the fixed
vertices.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.errors import MeshFileError, check_path
from quasiharmonic.io.lowlevel.textual import content_lines, integer, read_text
from quasiharmonic.io.mesh_files import read_mesh
from quasiharmonic.io.models.mesh_maps import vertex_places
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.util.arrays import FloatArray, IntArray, check_range, index_array, names_of


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
        A folder with ``input.obj`` and, optionally, ``handles.txt``; or a mesh file alone.
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
        A mesh file, or a folder with ``input.obj`` and optionally ``handles.txt``.
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
        folder, mesh_path = mesh_path, mesh_path / "input.obj"
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
            which = names_of("vertex", "vertices", fixed[wrong])
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
        try:
            vertex = integer(text)
        except ValueError as error:
            raise MeshFileError(path, str(error), line, "give one vertex index per line") from None
        if not 0 <= vertex < n:
            raise MeshFileError(path, f"vertex {vertex} of a mesh with {n}", line, "indices count from 0")
        if vertex in seen:
            raise MeshFileError(path, f"vertex {vertex}, already named at line {seen[vertex]}, again", line)
        seen[vertex] = line
    if not seen:
        raise MeshFileError(path, "lists no vertices")
    return np.fromiter(seen, dtype=np.int64, count=len(seen))
