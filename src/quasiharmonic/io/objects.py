"""Vertices and triangles of a mesh, given as an object of another library, a mapping or a file.

To read an object, no library is imported: the adapter recognises it by the attribute names of its positions and faces.
It supports trimesh, PyVista, meshio, Open3D, vedo, nibabel, SciPy's triangulations and this package's classes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Number
from os import PathLike
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.polygons import triangulate_polygons
from quasiharmonic.io.fem.mesh_parts import find_counts
from quasiharmonic.io.mesh_files import read_mesh, write_mapped
from quasiharmonic.io.models.mesh_maps import seamed
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_range,
    describe,
    index_array,
    pad_to_space,
    repeat_each,
    triangle_rows,
    vertex_array,
)
from quasiharmonic.util.hints import explain_missing

if TYPE_CHECKING:
    from trimesh import Trimesh


class _HasVertices(Protocol):
    @property
    def vertices(self) -> Any: ...


class _HasPoints(Protocol):
    @property
    def points(self) -> Any: ...


class _HasV(Protocol):
    @property
    def V(self) -> Any: ...


class _HasCoordinates(Protocol):
    @property
    def coordinates(self) -> Any: ...


class _HasVerts(Protocol):
    @property
    def verts(self) -> Any: ...


class _HasDoflocs(Protocol):
    @property
    def doflocs(self) -> Any: ...


class _HasGeometry(Protocol):
    @property
    def geometry(self) -> Any: ...


class _HasDarrays(Protocol):
    @property
    def darrays(self) -> Any: ...


#: A mesh: an object with vertices and faces, a mapping with these keys, a surface of nibabel (a ``GiftiImage``, or a
#: tuple of an array of points and an array of triangles), or the path of a file.
MeshLike = (
    _HasVertices
    | _HasPoints
    | _HasV
    | _HasCoordinates
    | _HasVerts
    | _HasDoflocs
    | _HasGeometry
    | _HasDarrays
    | tuple[NDArray[Any], NDArray[Any]]
    | tuple[NDArray[Any], NDArray[Any], Any]
    | tuple[NDArray[Any], NDArray[Any], Any, Any]
    | Mapping[str, Any]
    | str
    | PathLike[str]
)

# "faces" precede "triangles", because "triangles" of a trimesh mesh are coordinates.
_POSITIONS = ("vertices", "points", "V", "coordinates", "verts")
_FACES = ("faces", "triangles", "F", "cells", "simplices")
# scikit-fem's positions; they are columns, as are the corners of its elements.
_BY_COLUMNS = "doflocs"

# Kinds of cells that are faces, by the names of meshio.
_FACE_CELLS = ("triangle", "quad", "polygon")
# Kinds of cells to skip, by the names of meshio.
_SKIPPED_CELLS = ("vertex", "line")
# The same by the numbers of VTK.
_FACE_CELLS_OF_VTK = (5, 7, 9)
_SKIPPED_CELLS_OF_VTK = (0, 1, 2, 3, 4)


def stands_for_mesh(value: object) -> bool:
    """Return whether a value is meant as a whole mesh.

    Meshes are paths, mappings, objects with vertices and faces, and any other object that is not array-like.
    """
    if isinstance(value, np.ndarray):
        return False
    if is_surface_tuple(value) or _is_gifti(value):
        return True
    if isinstance(value, str | PathLike | Mapping) or None not in _parts(value) or hasattr(value, _BY_COLUMNS):
        return True
    numbers = isinstance(value, Number | Sequence | bytes | memoryview | type(None))
    return not numbers and not any(
        hasattr(value, name) for name in ("__array__", "__array_interface__", "__dlpack__", "__iter__")
    )


def is_surface_tuple(value: object) -> bool:
    """Return whether a value is a tuple as nibabel's ``agg_data`` and ``read_geometry`` return it.

    Its first two elements are arrays of points (n, 3) and of integers (f, 3). ``read_geometry`` may add a dictionary
    and text.
    """
    if type(value) is not tuple or not 2 <= len(value) <= 4:
        return False
    points, triangles, *more = value
    if any(isinstance(one, np.ndarray) for one in more):
        return False
    arrays = isinstance(points, np.ndarray) and isinstance(triangles, np.ndarray)
    return arrays and points.shape[1:] == triangles.shape[1:] == (3,) and triangles.dtype.kind in "iu"


def _is_gifti(value: object) -> bool:
    return hasattr(value, "darrays") and hasattr(value, "agg_data")


def mesh_arrays(mesh: MeshLike) -> tuple[FloatArray, IntArray]:
    """Return the positions and the triangles of a mesh, given as an object, a mapping or a path.

    Parameters
    ----------
    mesh : object, mapping or path
        An object or mapping with positions as ``vertices``, ``points``, ``V``, ``coordinates`` or ``verts``, and faces
        as ``faces``, ``triangles``, ``F``, ``cells`` or ``simplices``. Faces are rows of corners, VTK's list (count,
        corners, count, …), or meshio's blocks. Also a mesh of scikit-fem; nibabel's ``GiftiImage`` or a tuple that its
        ``agg_data`` or ``read_geometry`` returns; or the path of a file that
        `quasiharmonic.io.read_mesh` reads. Larger faces are cut into triangles, as those of files are. Points and lines
        among the cells are skipped.

    Returns
    -------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64

    Raises
    ------
    ValueError
        If positions or faces are missing, or there are triangle strips or cells that are not faces, such as tetrahedra.
    quasiharmonic.io.MeshFileError
        If the file cannot be read.
    """
    if isinstance(mesh, str | PathLike):
        read = read_mesh(mesh)
        return read.V, read.F
    what = describe(mesh)
    if _is_gifti(mesh) or is_surface_tuple(mesh):
        from quasiharmonic.io.formats.neuro import gifti_arrays

        pair: Any = mesh
        try:
            points, triangles = gifti_arrays(pair) if _is_gifti(mesh) else pair[:2]
        except ValueError as error:
            raise ValueError(f"{what} {error}") from error
        V = vertex_array(points, f"points of {what}")
        return V, _triangles(V, f"triangles of {what}", triangles, None)
    by_columns = getattr(mesh, _BY_COLUMNS, None)
    if by_columns is not None:
        V = vertex_array(np.asarray(by_columns).T, f"{_BY_COLUMNS} of {what}")
        return V, _triangles(V, f"t of {what}", np.asarray(_part(mesh, "t")).T, None)
    positions, faces = _parts(mesh)
    if positions is None or faces is None:
        lacking = "vertices" if positions is None else "faces"
        raise ValueError(
            f"{what} is not a mesh, because it has no {lacking}: pass an object with vertices and faces, the path of "
            "a file, or the arrays V and F"
        )
    name = f"{faces} of {what}"
    if faces == "simplices" and np.shape(_part(mesh, faces))[1:] == (4,):
        raise ValueError(f"{name} are tetrahedra: only surface cells are supported")
    strips = _part(mesh, "strips")
    if isinstance(strips, np.ndarray) and strips.size:
        raise ValueError(f"{what} has triangle strips: pass mesh.triangulate()")
    V = vertex_array(_part(mesh, positions), f"{positions} of {what}")
    return V, _triangles(V, name, _part(mesh, faces), _part(mesh, "celltypes"))


def planar_arrays(mesh: MeshLike) -> tuple[FloatArray, IntArray]:
    """Return the arrays of `mesh_arrays`, with positions (n, 2) if the third coordinate is constant."""
    V, F = mesh_arrays(mesh)
    return without_constant_z(V), F


def without_constant_z(V: FloatArray) -> FloatArray:
    """Return positions (n, 2) if the third coordinate is constant; otherwise ``V``."""
    return V[:, :2].copy() if V.shape[1] == 3 and len(V) and not np.ptp(V[:, 2]) else V


def as_seamed_mesh(mesh: MeshLike) -> SeamedMesh:
    """Return a mesh as a `SeamedMesh`, with its seams and its map.

    Parameters
    ----------
    mesh : SeamedMesh, MeshData, path or mesh object
        A path is read. Of a mesh object of another library, positions and triangles are used, without seams and map.

    Returns
    -------
    SeamedMesh
        A `SeamedMesh` is returned unchanged.

    Raises
    ------
    TypeError
        If the argument is not a mesh.
    ValueError
        If positions or faces are missing.
    quasiharmonic.io.MeshFileError
        If the file cannot be read.

    See Also
    --------
    atlas.SeamedMesh : From arrays.
    quasiharmonic.io.read_mesh : Reads a file with all its data.

    Examples
    --------
    >>> from quasiharmonic.atlas import as_seamed_mesh
    >>> from quasiharmonic.io import MeshData
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> len(as_seamed_mesh(MeshData(V, F)).islands)
    1
    """
    if isinstance(mesh, SeamedMesh):
        return mesh
    if isinstance(mesh, str | PathLike):
        mesh = read_mesh(mesh)
    if isinstance(mesh, MeshData):
        return seamed(mesh)
    if not stands_for_mesh(mesh):
        raise TypeError(f"{describe(mesh)} is not a mesh: pass a SeamedMesh, or the path of a file")
    return SeamedMesh(*mesh_arrays(mesh))


def write_map(path: str | PathLike[str], mesh: MeshLike, uv: ArrayLike) -> None:
    """Write a mesh with one position per vertex as its map; see `write_mapped`.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    mesh : MeshData, path or mesh object
        A path is read. Of a mesh object of another library, positions and triangles are written.
    uv : (n, 2) float
        Position of every vertex in the plane.

    Raises
    ------
    MeshFileError, OutputError
        As `write_mapped`.
    ValueError
        If ``uv`` has another shape or is not finite.
    """
    if isinstance(mesh, str | PathLike):
        mesh = read_mesh(mesh)
    elif not isinstance(mesh, MeshData):
        mesh = MeshData(*mesh_arrays(mesh))
    write_mapped(path, mesh.with_map(getattr(uv, "uv", uv)))


def mesh_triangles(F: Any) -> Any:
    """Return the triangles of a mesh, and any other value unchanged."""
    return mesh_arrays(F)[1] if stands_for_mesh(F) else F


def _parts(mesh: object) -> tuple[str | None, str | None]:
    """Return the names of a mesh's positions and faces; None for a missing one."""

    def first(names: Iterable[str]) -> str | None:
        parts = ((name, _part(mesh, name)) for name in names)
        # Some objects have methods or counts of these names; skip them.
        return next((name for name, part in parts if hasattr(part, "__len__")), None)

    return first(_POSITIONS), first(_FACES)


def _part(mesh: object, name: str) -> Any:
    return mesh.get(name) if isinstance(mesh, Mapping) else getattr(mesh, name, None)


def _triangles(V: FloatArray, name: str, faces: Any, kinds: Any) -> IntArray:
    """Return the triangles of faces in any of the forms that `mesh_arrays` lists."""
    if isinstance(faces, Sequence) and any(hasattr(block, "data") and hasattr(block, "type") for block in faces):
        rings = [ring for block in faces for ring in _block(name, block)]
        return _cut(V, np.concatenate([[], *rings]).astype(np.int64), np.array([len(ring) for ring in rings]))
    try:
        array = np.asarray(faces)
    except ValueError:  # The rows differ in length.
        rings = [index_array(name, ring) for ring in faces]
        return _cut(V, np.concatenate(rings), np.array([len(ring) for ring in rings]))
    if array.ndim == 1 and array.size:
        return _cut(V, *_vtk(name, index_array(name, faces), kinds))
    if array.ndim == 2 and array.shape[1] > 3:
        return _cut(V, index_array(name, faces).ravel(), np.full(len(array), array.shape[1]))
    return triangle_rows(faces, name)


def _block(name: str, block: Any) -> Iterable[IntArray]:
    """Return the faces of one meshio block."""
    if block.type in _SKIPPED_CELLS:
        return ()
    if block.type not in _FACE_CELLS:
        raise ValueError(f"{name} has cells of type {block.type!r}: only surface cells are supported")
    return (index_array(name, ring) for ring in block.data)


def _vtk(name: str, numbers: IntArray, kinds: Any) -> tuple[IntArray, IntArray]:
    """Return corners and sizes of the faces in VTK's list (count, corners, count, …).

    ``kinds`` are the kinds of the cells; None if all cells are faces.
    """
    heads = find_counts(numbers)
    if heads is None or not numbers[heads].all():
        raise ValueError(f"{name} must have one row of corners per face, or the flat form (count, corners, count, …)")
    sizes = numbers[heads]
    faces = np.ones(len(heads), dtype=np.bool_)
    if kinds is not None:
        faces = np.isin(kinds, _FACE_CELLS_OF_VTK)
        wrong = np.setdiff1d(kinds, (*_FACE_CELLS_OF_VTK, *_SKIPPED_CELLS_OF_VTK))
        if wrong.size:
            raise ValueError(f"{name} has cells of VTK type {wrong[0]}: only surface cells are supported")
    corner = repeat_each(faces, sizes + 1)
    corner[heads] = False
    return numbers[corner], sizes[faces]


def _cut(V: FloatArray, corners: IntArray, sizes: IntArray) -> IntArray:
    """Cut faces of any number of corners into triangles (f, 3)."""
    check_range("the faces", corners, len(V))
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    return corners[triangulate_polygons(pad_to_space(V), corners, starts)[0]]


def make_trimesh(
    V: FloatArray, F: IntArray, uv: FloatArray, *, like: Any = None, rows: IntArray | None = None
) -> Trimesh:
    """Return a trimesh.Trimesh with the map as texture coordinates; vertices and triangles keep their order.

    A planar mesh is placed at z = 0. From a trimesh.Trimesh ``like``, of whose vertices ``rows`` (n,) were made, come
    colours and attributes of vertices, attributes of faces, the material and the metadata. ImportError if trimesh is
    not installed.
    """
    with explain_missing("to_trimesh needs trimesh", "trimesh"):
        import trimesh
    made = trimesh.Trimesh(vertices=pad_to_space(V), faces=F, process=False)
    if not isinstance(like, trimesh.Trimesh):
        made.visual = trimesh.visual.TextureVisuals(uv=uv.copy())  # type: ignore[no-untyped-call]
        return made
    visual: Any = like.visual
    material = getattr(visual, "material", None)
    made.visual = trimesh.visual.TextureVisuals(uv=uv.copy(), material=material)  # type: ignore[no-untyped-call]
    colours = visual.vertex_colors if visual.kind == "vertex" else getattr(visual, "vertex_attributes", {}).get("color")
    if colours is not None:
        made.visual.vertex_attributes["color"] = np.asarray(colours)[rows]
    made.vertex_attributes.update({name: np.asarray(of)[rows] for name, of in like.vertex_attributes.items()})
    made.face_attributes.update({name: np.array(of) for name, of in like.face_attributes.items()})
    made.metadata.update(like.metadata)
    return made
