"""The contents of a mesh file, also after some of its edges were split.

Normals are OBJ lines, and colours are numbers after the coordinates, whatever the format of the file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.polygons import Polygons, triangulate_polygons
from quasiharmonic.io.models.textures import Texture
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_finite,
    check_range,
    corner_rows,
    map_array,
    pad_to_space,
    real_array,
    repeat_each,
    triangle_rows,
    vertex_array,
)

if TYPE_CHECKING:
    from quasiharmonic.geometry.mesh.splitting import Refined

# The sign of a number other than zero, which may be missing, in a line of numbers.
_NONZERO_SIGN = re.compile(rb"(?<=[ \t])[-+]?(?=0*\.?0*[1-9])")


@dataclass(frozen=True, eq=False)
class Carried:
    """The contents of a file besides its mesh ``V, F``, for a writer of the same format."""

    V: FloatArray
    F: IntArray

    def further(self) -> list[str]:
        """Return descriptions of the data besides the mesh, which only a writer of the same format keeps."""
        return []

    def unread_looks(self) -> list[str]:
        """Return descriptions of those data that change how the mesh looks and are not read."""
        return []

    def number_meshes(self) -> IntArray | None:
        """Return the number of the mesh (n,) of each vertex; None if the file has one mesh."""
        return None

    def turn_over(self) -> Carried:
        """Return the contents for the mesh with all faces reversed; by default they do not fit it, and get lost."""
        return self

    def fits(self, mesh: MeshData) -> bool:
        """Return whether a mesh is still the mesh of the file, whatever its map."""
        return np.array_equal(self.V, mesh.V) and np.array_equal(self.F, mesh.F)


@dataclass(frozen=True, eq=False)
class OriginalLines:
    """Lines of a file and their numbers (n, k); lines whose numbers did not change are written back as they were."""

    text: bytes
    rows: FloatArray

    def find_unchanged(self, rows: FloatArray) -> NDArray[np.bool_]:
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
        if self.extra is not None:
            object.__setattr__(self, "extra", real_array("extra", self.extra))
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

    def turn_over(self) -> MeshData:
        """Return the same mesh with all faces and normals reversed; only glTF files keep their other data."""
        turn = [0, 2, 1]
        return replace(
            self,
            F=self.F[:, turn],
            FT=None if self.FT is None else self.FT[:, turn],
            normals=_NONZERO_SIGN.sub(lambda sign: b"" if sign.group() == b"-" else b"-", self.normals),
            FN=None if self.FN is None else self.FN[:, turn],
            polygons=None if self.polygons is None else self.polygons.turn_over(),
            lower_maps=tuple(places[:, turn] for places in self.lower_maps),
            carried=None if self.carried is None else self.carried.turn_over(),
        )

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


def refined_mesh(mesh: MeshData, refined: Refined, uv: FloatArray) -> tuple[MeshData, IntArray]:
    """Transfer all data of a mesh file to a refinement of the mesh.

    The given vertices keep their indices, and new vertices follow. The parts of a triangle replace it in order, so they
    stay in its group and keep its material. Colours of new vertices are interpolated. Triangles that were split lose
    their normals. A polygon is replaced by triangles if one of its triangles was split.

    Parameters
    ----------
    mesh : MeshData
        The given mesh.
    refined : Refined
        Its refinement.
    uv : (n, 2) float64
        Positions of the given vertices in the plane.

    Returns
    -------
    mesh : MeshData
        The refined mesh, with the same map.
    parent : (f,) int64
        The given triangle that contains each new triangle, ascending.
    """
    order = np.argsort(refined.parent, kind="stable")
    parent, F = refined.parent[order], refined.F[order]
    normals = None
    if mesh.FN is not None:
        unsplit = np.bincount(parent, minlength=len(mesh.F))[parent] == 1
        normals = np.where(unsplit[:, None], mesh.FN[parent], -1)
    before = mesh.statement_faces
    polygons, first = _refine_polygons(mesh, parent)
    new = replace(
        mesh,
        V=refined.V,
        F=F,
        vt=refined.extend(uv),
        FT=F,
        extra=None if mesh.extra is None else refined.extend(mesh.extra),
        FN=normals,
        polygons=polygons,
        statement_faces=np.where(before < 0, before, first[before]),
    )
    return new, parent


def _refine_polygons(mesh: MeshData, parent: IntArray) -> tuple[Polygons | None, IntArray]:
    """Return the file's faces after some of its triangles were split, None if all are triangles.

    ``parent`` (f,) is the given triangle that contains each new triangle, ascending. The second result is the first new
    face of each given face, then the number of new faces.
    """
    old = mesh.rings
    face = old.of_triangle[parent]
    count = np.bincount(face, minlength=len(old))
    unsplit = count == old.sizes - 2
    first = np.concatenate([[0], np.cumsum(np.where(unsplit, 1, count))])
    # Unsplit faces keep their rings, with the new indices of their triangles. Each triangle of a split face is a ring.
    unsplit_corners = repeat_each(unsplit, old.sizes)
    triangle, corner = np.divmod(old.corners[unsplit_corners], 3)
    rings = 3 * np.searchsorted(parent, triangle) + corner
    place = first[repeat_each(np.arange(len(old)), old.sizes)[unsplit_corners]]
    split = np.flatnonzero(~unsplit[face])
    among = split - np.searchsorted(face, face[split])
    corners = np.concatenate([rings, (3 * split[:, None] + np.arange(3)).ravel()])
    places = np.concatenate([place, np.repeat(first[face[split]] + among, 3)])
    starts = np.concatenate([[0], np.cumsum(np.bincount(places, minlength=first[-1]))])
    polygons = Polygons(corners[np.argsort(places, kind="stable")], starts)
    return (None if (polygons.sizes == 3).all() else polygons), first


def normal_lines(normals: FloatArray) -> bytes:
    """Return normals (k, 3) as lines of an OBJ file."""
    return ("vn %r %r %r\n" * len(normals) % tuple(normals.ravel().tolist())).encode()


def normals_of(mesh: MeshData) -> FloatArray | None:
    """Return all normals (k, 3) of a mesh; None if a corner has none, or a line has anything but three numbers."""
    if mesh.FN is None or (mesh.FN < 0).any():
        return None
    try:
        rows = [[float(word) for word in line.split(b"#")[0].split()[1:]] for line in mesh.normals.splitlines()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 3)
    except ValueError:
        return None


def colours_of(mesh: MeshData) -> FloatArray | None:
    """Return colours of vertices from 0 to 1, with or without opacity; None unless all vertices have one."""
    extra = mesh.extra
    if extra is None or extra.shape[1] not in (3, 4) or not ((extra >= 0) & (extra <= 1)).all():
        return None
    return extra
