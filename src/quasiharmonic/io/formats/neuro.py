"""Read and write cortical surfaces: GIFTI and FreeSurfer's surfaces, through nibabel.

A file of these formats holds one position per vertex, so a map is written alone, as a surface in the plane z = 0. All
vertices of the surface keep their numbers, because data in other files belong to these numbers. At the seams of a map,
vertices have several positions. As in FreeSurfer, the triangles at these vertices are left out.
"""

from __future__ import annotations

import gzip
import os
import re
import warnings
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.atomic import encode_by, write_whole
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.models.mesh_maps import check_mapped, in_plane, vertex_places
from quasiharmonic.io.models.meshdata import Carried, MeshData
from quasiharmonic.io.untrusted import check_gifti, read_bytes, unpack_gzip
from quasiharmonic.util.arrays import FloatArray, IntArray, count_of, mark
from quasiharmonic.util.hints import explain_missing
from quasiharmonic.util.progress import use_value

# The intents that the standard has for points and triangles.
_POINTS, _TRIANGLES = 1008, 1009
# The intent of labels, such as the regions of a parcellation.
_LABEL = 1002
_SIDES = {"lh": "CortexLeft", "rh": "CortexRight"}
# First bytes of FreeSurfer's values per vertex, and of old surfaces of quadrilaterals. For values, the numbers of
# vertices, of triangles and of values per vertex follow.
_VALUES = b"\xff\xff\xff"
# What a GIFTI file says about the part of the brain.
_STRUCTURE = "AnatomicalStructurePrimary"


@dataclass(frozen=True, eq=False)
class CarriedGifti(Carried):
    """The contents of a GIFTI file besides its mesh that `write_gifti` keeps."""

    structure: str  # Part of the brain, such as "CortexLeft"


def read_gifti(path: str | os.PathLike[str]) -> MeshData:
    """Read the surface of a GIFTI file, ``.gii`` or ``.gii.gz``.

    Returns
    -------
    MeshData
        The points and triangles of the file, which has one array of each.

    Raises
    ------
    MeshFileError
        If the file is not valid, or does not hold one surface.
    ImportError
        If nibabel is not installed.
    """
    image = _read_gifti(path)
    with report_damage(path, damage=(TypeError, ValueError)):
        mesh = MeshData(*gifti_arrays(image), source=os.fspath(path))
    metadata = [image.meta, *(array.meta for array in image.darrays if array.intent == _POINTS)]
    structure = next((found for one in metadata if (found := one.get(_STRUCTURE))), None)
    return mesh if structure is None else replace(mesh, carried=CarriedGifti(mesh.V, mesh.F, structure))


def read_gifti_values(path: str | os.PathLike[str]) -> FloatArray | IntArray:
    """Read the values per vertex of a GIFTI file: (n,), or (n, k) of k arrays.

    Labels (``.label.gii``: integers with the intent LABEL) are int64, other values (``.func.gii``, ``.shape.gii``)
    float64. Labels must not be interpolated: transfer them with ``nearest=True``.

    Raises
    ------
    MeshFileError
        If the file is not valid, is a surface, or its arrays differ in shape.
    ImportError
        If nibabel is not installed.
    """
    held = [array for array in _read_gifti(path).darrays if array.intent not in (_POINTS, _TRIANGLES)]
    if not held or any(array.data.shape != held[0].data.shape for array in held):
        raise MeshFileError(path, "does not hold arrays of values of one shape")
    values = np.stack([array.data for array in held], axis=-1)
    labels = values.dtype.kind in "iu" and all(array.intent == _LABEL for array in held)
    values = values.astype(np.int64 if labels else np.float64)
    return values[..., 0] if len(held) == 1 else values


def _read_gifti(path: str | os.PathLike[str]) -> Any:
    """Return the ``GiftiImage`` of a file; MeshFileError if it is not valid."""
    nibabel, data = _nibabel(), read_bytes(path)
    if os.fspath(path).lower().endswith(".gz"):
        with report_damage(path, "is not a complete gzip file: "):
            data = unpack_gzip(data)
    # The parser raises errors of many types for damaged files.
    with report_damage(path, "is not valid GIFTI: ", Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_gifti(data)
        return nibabel.gifti.GiftiImage.from_bytes(data)


def gifti_arrays(image: Any) -> tuple[Any, Any]:
    """Return points and triangles of a ``nibabel.GiftiImage``; ValueError if it does not have one array of each."""
    points, triangles = ([array for array in image.darrays if array.intent == code] for code in (_POINTS, _TRIANGLES))
    if len(points) != 1 or len(triangles) != 1:
        raise ValueError(
            f"has {count_of('array', 'arrays', len(points))} of points and {len(triangles)} of triangles, not one of "
            "each; a surface file (.surf.gii) has both"
        )
    return points[0].data, triangles[0].data


def write_gifti(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write the map of a mesh as a flat GIFTI surface, compressed if the name ends in ``.gz``.

    Positions are in single precision, as the standard requires. Triangles at seams are left out. The hemisphere is that
    of the GIFTI file that was read; otherwise, that of names such as ``lh.…`` of the output or the input.

    Raises
    ------
    MeshFileError
        If the mesh has no map, every vertex lies on a seam, or a number exceeds single precision.
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    ImportError
        If nibabel is not installed.
    """
    gifti = _nibabel().gifti
    flat = flat_surface(path, mesh)
    names = (Path(name).name.lower().split(".")[0] for name in (path, mesh.source))
    side = next((_SIDES[name] for name in names if name in _SIDES), None)
    structure = mesh.carried.structure if isinstance(mesh.carried, CarriedGifti) else side
    about = {"GeometricType": "Flat", **({_STRUCTURE: structure} if structure else {})}
    arrays = [
        gifti.GiftiDataArray(single_precision(path, flat.V), "NIFTI_INTENT_POINTSET", meta=about),
        gifti.GiftiDataArray(flat.F.astype(np.int32), "NIFTI_INTENT_TRIANGLE"),
    ]
    data = gifti.GiftiImage(darrays=arrays).to_bytes()
    write_whole(path, gzip.compress(data, mtime=0) if os.fspath(path).lower().endswith(".gz") else data)


def read_freesurfer(path: str | os.PathLike[str]) -> MeshData:
    """Read a binary surface of FreeSurfer, such as ``lh.pial``.

    Returns
    -------
    MeshData
        Vertices and triangles in FreeSurfer's surface coordinates, in millimetres.

    Raises
    ------
    MeshFileError
        If the file is not a binary surface, or is cut off.
    ImportError
        If nibabel is not installed.
    """
    nibabel, data = _nibabel(), read_bytes(path)
    if data.startswith(b"#!ascii"):
        raise MeshFileError(path, "is a text file of FreeSurfer", remedy="convert it: mris_convert IN OUT.gii")
    if _holds_values(data):
        raise MeshFileError(path, "holds values per vertex, not a surface", remedy="use its surface, such as lh.pial")
    # A damaged file also gives MemoryError, and errors of other types.
    with report_damage(path, "is not a binary surface of FreeSurfer: ", Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        V, F = nibabel.freesurfer.read_geometry(os.fspath(path))
        return MeshData(V, F, source=os.fspath(path))


def _holds_values(data: bytes) -> bool:
    """Return whether the bytes are FreeSurfer's values per vertex, such as ``lh.thickness``."""
    if len(data) < 15 or not data.startswith(_VALUES):
        return False
    vertices, _, values = np.frombuffer(data[3:15], dtype=">i4").tolist()
    return len(data) == 15 + 4 * vertices * values


def write_freesurfer(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write the map of a mesh as a flat binary surface of FreeSurfer; see `write_gifti`."""
    write_geometry = _nibabel().freesurfer.write_geometry
    flat = flat_surface(path, mesh)
    places = single_precision(path, flat.V)
    # The default stamp contains the user's name and the time.
    stamp = "created by quasiharmonic"
    write_whole(path, encode_by("surface", lambda part: write_geometry(part, places, flat.F, create_stamp=stamp)))


def flat_surface(path: str | os.PathLike[str], mesh: MeshData) -> MeshData:
    """Return a map as a mesh in the plane z = 0, without the triangles at seams.

    Vertices that no remaining triangle uses keep their numbers; they are at the origin if the map has seams.

    Raises
    ------
    MeshFileError
        If the mesh has no map, or all triangles are at seams.
    """
    check_mapped(mesh)
    uv, seam = vertex_places(mesh)
    if not seam.any():
        return in_plane(mesh)
    F = mesh.F[~seam[mesh.F].any(axis=1)]
    if not len(F):
        what = "every triangle has a vertex with more than one pair of texture coordinates"
        raise MeshFileError(path, what, remedy="write OBJ or PLY")
    uv[seam | np.isnan(uv).any(axis=1)] = 0.0
    return MeshData(uv, F, source=mesh.source)


def not_in_flat_surface(mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that a flat GIFTI or FreeSurfer surface or patch will not contain."""
    lost = ["the surface: only the map is written", "digits beyond single precision"]
    seam = vertex_places(mesh)[1]
    if seam.any():
        at = count_of("vertex", "vertices", int(seam.sum()))
        lost.append(f"the triangles at {at} on seams ({int(seam[mesh.F].any(axis=1).sum())} of {len(mesh.F)})")
    return lost


def not_in_patch(mesh: MeshData) -> list[str]:
    """Return descriptions of the mesh data that a patch will not contain."""
    lost = "the list of triangles: readers use every triangle of the surface between its vertices"
    return [*not_in_flat_surface(mesh), lost]


def single_precision(path: str | os.PathLike[str], V: FloatArray) -> NDArray[np.float32]:
    """Return positions in single precision; MeshFileError if one exceeds it."""
    with np.errstate(over="ignore"):
        single = V.astype(np.float32)
    if not np.isfinite(single).all():
        raise MeshFileError(path, "positions exceed single precision", remedy="scale the map down")
    return single


# ---------------------------------------------------------------------------------------------------------------------
# Patches

# The names of surfaces with the triangles of a hemisphere, in the order of the search.
_KINDS = "inflated", "smoothwm", "white", "pial", "midthickness", "fiducial", "orig", "sphere", "surf"
_ENDINGS = "", ".surf.gii", ".gii", ".gii.gz"
_ROWS = np.dtype([("vertex", ">i4"), ("place", ">f4", 3)])
_given_surface: ContextVar[Path | None] = ContextVar("given_surface", default=None)


def use_parent_surface(path: str | os.PathLike[str]) -> AbstractContextManager[None]:
    """Read patches in a block with the triangles of a surface in place of the one beside the patch."""
    return use_value(_given_surface, Path(path))


def find_parent_surface(path: str | os.PathLike[str]) -> Path | None:
    """Return the surface of a patch: that of `use_parent_surface`, or one beside the patch with the same hemisphere.

    For ``lh.cortex.patch.3d`` this is the first that exists of ``lh.inflated``, ``lh.smoothwm``, ``lh.white``,
    ``lh.pial``, ``lh.midthickness``, ``lh.fiducial``, ``lh.orig``, ``lh.sphere`` and ``lh.surf``, or one of these names
    followed by ``.surf.gii``, ``.gii`` or ``.gii.gz``. None if there is none.
    """
    if (given := _given_surface.get()) is not None:
        return given
    folder, side = Path(path).parent, Path(path).name.split(".")[0]
    candidates = (folder / f"{side}.{kind}{ending}" for ending in _ENDINGS for kind in _KINDS)
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def read_patch(path: str | os.PathLike[str], surface: str | os.PathLike[str] | None = None) -> MeshData:
    """Read a patch of FreeSurfer, binary or text, such as ``lh.cortex.patch.3d`` or ``lh.cortex.patch.flat``.

    A binary patch contains numbers and positions of vertices, but no triangles. Its triangles are those of the surface
    whose three corners belong to the patch. A text patch contains its triangles.

    Parameters
    ----------
    path : str or path-like
        The patch.
    surface : str or path-like, optional
        A surface of the same hemisphere, in any format, such as ``lh.inflated``. By default one beside the patch; see
        `find_parent_surface`.

    Returns
    -------
    MeshData
        All vertices of the surface, with their numbers; those outside the patch are at the origin. The triangles of
        the patch.

    Raises
    ------
    MeshFileError
        If the file is not a patch, there is no surface, or the patch belongs to another surface.
    """
    data = read_bytes(path)
    if data.startswith(b"#!ascii"):
        number, places, F = _text_patch(path, data)
        n = int(max(number.max(initial=-1), F.max(initial=-1))) + 1
    else:
        number, places = _binary_patch(path, data)
        parent = find_parent_surface(path) if surface is None else Path(surface)
        if parent is None:
            side = Path(path).name.split(".")[0]
            raise MeshFileError(
                path,
                "holds no triangles, and there is no surface of the same hemisphere beside it",
                remedy=f"put {side}.inflated there, or name a surface (qhm … --surface FILE, read_patch(surface=))",
            )
        from quasiharmonic.io.mesh_files import read_mesh

        whole = read_mesh(parent)
        n, F = len(whole.V), whole.F
        if number.size and number.max() >= n:
            raise MeshFileError(path, f"has vertex {number.max()}, but {parent} has {n} vertices")
    V, F = _patch_of(number, places, n, F)
    if not len(F):
        raise MeshFileError(path, "has no triangle whose corners all belong to the patch")
    with report_damage(path):
        return MeshData(V, F, source=os.fspath(path))


def _patch_of(number: IntArray, places: FloatArray, n: int, F: IntArray) -> tuple[FloatArray, IntArray]:
    """Return positions of all ``n`` vertices of a surface, zero outside a patch, and the triangles inside it."""
    inside = mark(n, number)
    V = np.zeros((n, 3))
    V[number] = places
    return V, F[inside[F].all(axis=1)]


def read_written_patch(path: str | os.PathLike[str], mesh: MeshData) -> MeshData:
    """Read a patch that `write_patch` wrote; without a surface, its triangles are those of the mesh."""
    parent = find_parent_surface(path)
    if parent is not None:
        return read_patch(path, parent)
    V, F = _patch_of(*_binary_patch(path, read_bytes(path)), len(mesh.V), mesh.F)
    return replace(mesh, V=V, F=F, vt=None, FT=None, polygons=None)


def write_patch(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write the map of a mesh as a binary patch of FreeSurfer.

    The vertices that triangles use are written, with their numbers in the mesh. So the mesh must have all vertices of
    the surface, as `read_patch` returns it. Vertices on seams are left out, which is how FreeSurfer cuts a surface.
    Vertices on the boundary are marked.

    Raises
    ------
    MeshFileError
        If the mesh has no map, every triangle is at a seam, or a number exceeds single precision.
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    """
    from quasiharmonic.geometry.mesh.topology import boundary_edges

    flat = flat_surface(path, mesh)
    number = np.unique(flat.F)
    rows = np.zeros(len(number), dtype=_ROWS)
    # Numbers count from one. Those of boundary vertices are negative.
    rows["vertex"] = np.where(np.isin(number, boundary_edges(flat.F, len(flat.V))), -number - 1, number + 1)
    rows["place"] = single_precision(path, flat.V[number])
    write_whole(path, np.array([-1, len(rows)], dtype=">i4").tobytes() + rows.tobytes())


def _binary_patch(path: str | os.PathLike[str], data: bytes) -> tuple[IntArray, FloatArray]:
    """Return numbers, from zero, and positions of the vertices of a binary patch."""
    mark, count = np.frombuffer(data[:8].ljust(8, b"\0"), dtype=">i4").tolist()
    if mark != -1 or count < 1 or len(data) < 8 + count * _ROWS.itemsize:
        raise MeshFileError(path, "is not a binary patch of FreeSurfer, or is cut off")
    rows = np.frombuffer(data, dtype=_ROWS, count=count, offset=8)
    number = np.abs(rows["vertex"].astype(np.int64)) - 1
    with np.errstate(invalid="ignore"):
        places = rows["place"].astype(np.float64)
    _check_patch(path, number, places)
    return number, places


def _text_patch(path: str | os.PathLike[str], data: bytes) -> tuple[IntArray, FloatArray, IntArray]:
    """Return numbers and positions of the vertices of a text patch, and its triangles."""
    with report_damage(path, "is not a text patch of FreeSurfer: ", (ValueError, IndexError, OverflowError)):
        _, text = data.split(b"\n", 1)
        # The number from zero follows as "vno=…".
        words = re.sub(rb"vno=\S*", b"", text).split()
        n, f = int(words[0]), int(words[1])
        if min(n, f) < 1 or len(words) != 2 + 4 * (n + f):
            raise ValueError(f"its length does not match {n} vertices and {f} triangles")
        vertices = np.array(words[2 : 2 + 4 * n]).reshape(-1, 4)
        number = vertices[:, 0].astype(np.int64)
        # Old files count from zero.
        number = number if b"vno=" not in text else np.abs(number) - 1
        places = vertices[:, 1:].astype(np.float64)
        F = np.array(words[2 + 4 * n :]).reshape(-1, 4)[:, 1:].astype(np.int64)
        if F.min() < 0 or not np.isin(F, number).all():
            raise ValueError("a triangle has a corner outside the patch")
    _check_patch(path, number, places)
    return number, places, F


def _check_patch(path: str | os.PathLike[str], number: IntArray, places: FloatArray) -> None:
    if number.min() < 0 or len(np.unique(number)) < len(number):
        raise MeshFileError(path, "has a vertex number of zero, or the same vertex twice")
    if not np.isfinite(places).all():
        raise MeshFileError(path, "has positions that are not finite")


def _nibabel() -> Any:
    with explain_missing("GIFTI and FreeSurfer surfaces need nibabel", extra="neuro"):
        import nibabel
        import nibabel.freesurfer
        import nibabel.gifti
    return nibabel
