"""The file formats: for each suffix, the functions that read and write it and what it can store.

A new format is a module of `formats` (surfaces) or `fem` (finite elements) and an entry of `FORMATS`. Functions, help
texts and error messages take the accepted suffixes from here. The module imports no reader, so that the command prints
its help without NumPy.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from quasiharmonic.io.errors import MeshFileError, check_path

if TYPE_CHECKING:
    from quasiharmonic.io.fem.mesh_parts import MeshParts
    from quasiharmonic.io.models.meshdata import MeshData
    from quasiharmonic.io.models.textures import Texture
    from quasiharmonic.util.arrays import FloatArray, IntArray

FilePath = str | os.PathLike[str]
#: Something that a format can do: the name of a field of `Format` that is set.
Feature = Literal["read", "write_map", "seams", "image", "channels", "single_file", "read_elements", "encode_values"]

# What files of a format without the feature cannot do, for error messages.
_FAULTS: dict[Feature, str] = {
    "read": "cannot be read as a surface",
    "write_map": "cannot be written",
    "seams": "cannot store seams",
    "image": "cannot store an image",
    "channels": "cannot store several texture coordinates of one corner",
    "single_file": "may refer to further files",
    "read_elements": "cannot be read as a mesh of finite elements",
    "encode_values": "cannot store values per triangle",
}


@dataclass(frozen=True, kw_only=True)
class Format:
    """A file format.

    Attributes
    ----------
    name : str
        Name in help texts.
    suffix : str
        Suffix of its files, in lower case, with the dot.
    pattern : str, optional
        Regular expression of further file names, in lower case. The suffixes of all formats precede all patterns, and
        the first pattern counts.
    read : callable, optional
        Reads the surface of a file, with its map if there is one.
    write_map : callable, optional
        Writes a mesh that has a map.
    read_written : callable, optional
        Reads a file that ``write_map`` wrote, with the mesh it wrote as second argument. Required if ``read`` needs
        further files.
    list_losses : callable, optional
        Returns descriptions of the data of a mesh that ``write_map`` drops. Required with ``write_map``.
    seams : bool
        Whether the file has texture coordinates, so that a vertex can have several.
    image : bool
        Whether the file can have a texture image.
    channels : bool
        Whether the file can have several texture coordinates for each corner.
    companions : callable, optional
        Returns the paths of further files that ``write_map`` writes for a texture.
    single_file : bool
        Whether a file contains all the data to read, and never refers to further files.
    requires : str, optional
        Module of the extra ``neuro`` that is required for reading and writing.
    read_elements : callable, optional
        Parses the bytes of a planar mesh of finite elements, or, if the second argument is True, of a mesh in space.
    encode_values : callable, optional
        Returns the bytes of a file with ``V, F, uv`` and columns of values per triangle.
    """

    name: str
    suffix: str
    pattern: str | None = None
    read: Callable[[FilePath], MeshData] | None = None
    write_map: Callable[[FilePath, MeshData], None] | None = None
    read_written: Callable[[FilePath, MeshData], MeshData] | None = None
    list_losses: Callable[[MeshData], list[str]] | None = None
    seams: bool = False
    image: bool = False
    channels: bool = False
    companions: Callable[[FilePath, Texture], tuple[Path, ...]] | None = None
    single_file: bool = True
    requires: str | None = None
    read_elements: Callable[..., MeshParts] | None = None
    encode_values: Callable[[FloatArray, IntArray, FloatArray, Mapping[str, FloatArray]], bytes] | None = None


def import_later(module: str, **names: str) -> dict[str, Any]:
    """Return functions by the field of `Format`, given their names in a module of this package.

    The module is imported when one of them is first called.
    """

    def later(name: str) -> Callable[..., Any]:
        return lambda *args: getattr(import_module(f"{__package__}.{module}"), name)(*args)

    return {field: later(name) for field, name in names.items()}


# Endings of files beside FreeSurfer's surfaces that are not surfaces, such as lh.aparc.annot, and of other files.
_NO_SURFACES = (
    "annot|ctab|label|mgh|mgz|nii|stats|bz2|gz|tar|tgz|xz|zip|zst|csv|html?|json|list|log|lst|md|npy|parquet|pdf|py|toml|"
    "tsv|txt|xml|ya?ml|bmp|exr|gif|hdr|jpe?g|png|svg|tiff?|webp|3mf|blend|dae|fbx|mtl|mp4|usd[acz]?|wrl|x3d"
)

#: All formats, in the order of help texts and messages.
FORMATS: tuple[Format, ...] = (
    Format(
        name="OBJ",
        suffix=".obj",
        seams=True,
        image=True,
        **import_later("formats.obj", read="read_obj", write_map="write_obj", list_losses="not_in_obj"),
        **import_later("models.appearance", companions="companions"),
    ),
    Format(
        name="OFF",
        suffix=".off",
        list_losses=lambda mesh: ["the surface: only the map is written"],
        **import_later("formats.off", read="read_off", write_map="write_off_map"),
    ),
    Format(
        name="PLY",
        suffix=".ply",
        seams=True,
        channels=True,
        **import_later("formats.ply", read="read_ply", write_map="write_ply", list_losses="not_in_ply"),
        **import_later("formats.per_triangle", encode_values="encode_ply"),
    ),
    *(
        Format(
            name=name,
            suffix=suffix,
            seams=True,
            image=True,
            channels=True,
            single_file=suffix == ".glb",
            **import_later("formats.gltf.reader", read="read_gltf"),
            **import_later("formats.gltf.writer", write_map="write_gltf", list_losses="not_in_gltf"),
        )
        for name, suffix in (("GLB", ".glb"), ("glTF", ".gltf"))
    ),
    Format(name="STL", suffix=".stl", **import_later("formats.stl", read="read_stl")),
    Format(
        name="GIFTI",
        suffix=".gii",
        pattern=r".*\.gii\.gz",
        requires="nibabel",
        **import_later("formats.neuro", read="read_gifti", write_map="write_gifti", list_losses="not_in_flat_surface"),
    ),
    Format(
        name="FreeSurfer patch",
        suffix=".patch.3d",
        pattern=rf".*\.patch(\.(?!({_NO_SURFACES})$)\w+)?",
        single_file=False,
        **import_later("formats.neuro", read="read_patch", write_map="write_patch", list_losses="not_in_patch"),
        **import_later("formats.neuro", read_written="read_written_patch"),
    ),
    Format(
        name="FreeSurfer surface",
        suffix=".surf",
        pattern=rf"[lr]h\.(?!(.*\.)?({_NO_SURFACES})$).+",
        requires="nibabel",
        **import_later("formats.neuro", read="read_freesurfer", write_map="write_freesurfer"),
        **import_later("formats.neuro", list_losses="not_in_flat_surface"),
    ),
    Format(name="Gmsh (version 2 or 4)", suffix=".msh", **import_later("fem.gmsh", read_elements="read_gmsh")),
    Format(name="legacy VTK", suffix=".vtk", **import_later("fem.legacy_vtk", read_elements="read_legacy_vtk")),
    Format(name="VTU", suffix=".vtu", **import_later("fem.vtu", read_elements="read_vtu")),
    Format(name="MFEM", suffix=".mesh", **import_later("fem.mfem", read_elements="read_mfem")),
    Format(name="CSV", suffix=".csv", **import_later("formats.per_triangle", encode_values="encode_csv")),
    Format(name="NPZ", suffix=".npz", **import_later("formats.per_triangle", encode_values="encode_npz")),
)


def find_format(path: FilePath, *needs: Feature) -> Format:
    """Return the format of a file by the suffix of its name.

    Parameters
    ----------
    path : str or path-like
        The file, which need not exist.
    *needs : str
        What the format must be able to do.

    Raises
    ------
    MeshFileError
        If the suffix is unknown, or the format lacks a feature. The message lists the suffixes of all formats that have
        the features.
    """
    check_path("path", path)
    suffix = Path(path).suffix.lower()
    form = format_of(path)
    lacking = [need for need in needs if form is None or not getattr(form, need)]
    if form is None or lacking:
        fault = f"{suffix} files {_FAULTS[lacking[0]]}" if suffix else "has no suffix, so its format is unknown"
        if os.path.isdir(path):
            fault = "is a folder, not a file"
        elif not suffix and "read" in needs and not os.path.exists(path):
            fault += ", and there is no such file or folder"
        raise MeshFileError(path, fault, remedy=f"supported: {', '.join(suffixes(*needs))}")
    return form


def find_function(path: FilePath, name: Feature) -> Callable[..., Any]:
    """Return a function of the format of a file, such as that of the field ``read``; errors as `find_format`."""
    found: Callable[..., Any] = getattr(find_format(path, name), name)
    return found


def format_of(path: FilePath) -> Format | None:
    """Return the format of a file by its name, or None."""
    name = Path(path).name.lower()
    suffix = Path(name).suffix
    for form in FORMATS:
        if form.suffix == suffix:
            return form
    return next((form for form in FORMATS if form.pattern and re.fullmatch(form.pattern, name)), None)


def is_surface_name(path: FilePath) -> bool:
    """Return whether a surface can be read from a file of this name."""
    form = format_of(path)
    return form is not None and form.read is not None


def has_elements(path: FilePath, others: tuple[str, ...] = ()) -> bool:
    """Return whether a file is a finite-element mesh by its suffix.

    MeshFileError if it is neither that nor a surface; the message also lists the suffixes ``others``.
    """
    suffix, elements = Path(path).suffix.lower(), suffixes("read_elements")
    if suffix in elements or not suffix or is_surface_name(path) or os.path.isdir(path):
        return suffix in elements
    remedy = f"supported: {', '.join(suffixes('read') + elements + others)}"
    raise MeshFileError(path, f"{suffix} files cannot be read", remedy=remedy)


def suffixes(*needs: Feature) -> tuple[str, ...]:
    """Return the suffixes of all formats that have some features."""
    return tuple(form.suffix for form in _formats(needs))


def format_names(*needs: Feature) -> str:
    """Return the names of all formats that have some features, as a list for help texts: "OBJ, PLY or STL"."""
    *names, last = [form.name for form in _formats(needs)]
    return f"{', '.join(names)} or {last}" if names else last


def _formats(needs: tuple[Feature, ...]) -> list[Format]:
    return [form for form in FORMATS if all(getattr(form, need) for need in needs)]
