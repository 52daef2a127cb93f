"""How a model looks: its materials, their images and texture coordinates, and the colours of its vertices.

Values are linear, as in glTF. Only the bytes of images are read here; nothing is decoded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from quasiharmonic.io.models.materials import label_materials
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.util.arrays import FloatArray, IntArray

#: What a texture of a material has: the names of its entries in `SurfaceMaterial.textures`.
Role = Literal["colour", "metallic_roughness", "occlusion", "emission", "normal"]
#: What a texture shows beyond the unit square.
Wrap = Literal["repeat", "mirror", "clamp"]


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
    return Appearance(
        tuple(materials.get(names[k] or "", SurfaceMaterial()) for k in used.tolist()),
        of_triangle.reshape(-1),
        {0: mesh.corner_uv * [1, -1] + [0, 1]},
        corners,
        problems,
    )
