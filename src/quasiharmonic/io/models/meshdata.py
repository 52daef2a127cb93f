"""The contents of a mesh file, and the map in it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.polygons import Polygons, triangulate_polygons
from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.models.textures import Texture
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_finite,
    check_range,
    corner_rows,
    find_exponent,
    map_array,
    mark,
    names_of,
    pad_to_space,
    triangle_rows,
    vertex_array,
)


@dataclass(frozen=True, eq=False)
class Carried:
    """The contents of a file besides its mesh ``V, F``, for a writer of the same format."""

    V: FloatArray
    F: IntArray

    def further(self) -> list[str]:
        """Return descriptions of the data besides the mesh, which only a writer of the same format keeps."""
        return []

    def number_meshes(self) -> IntArray | None:
        """Return the number of the mesh (n,) of each vertex; None if the file has one mesh."""
        return None

    def fits(self, mesh: MeshData) -> bool:
        """Return whether a mesh is still the mesh of the file, whatever its map."""
        return np.array_equal(self.V, mesh.V) and np.array_equal(self.F, mesh.F)


@dataclass(frozen=True, eq=False)
class OriginalLines:
    """Lines of a file and their numbers (n, k); lines whose numbers did not change are written back as they were."""

    text: bytes
    rows: FloatArray

    def unchanged(self, rows: FloatArray) -> NDArray[np.bool_]:
        """Return which rows equal the numbers of the line with the same index; (m,) bool."""
        same = np.zeros(len(rows), dtype=np.bool_)
        if rows.shape[1:] == self.rows.shape[1:]:
            both = min(len(rows), len(self.rows))
            one, other = rows[:both], self.rows[:both]
            same[:both] = ((one == other) | (np.isnan(one) & np.isnan(other))).all(axis=1)
        return same


@dataclass(frozen=True, eq=False)
class MeshData:
    """A mesh from a file, with all data needed to write the file again.

    Only ``V`` and ``F`` are required. Vertices and faces keep the order of the file. A face of more than three corners
    is stored as its triangles (see `polygon_mesh`) and written as the original polygon.

    Attributes
    ----------
    V : (n, 3) float64
        Positions; an (n, 2) array gets a third coordinate of zero.
    F : (f, 3) int64
        Triangles, 0-based.
    vt : (m, 2) float64 or None
        Texture coordinates.
    FT : (f, 3) int64 or None
        For every corner its row of ``vt``; -1 if the corner has no texture coordinate.
    extra : (n, k) float64 or None
        Further numbers after the three coordinates of a vertex (weight, colour); NaN where the file has none.
    lines, map_lines : OriginalLines or None
        Original lines of the first vertices, and of the first texture coordinates.
    newline : bytes
        Line ending of the file.
    normals : bytes
        The ``vn`` lines, unparsed. They are only written back.
    FN : (f, 3) int64 or None
        For every corner its line of ``normals``; -1 if the corner has no normal.
    statements : bytes
        Lines that are neither vertex nor face (groups, materials, comments), unchanged.
    statement_faces : (s,) int64
        For each line of ``statements``, the number of the file's faces before it; -1 before the first vertex.
    polygons : Polygons or None
        The file's faces as rings of corners of the triangles; None if all faces are triangles.
    source : str
        The file that was read, for messages.
    carried : Carried or None
        All other data of the file, for a writer of the same format; None if there is no other data.
    texture : Texture or None
        An image to write with the map, in formats that support textures.
    lower_maps : tuple of (f, 3, 2) float64
        Texture coordinates of the corners in the channels below that of the map, which is number ``len(lower_maps)``:
        ``TEXCOORD_0``, ``TEXCOORD_1``, … of glTF.
    """

    V: FloatArray
    F: IntArray
    vt: FloatArray | None = None
    FT: IntArray | None = None
    extra: FloatArray | None = None
    lines: OriginalLines | None = None
    map_lines: OriginalLines | None = None
    newline: bytes = b"\n"
    normals: bytes = b""
    FN: IntArray | None = None
    statements: bytes = b""
    statement_faces: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    polygons: Polygons | None = None
    source: str = "mesh"
    carried: Carried | None = None
    texture: Texture | None = None
    lower_maps: tuple[FloatArray, ...] = ()

    def __post_init__(self) -> None:
        """Convert the arrays to the types and shapes above; raise `ValueError` for invalid ones."""
        V = pad_to_space(vertex_array(self.V))
        object.__setattr__(self, "V", V)
        F = triangle_rows(self.F, copy=False)
        check_range("F", F, len(V))
        object.__setattr__(self, "F", F)
        if self.vt is not None:
            vt = map_array("vt", self.vt, finite=False)
            check_finite("vt", "row", "rows", vt)
            object.__setattr__(self, "vt", vt)
        if self.FT is not None:
            object.__setattr__(self, "FT", corner_rows("FT", self.FT, F, 0 if self.vt is None else len(self.vt)))
        if self.FN is not None:
            object.__setattr__(self, "FN", corner_rows("FN", self.FN, F, self.normals.count(b"\n")))

    @property
    def faces(self) -> int:
        """Number of faces in the file."""
        return len(self.F) if self.polygons is None else len(self.polygons)

    @property
    def rings(self) -> Polygons:
        """The file's faces as rings of corners of the triangles, also if all are triangles."""
        if self.polygons is not None:
            return self.polygons
        return Polygons(np.arange(self.F.size), 3 * np.arange(len(self.F) + 1))

    @property
    def corner_uv(self) -> FloatArray:
        """Texture coordinates at every corner, (f, 3, 2) float64; NaN where there are none."""
        if self.vt is None or self.FT is None:
            return np.full((*self.F.shape, 2), np.nan)
        return np.where(self.FT[:, :, None] >= 0, self.vt[self.FT], np.nan)

    def with_map(self, uv: ArrayLike) -> MeshData:
        """Return the same mesh with one texture coordinate for each vertex.

        Raises
        ------
        ValueError
            If ``uv`` does not have shape (n, 2), or a position is not finite.
        """
        return replace(self, vt=map_array("uv", uv, len(self.V)), FT=self.F)

    def with_places(self, mapped: SeamedMesh) -> MeshData:
        """Return the same mesh with the texture coordinates of a `SeamedMesh` that has the same triangles."""
        return replace(self, vt=mapped.uv, FT=mapped.FT)

    def as_plane(self, uv: ArrayLike) -> MeshData:
        """Return a map alone, as a mesh in the plane z = 0 with the same faces and no other data.

        Raises
        ------
        ValueError
            If ``uv`` does not have shape (n, 2), or a position is not finite.
        """
        return MeshData(map_array("uv", uv, len(self.V)), self.F, polygons=self.polygons, source=self.source)


def polygon_mesh(
    V: FloatArray,
    corners: IntArray,
    starts: IntArray,
    *,
    places: IntArray | None = None,
    normal_lines: IntArray | None = None,
    **rest: Any,
) -> MeshData:
    """Return a mesh with faces of any number of corners; its ``polygons`` are None if all faces are triangles.

    ``corners`` (c,) are the vertices of the faces, ring after ring. Ring i starts at ``starts[i]``; the last entry of
    ``starts`` is c. ``places`` and ``normal_lines`` (c,) are each corner's row of ``vt`` and line of ``normals``, -1
    for none. Further arguments are those of `MeshData`. ValueError if a face has fewer than three corners or a repeated
    vertex, or a vertex index is out of range.
    """
    check_range("the faces", corners, len(V))
    if (np.diff(starts) == 3).all():
        T, polygons = np.arange(len(corners)).reshape(-1, 3), None
    else:
        T, polygons = triangulate_polygons(V, corners, starts)
    return MeshData(
        V,
        corners[T],
        FT=None if places is None else places[T],
        FN=None if normal_lines is None else normal_lines[T],
        polygons=polygons,
        **rest,
    )


def with_corner_map(mesh: MeshData, corners: FloatArray) -> MeshData:
    """Return a mesh with texture coordinates (f, 3, 2) of its corners, NaN for none; equal ones of a vertex are one."""
    known = ~np.isnan(corners[:, :, 0])
    rows = np.column_stack([mesh.F[known], corners[known] + 0.0])
    unique, which = np.unique(rows, axis=0, return_inverse=True)
    FT = np.full(mesh.F.shape, -1)
    FT[known] = which.reshape(-1)
    return replace(mesh, vt=unique[:, 1:], FT=FT, map_lines=None, lower_maps=())


def vertex_places(mesh: MeshData) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the texture coordinates of every vertex, and which vertices are on a seam.

    Returns
    -------
    uv : (n, 2) float64
        Texture coordinates of each vertex; NaN if no face gives it any. At a seam, one of its texture coordinates.
    seam : (n,) bool
        Whether the vertex has more than one texture coordinate. Equal numbers under different indices count as one.
    """
    uv = np.full((len(mesh.V), 2), np.nan)
    seam = np.zeros(len(mesh.V), dtype=np.bool_)
    if mesh.vt is not None and mesh.FT is not None and np.array_equal(mesh.FT, mesh.F):
        uv[mesh.F] = mesh.vt[mesh.F]
        return uv, seam
    places = mesh.corner_uv
    given = ~np.isnan(places[:, :, 0])
    vertex, place = mesh.F[given], places[given]
    uv[vertex] = place
    seam[vertex[(uv[vertex] != place).any(axis=1)]] = True
    return uv, seam


def map_of(mesh: MeshData) -> FloatArray:
    """Return the map of a mesh: a position in the plane for every vertex.

    The map is the texture coordinates. For a planar mesh without texture coordinates, it is the vertex positions.

    Parameters
    ----------
    mesh : MeshData
        A mesh whose map has no seams.

    Returns
    -------
    (n, 2) float64
        The map; NaN at vertices that no face uses.

    Raises
    ------
    MeshFileError
        If the mesh has no map, has it on some faces only, or has seams, that is, vertices with several positions. The
        message names the first such elements.
    """
    check_mapped(mesh)
    if mesh.FT is None:
        return mesh.V[:, :2].copy()
    uv, seam = vertex_places(mesh)
    if seam.any():
        torn = names_of("vertex", "vertices", np.flatnonzero(seam))
        raise MeshFileError(
            mesh.source,
            f"more than one pair of texture coordinates for {torn} (0-based)",
            remedy="split the vertices along the seams of the map",
        )
    return uv


def in_plane(mesh: MeshData) -> MeshData:
    """Return the map of a mesh as a mesh in the plane z = 0; errors as `map_of`.

    A vertex that no face uses gets the row of ``vt`` with its own index if ``vt`` has one row per vertex, and zero
    otherwise.
    """
    uv = map_of(mesh)
    idle = np.isnan(uv).any(axis=1)
    uv[idle] = mesh.vt[idle] if mesh.vt is not None and len(mesh.vt) == len(uv) else 0.0
    return mesh.as_plane(uv)


def is_planar(points: FloatArray) -> bool:
    """Return whether points (n, 3) lie in a plane z = constant, up to rounding to single precision."""
    # Scaling by a power of two avoids overflow in differences of the largest doubles.
    exponent = find_exponent(points)
    extent = np.ptp(np.ldexp(points, -exponent - 1), axis=0)
    return bool(extent[2] <= 1e-6 * extent[:2].max())


def has_map(mesh: MeshData) -> bool:
    """Return whether a mesh has texture coordinates on some faces, or is planar."""
    return mesh.FT is not None or _is_flat(mesh)


def _is_flat(mesh: MeshData) -> bool:
    """Return whether the vertices that triangles use lie in a plane z = constant."""
    used = mark(len(mesh.V), mesh.F)
    return is_planar(mesh.V) or (not used.all() and bool(used.any()) and is_planar(mesh.V[used]))


def check_mapped(mesh: MeshData) -> None:
    """Raise `MeshFileError` if a mesh has no map, or has it on some faces only."""
    if mesh.FT is None:
        if not _is_flat(mesh):
            raise MeshFileError(
                mesh.source,
                "has no map: the mesh has no texture coordinates and is not planar",
                remedy="export it with uv coordinates",
            )
        return
    bare = np.flatnonzero((mesh.FT < 0).any(axis=1))
    if bare.size:
        raise MeshFileError(
            mesh.source,
            f"{names_of('face', 'faces', bare)} (0-based) without texture coordinates, which other faces have",
            remedy="map the whole mesh, or remove these faces",
        )
