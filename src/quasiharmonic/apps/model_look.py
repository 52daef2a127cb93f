"""The look of a model: its images as arrays, and what they show at points of its surface, in linear values.

The tangent spaces of normal maps follow the rules of MikkTSpace: smooth tangents at corners, interpolated in triangles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import BytesIO
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter

from quasiharmonic.io.errors import printable_path
from quasiharmonic.io.models.appearance import Appearance, ImageUse, NamedImage, Role, SurfaceMaterial, Wrap, to_linear
from quasiharmonic.io.models.meshdata import MeshData, normals_of
from quasiharmonic.io.models.textures import Texture, texture_of
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, first_equal
from quasiharmonic.util.hints import explain_missing

Bytes = NDArray[np.uint8]
#: Longest side of an image that is read, in pixels.
MAX_SIDE = 16384
_LINEAR = to_linear(np.arange(256) / 255).astype(np.float32)
_PLAIN = (np.arange(256) / 255).astype(np.float32)
# 8-bit sRGB values of linear values in steps of 1/65535. The steps are smaller than half of any step of sRGB.
_steps = np.arange(65536) / 65535
_ENCODED = np.rint(
    255 * np.where(_steps <= 0.0031308, 12.92 * _steps, 1.055 * np.maximum(_steps, 1e-9) ** (1 / 2.4) - 0.055)
).astype(np.uint8)
# Roles whose images are sRGB.
_SRGB = "colour", "emission"


def decode(data: bytes | None) -> Bytes:
    """Return the pixels (h, w, 4) of a PNG or JPEG file, first row on top; ValueError if that is not possible."""
    if data is None:
        raise ValueError("is missing")
    with explain_missing("images need Pillow", "pillow"):
        from PIL.JpegImagePlugin import JpegImageFile
        from PIL.PngImagePlugin import PngImageFile
    found = texture_of(data)
    if found is None:
        raise ValueError("is neither PNG nor JPEG")
    kind: Any = PngImageFile if found.suffix == ".png" else JpegImageFile
    try:
        # The classes themselves have no bound on the number of pixels.
        with kind(BytesIO(data)) as image:
            if max(image.size) > MAX_SIDE:
                raise ValueError(f"has {image.width} by {image.height} pixels, more than {MAX_SIDE} along a side")
            if image.mode.startswith("I"):
                raise ValueError("has 16 bits: save it with 8 bits")
            pixels: Bytes = np.asarray(image.convert("RGBA"))
            return pixels
    except ValueError:
        raise
    except Exception as error:  # Damaged images cause many kinds of errors.
        raise ValueError(f"is damaged: {error}") from error


def sample(pixels: Bytes, use: ImageUse, uv: FloatArray, *, srgb: bool) -> NDArray[np.floating]:
    """Return linear values (k, 4) float32 of an image at texture coordinates (k, 2), v downwards, bilinear.

    ``srgb`` tells whether the first three channels are sRGB. Values are NaN where a coordinate is not finite.
    """
    height, width = pixels.shape[:2]
    flat = pixels.reshape(-1, 4)
    at = uv @ use.transform[:, :2].T + use.transform[:, 2]
    missing = ~np.isfinite(at).all(axis=1)
    at[missing] = 0
    (left, right, x), (top, bottom, y) = (
        _neighbours(at[:, i], side, use.wrap[i]) for i, side in ((0, width), (1, height))
    )
    tables = [_LINEAR if srgb else _PLAIN] * 3 + [_PLAIN]
    values: NDArray[np.floating] = np.zeros((len(uv), 4), dtype=np.float32)
    for (row, down), (column, along) in product(((top, 1 - y), (bottom, y)), ((left, 1 - x), (right, x))):
        pixel, weight = flat[row * width + column], along * down
        for channel, table in enumerate(tables):
            values[:, channel] += weight * table[pixel[:, channel]]
    values[missing] = np.nan
    return values


def _neighbours(t: FloatArray, side: int, wrap: Wrap) -> tuple[IntArray, IntArray, NDArray[np.float32]]:
    """Return the pixels on both sides of a coordinate along an image, and the weight of the second one."""
    # Whole periods are removed first, so that large coordinates fit into integers.
    t = np.clip(t, -1.0, 2.0) if wrap == "clamp" else t - 2 * np.floor(t / 2)
    at = t * side - 0.5
    first = np.floor(at).astype(np.int64)
    pair = [first, first + 1]
    if wrap == "clamp":
        pair = [np.clip(one, 0, side - 1) for one in pair]
    elif wrap == "repeat":
        pair = [one % side for one in pair]
    else:
        pair = [np.minimum(one % (2 * side), 2 * side - 1 - one % (2 * side)) for one in pair]
    return pair[0], pair[1], (at - first).astype(np.float32)


def to_bytes(values: FloatArray, *, srgb: bool) -> Bytes:
    """Return linear values as bytes; those of the first three channels as sRGB, if ``srgb`` is true."""
    clipped = np.clip(values, 0, 1)
    if not srgb:
        return np.rint(255 * clipped).astype(np.uint8)
    found = np.empty(values.shape, dtype=np.uint8)
    found[:, :3] = _ENCODED[np.rint(65535 * clipped[:, :3]).astype(np.uint16)]
    found[:, 3:] = np.rint(255 * clipped[:, 3:])
    return found


def encode(pixels: Bytes, *, jpeg: bool) -> Texture:
    """Return pixels (h, w, 3) or (h, w, 4) as a file, PNG or JPEG."""
    with explain_missing("images need Pillow", "pillow"):
        from PIL import Image
    file = BytesIO()
    kind, options = ("JPEG", {"quality": 95, "subsampling": 0}) if jpeg else ("PNG", {"compress_level": 4})
    Image.fromarray(pixels).save(file, kind, **options)
    texture = texture_of(file.getvalue())
    assert texture is not None
    return texture


def find_sources(covered: BoolArray, padding: int) -> tuple[IntArray, IntArray]:
    """Return the texels that are not covered (h, w), within a distance, and the covered texel nearest to each.

    Texels are numbers in the flattened image, and distances along rows and columns.
    """
    near = maximum_filter(covered, 2 * padding + 1, mode="constant") & ~covered
    nearest = distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return np.flatnonzero(near), np.ravel_multi_index(tuple(nearest[:, near]), covered.shape)


class TangentFrames(NamedTuple):
    """Frames at the corners of triangles.

    Attributes
    ----------
    normal, tangent : (f, 3, 3) float64
        Unit vectors.
    side : (f,) float64
        1 if the bitangent is normal × tangent, -1 if it is opposite to it.
    """

    normal: FloatArray
    tangent: FloatArray
    side: FloatArray

    def at(self, triangle: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return tangent, bitangent and normal (k, 3, 3), as rows, at points of triangles, not normalised."""
        normal = np.einsum("kc,kcd->kd", barycentric, self.normal[triangle])
        tangent = np.einsum("kc,kcd->kd", barycentric, self.tangent[triangle])
        bitangent = np.cross(normal, tangent) * self.side[triangle, None]
        return np.stack([tangent, bitangent, normal], axis=1)


def corner_normals(mesh: MeshData) -> FloatArray:
    """Return unit normals (f, 3, 3) at the corners: those of the file, or of the triangles where it has none."""
    a, b, c = mesh.V[mesh.F].swapaxes(0, 1)
    flat = np.repeat(_normalise(np.cross(b - a, c - a))[:, None], 3, axis=1)
    given = normals_of(mesh)
    if given is None or mesh.FN is None:
        return flat
    own = _normalise(given[mesh.FN])
    return np.where((own != 0).any(axis=2, keepdims=True), own, flat)


def tangent_frames(mesh: MeshData, uv: FloatArray) -> TangentFrames:
    """Return the frames of texture coordinates (f, 3, 2), v upwards; NaN counts as 0.

    The tangents of triangles are projected to the normals, and averaged by angle among corners of one vertex that have
    one normal, one pair of texture coordinates and one side.
    """
    normal = corner_normals(mesh)
    corners, uv = mesh.V[mesh.F], np.nan_to_num(uv)
    (du1, dv1), (du2, dv2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = du1 * dv2 - dv1 * du2
    side = np.where(area < 0, -1.0, 1.0)
    along = (first * dv2[:, None] - second * dv1[:, None]) * side[:, None]
    # Without texture coordinates, any tangent serves.
    along[area == 0] = first[area == 0]
    tangent = _reject(along[:, None], normal)
    angle: FloatArray = np.empty(mesh.F.shape)
    for i in range(3):
        one, other = (_reject(corners[:, (i + j) % 3] - corners[:, i], normal[:, i]) for j in (1, 2))
        angle[:, i] = np.arccos(np.clip((one * other).sum(axis=1), -1, 1))
    keys = np.concatenate([uv, normal, np.repeat(side[:, None, None], 3, axis=1)], axis=2).reshape(mesh.F.size, -1)
    keys = np.column_stack([mesh.F.ravel(), (keys + 0.0).view(np.int64)])
    group = first_equal(keys)
    weighted = (tangent * angle[:, :, None]).reshape(-1, 3)
    total: FloatArray = np.stack([np.bincount(group, weighted[:, i]) for i in range(3)], axis=1)
    smooth = _reject(total[group].reshape(tangent.shape), normal)
    return TangentFrames(normal, np.where((smooth != 0).any(axis=2, keepdims=True), smooth, tangent), side)


def _reject(vectors: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the unit vectors of the parts of vectors (..., 3) that are orthogonal to unit normals."""
    return _normalise(vectors - (vectors * normal).sum(axis=-1, keepdims=True) * normal)


def _normalise(vectors: FloatArray) -> FloatArray:
    """Return unit vectors (..., 3); zero for zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


class SurfaceLook:
    """Evaluates an `Appearance`; ``problems`` lists what it cannot show.

    Points are triangles (k,) and barycentric coordinates (k, 3).
    """

    def __init__(self, appearance: Appearance) -> None:
        self.materials = appearance.materials
        self.problems = list(appearance.problems)
        self._appearance = appearance
        # Images in the order of their first use; each is decoded once.
        self._pixels: dict[NamedImage, Bytes | None] = {}
        for use in (use for material in self.materials for use in material.textures.values()):
            if use.image not in self._pixels:
                self._pixels[use.image] = self._decode(use.image)
            if use.channel not in appearance.coordinates:
                name = printable_path(use.image.name)
                self.problems.append(f"texture {name} needs texture coordinates {use.channel}, which are missing")

    def _decode(self, image: NamedImage) -> Bytes | None:
        try:
            return decode(image.data)
        except ValueError as error:
            self.problems.append(f"texture {printable_path(image.name)} {error}")
            return None

    def has(self, *roles: Role) -> bool:
        """Whether a material has an image with one of these roles that can be shown."""
        return any(self._use(material, role) is not None for material in self.materials for role in roles)

    def _use(self, material: SurfaceMaterial, role: Role) -> ImageUse | None:
        use = material.textures.get(role)
        if use is None or self._pixels[use.image] is None or use.channel not in self._appearance.coordinates:
            return None
        return use

    def colours(self, triangle: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return base colours and opacity (k, 4)."""
        out = self._product("colour", [material.colour for material in self.materials], triangle, barycentric)
        if (corners := self._appearance.colours) is not None:
            out *= np.einsum("kc,kcd->kd", barycentric, corners[triangle])
        opaque = np.array([material.alpha_mode == "OPAQUE" for material in self.materials])
        out[opaque[self._appearance.of_triangle[triangle]], 3] = 1
        return out

    def metallic_roughness(self, triangle: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return occlusion, roughness and metallic values (k, 3)."""
        factors = [(1.0, material.roughness, material.metallic, 1.0) for material in self.materials]
        out = self._product("metallic_roughness", factors, triangle, barycentric)[:, :3]
        out[:, 0] = 1
        for rows, material, use in self._parts("occlusion", triangle):
            if use is not None:
                shown = self._sample(use, "occlusion", triangle[rows], barycentric[rows], 1.0)[:, 0]
                out[rows, 0] = 1 + material.occlusion_strength * (shown - 1)
        return out

    def emission(self, triangle: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return emitted light (k, 3)."""
        factors = [(*material.emission, 1.0) for material in self.materials]
        return self._product("emission", factors, triangle, barycentric)[:, :3]

    def normals(self, triangle: IntArray, barycentric: FloatArray, frames: TangentFrames) -> FloatArray:
        """Return normals (k, 3) in space, not of unit length."""
        local = np.zeros((len(triangle), 3))
        local[:, 2] = 1
        for rows, material, use in self._parts("normal", triangle):
            if use is not None:
                shown = self._sample(use, "normal", triangle[rows], barycentric[rows], (0.5, 0.5, 1.0, 1.0))[:, :3]
                local[rows] = (2 * shown - 1) * [material.normal_scale, material.normal_scale, 1]
        return np.einsum("kc,kcd->kd", local, frames.at(triangle, barycentric))

    def normal_coordinates(self) -> FloatArray:
        """Return the texture coordinates (f, 3, 2) of the normal maps, v downwards; NaN where there is none."""
        out = np.full((len(self._appearance.of_triangle), 3, 2), np.nan)
        for rows, _, use in self._parts("normal", np.arange(len(out))):
            if use is not None:
                out[rows] = self._appearance.coordinates[use.channel][rows] @ use.transform[:, :2].T
        return out

    def _product(
        self, role: Role, factors: Sequence[tuple[float, ...]], triangle: IntArray, barycentric: FloatArray
    ) -> FloatArray:
        """Return the factors (k, 4) of the materials, times their images."""
        out = np.array(factors)[self._appearance.of_triangle[triangle]]
        for rows, _, use in self._parts(role, triangle):
            if use is not None:
                out[rows] *= self._sample(use, role, triangle[rows], barycentric[rows], 1.0)
        return out

    def _parts(
        self, role: Role, triangle: IntArray
    ) -> Iterator[tuple[IntArray | slice, SurfaceMaterial, ImageUse | None]]:
        """Yield rows of the points of each material, the material, and its image with a role."""
        if len(self.materials) == 1:
            yield slice(None), self.materials[0], self._use(self.materials[0], role)
            return
        of_point = self._appearance.of_triangle[triangle]
        for k, material in enumerate(self.materials):
            if (use := self._use(material, role)) is not None:
                yield np.flatnonzero(of_point == k), material, use

    def _sample(
        self, use: ImageUse, role: Role, triangle: IntArray, barycentric: FloatArray, missing: float | tuple[float, ...]
    ) -> FloatArray:
        """Return the values (k, 4) of an image at points; ``missing`` where there are no texture coordinates."""
        corners, pixels = self._appearance.coordinates[use.channel], self._pixels[use.image]
        assert pixels is not None
        uv = sum(barycentric[:, i, None] * corners[triangle, i] for i in range(3))
        values: FloatArray = sample(pixels, use, np.asarray(uv), srgb=role in _SRGB).astype(np.float64)
        values[np.isnan(values[:, 0])] = missing
        return values
