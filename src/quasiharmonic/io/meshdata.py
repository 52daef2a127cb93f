"""What a mesh file holds, and the map in it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.arrays import FloatArray, IntArray, named
from quasiharmonic.io.errors import MeshFileError


@dataclass(frozen=True, eq=False)
class MeshData:
    """A triangle mesh as a file has it, with all that is needed to write the file again.

    Only ``V`` and ``F`` are needed to make one. Vertices and faces keep the order of the file.

    Attributes
    ----------
    V : (n, 3) float64
        Positions; an (n, 2) array gets a third coordinate of zero.
    F : (f, 3) int64
        Triangles, 0-based.
    vt : (m, 2) float64 or None
        Texture coordinates.
    FT : (f, 3) int64 or None
        For every corner its row of ``vt``; -1 where the corner has none.
    extra : (n, k) float64 or None
        What stood behind the three coordinates of a vertex (weight, colour); NaN where nothing did.
    normals : bytes
        The ``vn`` lines as they stood. They are never looked into, only written back.
    FN : (f, 3) int64 or None
        For every corner its line of ``normals``; -1 where the corner has none.
    statements : bytes
        Lines that are neither vertex nor face (groups, materials, comments), each as it stood.
    statement_faces : (s,) int64
        For each line of ``statements``, how many faces come before it; -1 before the first vertex.
    source : str
        The file it came from, for messages.
    """

    V: FloatArray
    F: IntArray
    vt: FloatArray | None = None
    FT: IntArray | None = None
    extra: FloatArray | None = None
    normals: bytes = b""
    FN: IntArray | None = None
    statements: bytes = b""
    statement_faces: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    source: str = "mesh"

    def __post_init__(self) -> None:
        """Bring the arrays into the types and shapes above; `ValueError` for what cannot be."""
        V = np.asarray(self.V, dtype=np.float64)
        if V.ndim != 2 or V.shape[1] not in (2, 3):
            raise ValueError(f"V has the shape {V.shape}; (n, 3) is needed")
        if V.shape[1] == 2:
            V = np.column_stack([V, np.zeros(len(V))])
        _check_finite("V", V)
        object.__setattr__(self, "V", V)
        object.__setattr__(self, "F", _indices("F", self.F, None, len(V)))
        faces = len(self.F)
        if self.vt is not None:
            vt = np.asarray(self.vt, dtype=np.float64)
            if vt.ndim != 2 or vt.shape[1] != 2:
                raise ValueError(f"vt has the shape {vt.shape}; (m, 2) is needed")
            _check_finite("vt", vt)
            object.__setattr__(self, "vt", vt)
        if self.FT is not None:
            places = 0 if self.vt is None else len(self.vt)
            object.__setattr__(self, "FT", _indices("FT", self.FT, faces, places, least=-1))
        if self.FN is not None:
            count = self.normals.count(b"\n")
            object.__setattr__(self, "FN", _indices("FN", self.FN, faces, count, least=-1))

    def with_map(self, uv: ArrayLike) -> MeshData:
        """Return the same mesh with one texture coordinate for each vertex.

        Parameters
        ----------
        uv : (n, 2) float
            Place of every vertex in the plane.

        Returns
        -------
        MeshData

        Raises
        ------
        ValueError
            When the shape is another, or a place is not finite.
        """
        return replace(self, vt=self._one_each(uv), FT=self.F)

    def as_plane(self, uv: ArrayLike) -> MeshData:
        """Return the map alone: a mesh in the plane z = 0 with the same faces.

        Parameters
        ----------
        uv : (n, 2) float
            Place of every vertex in the plane.

        Returns
        -------
        MeshData
            Positions and faces, and nothing else of this one.

        Raises
        ------
        ValueError
            When the shape is another, or a place is not finite.
        """
        return MeshData(self._one_each(uv), self.F, source=self.source)

    def _one_each(self, uv: ArrayLike) -> FloatArray:
        uv = np.asarray(uv, dtype=np.float64)
        if uv.shape != (len(self.V), 2):
            raise ValueError(f"uv has the shape {uv.shape}; {(len(self.V), 2)} is needed")
        _check_finite("uv", uv)
        return uv


def vertex_places(mesh: MeshData) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Gather the texture coordinates of every vertex.

    Parameters
    ----------
    mesh : MeshData

    Returns
    -------
    uv : (n, 2) float64
        Place of each vertex, NaN where no face gives it one; one of its places at a seam.
    seam : (n,) bool
        Whether the vertex has more than one place. Equal numbers under different indices are one.
    """
    uv = np.full((len(mesh.V), 2), np.nan)
    seam = np.zeros(len(mesh.V), dtype=np.bool_)
    if mesh.vt is not None and mesh.FT is not None:
        given = mesh.FT >= 0
        vertex, place = mesh.F[given], mesh.vt[mesh.FT[given]]
        uv[vertex] = place
        seam[vertex[(uv[vertex] != place).any(axis=1)]] = True
    return uv, seam


def map_of(mesh: MeshData) -> FloatArray:
    """Return the map that a mesh carries: a place in the plane for every vertex.

    It is read from the texture coordinates; in a planar mesh without any, the positions are it.

    Parameters
    ----------
    mesh : MeshData
        A mesh whose vertices have one place each.

    Returns
    -------
    (n, 2) float64
        The map; NaN at vertices that no face uses.

    Raises
    ------
    MeshFileError
        When the mesh has no map, has it on some faces only, or has seams, that is, vertices with
        several places; the message names the first of them.
    """
    check_mapped(mesh)
    if mesh.FT is None:
        return mesh.V[:, :2].copy()
    uv, seam = vertex_places(mesh)
    if seam.any():
        torn = named("vertex", "vertices", np.flatnonzero(seam))
        raise MeshFileError(
            mesh.source,
            f"more than one place in the plane for {torn} (0-based)",
            remedy="a map with seams needs its vertices split along them",
        )
    return uv


def is_planar(points: FloatArray) -> bool:
    """Whether points (n, 3) lie in a plane z = constant, up to what rounding to single precision leaves."""
    # In units of their size, a power of two: a difference of the largest doubles is none.
    exponent = int(np.frexp(np.abs(points).max())[1])
    extent = np.ptp(np.ldexp(points, -exponent - 1), axis=0)
    return bool(extent[2] <= 1e-6 * extent[:2].max())


def check_mapped(mesh: MeshData) -> None:
    """Raise `MeshFileError` when a mesh has no map, or has it on some faces only."""
    if mesh.FT is None:
        if not is_planar(mesh.V):
            raise MeshFileError(
                mesh.source,
                "there is no map: the mesh has no texture coordinates and is not planar",
                remedy="write it with uv coordinates",
            )
        return
    bare = np.flatnonzero((mesh.FT < 0).any(axis=1))
    if bare.size:
        raise MeshFileError(
            mesh.source,
            f"{named('face', 'faces', bare)} (0-based) without texture coordinates, which others have",
            remedy="map the whole mesh, or remove these faces",
        )


def _check_finite(name: str, rows: FloatArray) -> None:
    lost = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if lost.size:
        raise ValueError(f"{name} is not finite at {named('row', 'rows', lost)}")


def _indices(name: str, values: ArrayLike, rows: int | None, count: int, least: int = 0) -> IntArray:
    """Check an (f, 3) array of indices ``least … count - 1`` and return it as int64."""
    table = np.asarray(values)
    if table.ndim != 2 or table.shape[1] != 3 or (rows is not None and len(table) != rows):
        raise ValueError(f"{name} has the shape {table.shape}; ({rows or 'f'}, 3) is needed")
    if table.size and not np.issubdtype(table.dtype, np.integer):
        raise ValueError(f"{name} has the type {table.dtype}; integers are needed")
    if table.size and (table.min() < least or table.max() >= count):
        wrong = table[(table < least) | (table >= count)][0]
        raise ValueError(f"{name} has the index {wrong}; only {count} are there to refer to")
    return table.astype(np.int64, copy=False)
