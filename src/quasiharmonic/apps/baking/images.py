"""Images as arrays: decode, sample and encode them, and fill the texels beside charts."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.models.appearance import ImageUse, Wrap, to_linear
from quasiharmonic.io.models.textures import Texture, texture_of
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
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
    for row, column, weight in (
        (top, left, (1 - x) * (1 - y)),
        (top, right, x * (1 - y)),
        (bottom, left, (1 - x) * y),
        (bottom, right, x * y),
    ):
        pixel = flat[row * width + column]
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
    if jpeg:
        Image.fromarray(pixels).save(file, "JPEG", quality=95, subsampling=0)
    else:
        Image.fromarray(pixels).save(file, "PNG", compress_level=4)
    texture = texture_of(file.getvalue())
    assert texture is not None
    return texture


def find_sources(covered: BoolArray, padding: int) -> tuple[IntArray, IntArray]:
    """Return the texels that are not covered (h, w), within a distance, and the covered texel nearest to each.

    Texels are numbers in the flattened image. The fronts of covered texels grow by one texel at a time, to the eight
    neighbours, and carry their sources along.
    """
    height, width = covered.shape
    source = np.where(covered.ravel(), np.arange(covered.size, dtype=np.int32), -1)
    front = np.flatnonzero(_touches(covered))
    found = [np.empty(0, dtype=np.int64)]
    for _ in range(padding):
        row, column = np.divmod(front, width)
        near, origin = [], []
        for down, along in ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)):
            inside = (row + down >= 0) & (row + down < height) & (column + along >= 0) & (column + along < width)
            texel = front[inside] + down * width + along
            free = source[texel] < 0
            near.append(texel[free])
            origin.append(source[front[inside][free]])
        texel, at = np.concatenate(near), np.concatenate(origin).astype(np.int64)
        row_apart, apart = np.divmod(texel, width)[0] - at // width, texel % width - at % width
        # The nearest source of each texel comes first.
        order = np.lexsort((at, row_apart**2 + apart**2, texel))
        texel, at = texel[order], at[order]
        first = np.diff(texel, prepend=-1) != 0
        front = texel[first]
        source[front] = at[first]
        found.append(front)
    texels = np.concatenate(found)
    return texels, source[texels].astype(np.int64)


def _touches(covered: BoolArray) -> BoolArray:
    """Return which covered texels have a neighbour that is not covered."""
    free = np.pad(~covered, 1)
    height, width = covered.shape
    some = np.zeros_like(covered)
    for i in range(3):
        for j in range(3):
            some |= free[i : i + height, j : j + width]
    return some & covered
