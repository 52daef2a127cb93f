"""Read and write displacement fields of images: NumPy, NIfTI through nibabel, and ITK's formats through SimpleITK.

In memory a field has displacements along the axes of its grid. In NIfTI and ITK files the components refer to the axes
of space: those of ITK, which point left, posterior and superior (LPS). NIfTI fields that ITK, ANTs and elastix write
have them too, with the intent VECTOR (1007). With the intent DISPVECT (1006) they are those of the NIfTI standard,
right, anterior and superior (RAS).

The headers of ITK's files (MetaImage and NRRD) are checked before: a file must contain its own data, and not announce
too many of them.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io.atomic import encode_by, write_whole
from quasiharmonic.io.errors import MeshFileError, check_path, report_damage
from quasiharmonic.io.untrusted import check_size, read_bytes, read_npy
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.hints import explain_missing

# Bytes in which a header must end.
_LONGEST = 1 << 20
NIFTI = ".nii", ".nii.gz"
ITK = ".mha", ".nrrd"
#: The suffixes of displacement fields.
FIELD_SUFFIXES = ".npy", *NIFTI, *ITK
# The intent of NIfTI fields whose components are those of the standard.
_DISPVECT = 1006
# Largest cosine between the axes of a grid; files store directions in single precision.
_SKEW = 1e-4
# Largest displacement out of the plane, relative to the largest in it.
_OUT_OF_PLANE = 1e-6


def check_header(data: bytes, suffix: str) -> None:
    """Raise a ValueError if a file of this suffix refers to another file, or announces too much data.

    ITK's readers follow the name of a data file to any place.
    """
    entries = _entries(data, suffix)
    other = next((entries[key] for key in ("elementdatafile", "data file", "datafile") if key in entries), "LOCAL")
    if other.upper() != "LOCAL":
        raise ValueError(f"refers to the data file {ascii(other)[:80]}: save the data in the file itself")
    sides = (entries.get("dimsize") or entries.get("sizes") or "").split()
    if all(side.isdecimal() for side in sides):
        components = entries.get("elementnumberofchannels", "1")
        count = prod(map(int, sides)) * (int(components) if components.isdecimal() else 1)
        check_size(8 * count, "the header announces")


def _entries(data: bytes, suffix: str) -> dict[str, str]:
    """Return the entries of a header: MetaImage's ends with the entry ElementDataFile, NRRD's with an empty line."""
    entries: dict[str, str] = {}
    for line in data[:_LONGEST].split(b"\n"):
        if "elementdatafile" in entries or (suffix != ".mha" and not line.strip()):
            break
        key, _, value = line.decode("latin-1").partition("=" if suffix == ".mha" else ":")
        entries[key.strip().lower()] = value.strip()
    return entries


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """A displacement field of an image, with the header to write fields on the same grid.

    Attributes
    ----------
    field : (h, w, 2) or (d, h, w, 3) float64
        Displacements along the grid's axes in the unit of ``spacing``: to the right, down, and along z for volumes, of
        the pixel in slice z, row y and column x.
    spacing : (2,) or (3,) float64
        Distance between pixels, along x, along y, and along z.
    axes : (c, 2) or (3, 3) float64
        Directions of the grid's axes in the space of the file's components, as columns. The identity for ``.npy``.
    source : str
        The file that was read.
    """

    field: FloatArray
    spacing: FloatArray
    axes: FloatArray
    source: str
    _components: FloatArray = dataclasses.field(repr=False)  # (…, c): as in the file
    _encode: Callable[[FloatArray, str], bytes] = dataclasses.field(repr=False)  # Bytes of a file with other components
    _suffixes: tuple[str, ...] = dataclasses.field(repr=False)  # Suffixes that can be written

    def check_output(self, path: str | os.PathLike[str]) -> None:
        """Raise a MeshFileError if a path has the suffix of another kind of file."""
        if field_suffix(path) not in self._suffixes:
            raise MeshFileError(
                path, f"a field of {self.source} cannot be written there", remedy=f"use {', '.join(self._suffixes)}"
            )

    def write(self, path: str | os.PathLike[str], field: ArrayLike) -> None:
        """Write another field of the same shape on the same grid, in double precision.

        The header is that of the file that was read. Displacements that are equal to those read are written bitwise as
        they were. MeshFileError as `check_output`; OutputError if the file cannot be written.
        """
        self.check_output(path)
        new = np.asarray(field, dtype=np.float64)
        if new.shape != self.field.shape:
            raise ValueError(f"field must have shape {self.field.shape}, not {new.shape}")
        same = (new == self.field).all(axis=-1, keepdims=True)
        data = self._encode(np.where(same, self._components, new @ self.axes.T), field_suffix(path))
        write_whole(path, data)


def field_suffix(path: str | os.PathLike[str]) -> str:
    """Return the suffix of a displacement field in lower case; MeshFileError if it is none of `FIELD_SUFFIXES`."""
    check_path("path", path)
    name = Path(path).name.lower()
    for suffix in FIELD_SUFFIXES:
        if name.endswith(suffix):
            return suffix
    raise MeshFileError(
        path, "is not a displacement field of a supported format", remedy=f"supported: {', '.join(FIELD_SUFFIXES)}"
    )


def read_field(path: str | os.PathLike[str]) -> DisplacementField:
    """Read a displacement field of an image in two or three dimensions.

    Parameters
    ----------
    path : str or path-like
        ``.npy`` of shape (height, width, 2) or (depth, height, width, 3); NIfTI (``.nii``, ``.nii.gz``) of shape
        (width, height, 1, 1, 2) or (width, height, depth, 1, 3), also without the axes of length one; ``.mha`` or
        ``.nrrd`` of vectors. A field of one slice may have a third component, which must be zero, or all vectors lie in
        the plane of the image.

    Returns
    -------
    DisplacementField

    Raises
    ------
    MeshFileError
        If the file is not valid, has another shape, has axes that are not perpendicular, or moves pixels out of the
        plane.
    ImportError
        If nibabel or SimpleITK is needed and not installed.
    """
    suffix = field_suffix(path)
    if suffix == ".npy":
        return _read_npy(path)
    return _read_nifti(path) if suffix in NIFTI else _read_itk(path)


def _read_npy(path: str | os.PathLike[str]) -> DisplacementField:
    with report_damage(path, "is not an array of numbers in NumPy's format .npy: "):
        array = read_npy(path)

    def encode(components: FloatArray, suffix: str) -> bytes:
        from io import BytesIO

        np.save(file := BytesIO(), components)
        return file.getvalue()

    axes = 3 if array.ndim == 4 else 2
    return DisplacementField(array, np.ones(axes), np.eye(axes), os.fspath(path), array, encode, (".npy",))


def _read_nifti(path: str | os.PathLike[str]) -> DisplacementField:
    with explain_missing("NIfTI files need nibabel", "nibabel"):
        import nibabel
    read_bytes(path)  # Raises an error that names what is wrong with the path.
    # Damaged files cause errors of many types.
    with report_damage(path, "is not valid NIfTI: ", Exception):
        image: Any = nibabel.load(path)
        check_size(8 * prod(image.shape), "its header announces")
        data = np.asarray(image.dataobj)
        affine = np.asarray(image.affine, dtype=np.float64)
        intent = int(image.header["intent_code"])
    if data.dtype.kind not in "iuf":
        raise MeshFileError(path, f"has values of type {data.dtype}, but displacements are real numbers")
    data = data.astype(np.float64)
    volume = data.ndim > 3 and data.shape[2] > 1
    count = data.shape[-1]
    if data.ndim < 3 or count not in ((3,) if volume else (2, 3)) or any(n != 1 for n in data.shape[2 + volume : -1]):
        raise MeshFileError(
            path,
            f"has shape {data.shape}, but a field has (width, height, 1, 1, 2 or 3) or, on a volume, "
            "(width, height, depth, 1, 3)",
        )
    # NIfTI's affine refers to RAS.
    columns = affine[:3, : 2 + volume] * (1 if intent == _DISPVECT else np.array([[-1], [-1], [1]]))
    if count == 2 and np.abs(columns[2]).max() > _SKEW * np.abs(columns).max():
        raise MeshFileError(path, "has two components, but its plane is not that of the first two axes of space")

    def encode(components: FloatArray, suffix: str) -> bytes:
        values = np.moveaxis(components.T, 0, -1).reshape(data.shape)
        made = type(image)(values, image.affine, image.header)
        made.set_data_dtype(np.float64)
        return encode_by(f"field{suffix}", lambda part: nibabel.save(made, part))

    components = np.moveaxis(data.reshape(*data.shape[: 2 + volume], count).T, 0, -1)
    return _in_grid_axes(path, components, columns[:count], encode, NIFTI)


def _read_itk(path: str | os.PathLike[str]) -> DisplacementField:
    with explain_missing("ITK's files need SimpleITK", "SimpleITK"):
        import SimpleITK
    try:
        with report_damage(path):
            check_header(read_bytes(path), field_suffix(path))
            image = SimpleITK.ReadImage(os.fspath(path))
    except RuntimeError as error:
        raise MeshFileError(path, f"SimpleITK cannot read it: {str(error).splitlines()[-1]}") from error
    n, count = image.GetDimension(), image.GetNumberOfComponentsPerPixel()
    if count != n or n not in (2, 3):
        raise MeshFileError(
            path,
            f"has size {image.GetSize()} and {count} components, but a field has one component for each of 2 or 3 axes",
        )
    axes = 3 if image.GetSize()[2:] > (1,) else 2
    array = SimpleITK.GetArrayFromImage(image).astype(np.float64)
    columns = np.reshape(image.GetDirection(), (n, n))[:, :axes] * image.GetSpacing()[:axes]

    def encode(components: FloatArray, suffix: str) -> bytes:
        made = SimpleITK.GetImageFromArray(np.ascontiguousarray(components).reshape(array.shape), isVector=True)
        made.CopyInformation(image)
        for key in image.GetMetaDataKeys():
            made.SetMetaData(key, image.GetMetaData(key))
        return encode_by(f"field{suffix}", lambda part: SimpleITK.WriteImage(made, part))

    return _in_grid_axes(path, array.reshape(*array.shape[-1 - axes : -1], count), columns, encode, ITK)


def _in_grid_axes(
    path: str | os.PathLike[str],
    components: FloatArray,
    columns: FloatArray,
    encode: Callable[[FloatArray, str], bytes],
    suffixes: tuple[str, ...],
) -> DisplacementField:
    """Return the field along the axes of the grid, whose steps in space are ``columns`` (c, k)."""
    spacing = np.linalg.norm(columns, axis=0)
    if not (np.isfinite(spacing).all() and spacing.all()):
        raise MeshFileError(path, "has a spacing of zero or that is not finite")
    axes = columns / spacing
    if np.abs(axes.T @ axes - np.eye(axes.shape[1])).max() > _SKEW:
        raise MeshFileError(path, "has axes that are not perpendicular", remedy="resample it on a regular grid")
    # Exactly orthonormal, so that the way back is the transpose.
    left, _, right = np.linalg.svd(axes, full_matrices=False)
    axes = left @ right
    along = components @ axes
    finite = np.isfinite(components).all(axis=-1)
    out = np.abs(along[finite] @ axes.T - components[finite]).max(initial=0.0)
    if out > _OUT_OF_PLANE * np.abs(components[finite]).max(initial=0.0):
        raise MeshFileError(path, f"moves pixels out of the plane of the image, by up to {out:.3g}")
    return DisplacementField(along, spacing, axes, os.fspath(path), components, encode, suffixes)
