"""Read and write PLY, the polygon file format: double precision, polygons, seams, and all other data of a file."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.errors import report_damage
from quasiharmonic.io.formats.plytables import Column, Element, PlyTables, encode_tables, parse_tables
from quasiharmonic.io.models.mesh_maps import vertex_places, with_corner_map
from quasiharmonic.io.models.meshdata import Carried, MeshData, colours_of, normal_lines, normals_of, polygon_mesh
from quasiharmonic.io.untrusted import read_bytes
from quasiharmonic.util.arrays import FloatArray, IntArray, repeat_each

# Property names of texture coordinates, at vertices and at the corners of faces.
_PLACES = ("s", "t"), ("u", "v"), ("texture_u", "texture_v")
_CORNER_PLACES = "texcoord"
_SECOND_PLACES = "texcoord1"
_RINGS = "vertex_indices", "vertex_index"
_COLOUR = "red", "green", "blue", "alpha"
_NORMAL = "nx", "ny", "nz"
# Columns that are read, by element.
_READ = {
    "vertex": {"x", "y", "z", *_COLOUR, *_NORMAL, *chain(*_PLACES)},
    "face": {*_RINGS, _CORNER_PLACES},
}
# Other data that programs show: columns of colours, and images that a comment names.
_LOOK = re.compile("TextureFile |(red|green|blue|alpha|diffuse_.*|texnumber) of (vertex|face)$")


@dataclass(frozen=True, eq=False)
class CarriedPly(Carried):
    """The tables of a PLY file, and its mesh."""

    tables: PlyTables

    def further(self) -> list[str]:
        columns = [
            f"{column.name} of {element.name}"
            for element in self.tables.elements
            for column in element.columns
            if column.name not in _READ.get(element.name, ())
        ]
        remarks = [b" ".join(line.split()[1:]).decode("utf-8", "replace") for line in self.tables.remarks]
        return columns + [text for text in remarks if text.startswith("TextureFile ")]

    def unread_looks(self) -> list[str]:
        return [name for name in self.further() if _LOOK.match(name)]


def read_ply(path: str | os.PathLike[str]) -> MeshData:
    """Read a mesh of triangles and other polygons from a PLY file, text or binary.

    Texture coordinates are read from the faces' ``texcoord`` (a pair for each corner, so that seams are possible).
    Without it, they are read from the vertices' ``s`` and ``t``, ``u`` and ``v``, or ``texture_u`` and ``texture_v``.
    The faces' ``texcoord1`` is a second channel, see `select_channel`.

    Returns
    -------
    MeshData
        Vertices and faces in the order of the file. Its ``carried`` has all other data, for `write_ply`.

    Raises
    ------
    MeshFileError
        If the file is not PLY, is damaged, or has no faces.
    """
    data = read_bytes(path)
    # Converting a signalling NaN is invalid; it is reported later as not finite.
    with report_damage(path, remedy="" if data else "it is empty"), np.errstate(invalid="ignore"):
        return _mesh(parse_tables(data), os.fspath(path))


def write_ply(path: str | os.PathLike[str], mesh: MeshData, *, durable: bool = True) -> None:
    """Write a mesh as a binary PLY file, atomically.

    Positions and texture coordinates are doubles. Texture coordinates are the vertices' ``s`` and ``t``, or the faces'
    ``texcoord`` if there are seams or corners without texture coordinates. Those of a second channel are the faces'
    ``texcoord1``. A mesh that was read from a PLY file keeps
    all other data of that file, and its positions unchanged. Other meshes keep normals and colours that are unique per
    vertex. ``durable`` is as in `write_obj`.

    Raises
    ------
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    """
    carried = mesh.carried
    if isinstance(carried, CarriedPly) and carried.fits(mesh):
        tables = carried.tables
    else:
        tables = PlyTables((_vertices(mesh), _faces(mesh)))
    if not mesh.lower_maps:
        tables = _with_places(tables, mesh)
    elif len(mesh.lower_maps) == 1:
        tables = _with_places(tables, with_corner_map(mesh, mesh.lower_maps[0]))
        tables = _replace_columns(tables, "face", {_SECOND_PLACES}, [_corner_places(mesh, _SECOND_PLACES)])
    else:
        raise ValueError("PLY files have two texture coordinates at most: write .glb")
    write_whole(path, encode_tables(tables), durable=durable)


def not_in_ply(mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that a PLY file will not contain."""
    if isinstance(mesh.carried, CarriedPly) and mesh.carried.fits(mesh):
        return []
    lost = [] if mesh.carried is None else [*mesh.carried.further()]
    if mesh.statements.strip():
        lost.append("groups, material names and other statements")
    if mesh.extra is not None and _colours(mesh) is None:
        lost.append("data after the coordinates of some vertices, unless they are colours")
    if mesh.FN is not None and _normals(mesh) is None:
        lost.append("normals, because some vertices have several")
    return lost


def _mesh(tables: PlyTables, source: str) -> MeshData:
    vertex, face = tables.find("vertex"), tables.find("face")
    if vertex is None or not vertex.rows:
        raise ValueError("has no vertices")
    ring = None if face is None else face.find(*_RINGS)
    if face is None or not face.rows or ring is None or ring.sizes is None:
        raise ValueError("has no faces")
    V = _table(vertex, "x", "y", "z")
    if V is None:
        raise ValueError("its vertices lack x, y or z")
    corners = ring.values.astype(np.int64)
    starts = np.concatenate([[0], np.cumsum(ring.sizes)])
    vt, places = _read_places(vertex, face, corners, ring.sizes)
    normals = _table(vertex, *_NORMAL)
    mesh = polygon_mesh(
        V,
        corners,
        starts,
        places=places,
        vt=vt,
        extra=_read_colours(vertex),
        normals=b"" if normals is None else normal_lines(normals),
        normal_lines=None if normals is None else corners,
        source=source,
    )
    return replace(mesh, carried=CarriedPly(mesh.V, mesh.F, tables))


def _table(element: Element, *names: str) -> FloatArray | None:
    """Return columns of numbers side by side; None if one is missing."""
    found = [element.find(name) for name in names]
    columns = [column.values.astype(np.float64) for column in found if column is not None and column.sizes is None]
    return np.stack(columns, axis=1) if len(columns) == len(names) else None


def _read_colours(vertex: Element) -> FloatArray | None:
    """Return red, green, blue and optionally opacity of vertices, from 0 to 1."""
    found = [column for name in _COLOUR if (column := vertex.find(name)) is not None and column.sizes is None]
    if [column.name for column in found] not in (list(_COLOUR), list(_COLOUR[:3])):
        return None
    scales = [np.iinfo(c.values.dtype).max if c.values.dtype.kind in "iu" else 1 for c in found]
    return np.stack([c.values / one for c, one in zip(found, scales, strict=True)], axis=1)


def _read_places(
    vertex: Element, face: Element, corners: IntArray, sizes: IntArray
) -> tuple[FloatArray | None, IntArray | None]:
    """Return texture coordinates, and for every corner of every face its row of them or -1; None if there are none."""
    of_faces = face.find(_CORNER_PLACES)
    if of_faces is not None and of_faces.sizes is not None:
        odd = np.flatnonzero((of_faces.sizes != 2 * sizes) & (of_faces.sizes != 0))
        if odd.size:
            raise ValueError(
                f"face {odd[0]} (0-based) has {of_faces.sizes[odd[0]]} numbers of {_CORNER_PLACES} "
                f"and {sizes[odd[0]]} corners"
            )
        has = repeat_each(of_faces.sizes > 0, sizes)
        # One row for each vertex and texture coordinate of it.
        pairs = np.column_stack([corners[has], of_faces.values.astype(np.float64).reshape(-1, 2) + 0.0])
        rows, which = np.unique(pairs, axis=0, return_inverse=True)
        places = np.full(len(corners), -1)
        places[has] = which.ravel()
        return (rows[:, 1:], places) if has.any() else (None, None)
    for names in _PLACES:
        vt = _table(vertex, *names)
        if vt is not None:
            return vt, corners
    return None, None


def _with_places(tables: PlyTables, mesh: MeshData) -> PlyTables:
    """Return the tables with the texture coordinates of a mesh."""
    vt, seam = vertex_places(mesh)
    scattered = bool(seam.any()) or (mesh.FT is not None and bool((mesh.FT < 0).any()))
    vertex = tables.find("vertex")
    old = {name for names in _PLACES for name in names if vertex is not None and _table(vertex, *names) is not None}
    of_vertices = []
    if mesh.FT is not None and not scattered:
        # Vertices that no face uses have NaN, which readers may not accept.
        of_vertices = [Column(name, np.nan_to_num(vt[:, i])) for i, name in enumerate(_PLACES[0])]
    tables = _replace_columns(tables, "vertex", old, of_vertices)
    return _replace_columns(tables, "face", {_CORNER_PLACES}, [_corner_places(mesh)] if scattered else [])


def _replace_columns(tables: PlyTables, name: str, old: set[str], new: list[Column]) -> PlyTables:
    """Return the tables with other columns of the element of a name: without some, and with new ones at the end."""
    elements = []
    for element in tables.elements:
        if element.name == name:
            kept = [column for column in element.columns if column.name not in old]
            element = replace(element, columns=(*kept, *new))
        elements.append(element)
    return replace(tables, elements=tuple(elements))


def read_second_places(mesh: MeshData, carried: CarriedPly) -> FloatArray | None:
    """Return the second texture coordinates (f, 3, 2), NaN for none; None if the file has none.

    ValueError if a face has another number of them than of corners.
    """
    face = carried.tables.find("face")
    column = None if face is None else face.find(_SECOND_PLACES)
    if column is None or column.sizes is None:
        return None
    sizes = mesh.rings.sizes
    if not ((column.sizes == 2 * sizes) | (column.sizes == 0)).all():
        raise ValueError(f"{mesh.source}: a face has another number of {_SECOND_PLACES} than twice its corners")
    pairs = np.full((len(mesh.rings.corners), 2), np.nan)
    pairs[repeat_each(column.sizes > 0, sizes)] = column.values.astype(np.float64).reshape(-1, 2)
    # A face has each vertex once.
    keys = repeat_each(np.arange(len(sizes)), sizes) * len(mesh.V) + mesh.F.ravel()[mesh.rings.corners]
    order = np.argsort(keys)
    wanted = mesh.rings.of_triangle[:, None] * len(mesh.V) + mesh.F
    return pairs[order[np.searchsorted(keys[order], wanted)]]


def _corner_places(mesh: MeshData, name: str = _CORNER_PLACES) -> Column:
    """Return a pair for each corner of the faces that have texture coordinates."""
    pairs, sizes = mesh.corner_uv.reshape(-1, 2)[mesh.rings.corners], mesh.rings.sizes
    face = repeat_each(np.arange(len(sizes)), sizes)
    bare = np.unique(face[np.isnan(pairs[:, 0])])
    count = 2 * sizes
    count[bare] = 0
    return Column(name, pairs[~np.isin(face, bare)].ravel(), count)


def _vertices(mesh: MeshData) -> Element:
    """Return the vertex table of a mesh that was not read from a PLY file."""
    names = ["x", "y", "z"]
    tables: list[NDArray[Any]] = [mesh.V]
    normals, colours = _normals(mesh), _colours(mesh)
    if normals is not None:
        names += _NORMAL
        tables.append(normals)
    if colours is not None:
        names += _COLOUR[: colours.shape[1]]
        tables.append(colours)
    columns = [column for table in tables for column in np.ascontiguousarray(table.T)]
    return Element("vertex", len(mesh.V), tuple(Column(*pair) for pair in zip(names, columns, strict=True)))


def _faces(mesh: MeshData) -> Element:
    """Return the face table of a mesh that was not read from a PLY file."""
    ring = mesh.F.ravel()[mesh.rings.corners].astype(np.int32)
    return Element("face", mesh.faces, (Column(_RINGS[0], ring, mesh.rings.sizes),))


def _colours(mesh: MeshData) -> NDArray[Any] | None:
    """Return colours of vertices, as bytes if they are multiples of 1/255; None unless all vertices have one."""
    colours = colours_of(mesh)
    if colours is None:
        return None
    in_bytes = np.rint(255 * colours)
    return in_bytes.astype(np.uint8) if (in_bytes / 255 == colours).all() else colours.astype(np.float32)


def _normals(mesh: MeshData) -> FloatArray | None:
    """Return the normal of every vertex; None if a vertex has several normals or a corner has none."""
    rows = normals_of(mesh)
    if rows is None or mesh.FN is None:
        return None
    own = np.zeros((len(mesh.V), 3))
    own[mesh.F] = rows[mesh.FN]
    return own if (own[mesh.F] == rows[mesh.FN]).all() else None
