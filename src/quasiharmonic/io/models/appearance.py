"""How a model looks: its materials, their images and texture coordinates, and the colours of its vertices.

Values are linear, as in glTF. Only the bytes of images are read here; nothing is decoded. Materials of OBJ files are
lines of the mesh and libraries (.mtl) that these lines name.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.errors import printable_path
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.models.textures import MaterialTextures, Texture
from quasiharmonic.util.arrays import FloatArray, IntArray

#: What a texture of a material has: the names of its entries in `SurfaceMaterial.textures`.
Role = Literal["colour", "metallic_roughness", "occlusion", "emission", "normal"]
#: What a texture shows beyond the unit square.
Wrap = Literal["repeat", "mirror", "clamp"]

_NAME = "map"


@dataclass(frozen=True)
class NamedImage:
    """The bytes of an image file, None if it cannot be read, and its name for messages."""

    name: str
    data: bytes | None


@dataclass(frozen=True, eq=False)
class ImageUse:
    """An image on a surface.

    Attributes
    ----------
    image : NamedImage
    channel : int
        Which texture coordinates it has.
    wrap : (Wrap, Wrap)
        Horizontally and vertically.
    transform : (2, 3) float64
        Matrix and offset that are applied to the texture coordinates, with v downwards.
    """

    image: NamedImage
    channel: int = 0
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    transform: FloatArray = field(default_factory=lambda: np.eye(2, 3))


@dataclass(frozen=True, eq=False)
class SurfaceMaterial:
    """A material of glTF's metallic-roughness model. Its values are multiplied with those of its textures."""

    name: str = ""
    colour: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    metallic: float = 0.0
    roughness: float = 1.0
    emission: tuple[float, ...] = (0.0, 0.0, 0.0)
    normal_scale: float = 1.0
    occlusion_strength: float = 1.0
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = True
    textures: Mapping[Role, ImageUse] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Appearance:
    """How the surface of a mesh looks.

    Attributes
    ----------
    materials : tuple of SurfaceMaterial
        Those that triangles use.
    of_triangle : (f,) int64
        The material of each triangle, a position in ``materials``.
    coordinates : mapping from int to (f, 3, 2) float64
        Texture coordinates of the corners, v downwards, by channel; NaN where there are none.
    colours : (f, 3, 4) float64 or None
        Colours of the corners, linear and with opacity, which multiply those of the material.
    problems : tuple of str
        Parts of materials that are damaged or not supported.
    """

    materials: tuple[SurfaceMaterial, ...]
    of_triangle: IntArray
    coordinates: Mapping[int, FloatArray]
    colours: FloatArray | None = None
    problems: tuple[str, ...] = ()


def to_linear(values: FloatArray) -> FloatArray:
    """Return sRGB values from 0 to 1 as linear ones."""
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0.04045) + 0.055) / 1.055) ** 2.4)


def plain_appearance(
    mesh: MeshData, materials: Mapping[str, SurfaceMaterial], colours: FloatArray | None, problems: tuple[str, ...] = ()
) -> Appearance:
    """Return the appearance of a mesh with materials by name, and sRGB colours (n, 3) or (n, 4) of its vertices."""
    label, names = label_materials(mesh)
    used, of_triangle = np.unique(label, return_inverse=True)
    corners = None
    if colours is not None:
        opaque = np.ones((len(colours), 1)) if colours.shape[1] == 3 else colours[:, 3:]
        corners = np.concatenate([to_linear(colours[:, :3]), opaque], axis=1)[mesh.F]
    found = [materials.get(names[k] or "", SurfaceMaterial()) for k in used.tolist()]
    if any(_names_library(line) for line in mesh.statements.split(b"\n")):
        unknown = dict.fromkeys(name for k in used.tolist() if (name := names[k]) and name not in materials)
        where = "is in no material library in the folder of the file"
        problems += tuple(f"material {printable_path(name)} {where}" for name in unknown)
    if corners is not None and (corners[..., 3] < 1).any():
        found = [replace(one, alpha_mode="BLEND") for one in found]
    return Appearance(
        tuple(found),
        of_triangle.reshape(-1),
        {0: mesh.corner_uv * [1, -1] + [0, 1]},
        corners,
        problems,
    )


def with_libraries(path: str | os.PathLike[str], mesh: MeshData) -> MeshData:
    """Return the mesh with its library names changed to paths relative to the folder of ``path``.

    A name is unchanged if the library also exists beside the new file, or does not exist beside the source.
    """
    here, there = Path(mesh.source).parent, Path(path).parent

    def rename(name: str) -> str:
        if (there / name).is_file() or not (here / name).is_file():
            return name
        try:
            return os.path.relpath(here / name, there).replace(os.sep, "/")
        except ValueError:  # The library is on another drive.
            return (here / name).resolve().as_posix()

    lines = mesh.statements.split(b"\n")
    for at, line in enumerate(lines):
        names = library_names(line, here, there)
        if (new := [rename(name) for name in names]) != names:
            # Among several names, those with blanks need quotes.
            quoted = (b'"' in line or (len(new) > 1 and " " in "".join(new))) and '"' not in "".join(new)
            lines[at] = os.fsencode("mtllib " + " ".join(f'"{name}"' if quoted else name for name in new))
    statements = b"\n".join(lines)
    return mesh if statements == mesh.statements else replace(mesh, statements=statements)


def library_names(line: bytes, *folders: Path) -> list[str]:
    """Return the names in an ``mtllib`` line: several names, or one with blanks if it is a file of one of the folders.

    Names with blanks may have quotes. The list is empty for other lines.
    """
    if not _names_library(line):
        return []
    name = os.fsdecode(b"".join(line.split(None, 1)[1:]).strip())
    if any((folder / name).is_file() for folder in folders):
        return [name]
    return [quoted or plain for quoted, plain in re.findall(r'"([^"]+)"|(\S+)', name)]


def companions(path: str | os.PathLike[str], texture: Texture) -> tuple[Path, Path]:
    """Return the paths of the library and of the image of an OBJ file with a texture."""
    path = Path(path)
    # In OBJ files a blank ends a name.
    stem = "_".join(path.stem.split()) + "-texture"
    return path.with_name(stem + ".mtl"), path.with_name(stem + texture.suffix)


def materials_lost(mesh: MeshData) -> list[str]:
    """Return descriptions of the materials that `write_material` drops: the file's own, and images besides colours."""
    uses = any(line.startswith(b"usemtl") for line in mesh.statements.split(b"\n"))
    lost = ["its own materials, which the image replaces"] if mesh.texture is not None and uses else []
    texture = mesh.texture
    if isinstance(texture, MaterialTextures) and (texture.metallic_roughness or texture.normal or texture.emission):
        lost.append("images besides the base colour")
    return lost


def write_material(path: str | os.PathLike[str], mesh: MeshData, *, durable: bool = True) -> MeshData:
    """Write the library and the image of an OBJ file with a texture; return the mesh with the new material instead of
    its own. ``durable`` is as in `write_whole`.
    """
    assert mesh.texture is not None
    library, picture = companions(path, mesh.texture)
    text = f"newmtl {_NAME}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture.name}\n"
    write_whole(picture, mesh.texture.data, durable=durable)
    write_whole(library, text.encode(), durable=durable)
    lines = mesh.statements.split(b"\n")[:-1]
    kept = [i for i, line in enumerate(lines) if not _names_library(line) and not line.startswith(b"usemtl")]
    head = sum(1 for i in kept if mesh.statement_faces[i] < 0)
    new = [lines[i] for i in kept]
    at = mesh.statement_faces[kept].tolist()
    new[head:head] = [f"mtllib {library.name}".encode(), f"usemtl {_NAME}".encode()]
    at[head:head] = [-1, 0]
    statements = b"".join(line + b"\n" for line in new)
    return replace(mesh, statements=statements, statement_faces=np.array(at, dtype=np.int64))


def label_materials(mesh: MeshData) -> tuple[IntArray, list[str | None]]:
    """Return a number for the material of each triangle, (f,), and the names of the materials; None for no material."""
    lines = mesh.statements.split(b"\n")[:-1]
    first = mesh.rings.first_triangle
    label = np.zeros(len(mesh.F), dtype=np.int64)
    names: list[str | None] = [None]
    for line, at in zip(lines, mesh.statement_faces.tolist(), strict=True):
        if line.startswith(b"usemtl"):
            names.append(line[6:].strip().decode("utf-8", "replace"))
            label[first[max(at, 0)] :] = len(names) - 1
    return label, names


def _names_library(line: bytes) -> bool:
    return line.split(None, 1)[:1] == [b"mtllib"]
