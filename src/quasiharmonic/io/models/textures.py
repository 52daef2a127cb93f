"""Textures for mapped surfaces: an image file or a checkerboard.

The texture covers the unit square, v upwards, and repeats beyond it, as in every viewer.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from io import BytesIO
from typing import NamedTuple

import numpy as np

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.untrusted import read_bytes
from quasiharmonic.util.hints import explain_missing

_IMAGE_TYPES = {b"\x89PNG\r\n\x1a\n": ("image/png", ".png"), b"\xff\xd8\xff": ("image/jpeg", ".jpg")}


class Checkerboard(NamedTuple):
    """Colours and sizes of the checkerboard."""

    # Colours, 8 bits per channel.
    light: tuple[int, ...] = (237, 237, 230)
    dark: tuple[int, ...] = (41, 97, 191)
    # Squares along a side.
    squares: int = 16
    # Pixels along the side of a square.
    pixels: int = 32


_BOARD = Checkerboard()


@dataclass(frozen=True)
class Texture:
    """An image, as the bytes of its file.

    Attributes
    ----------
    data : bytes
    media_type, suffix : str
        The format: ``image/png`` and ``.png``, or ``image/jpeg`` and ``.jpg``.
    """

    data: bytes
    media_type: str
    suffix: str


@dataclass(frozen=True)
class MaterialTextures(Texture):
    """The images of a material in glTF's metallic-roughness model; the bytes are those of the base colour.

    Formats without such materials show the base colour alone. The images contain the factors of the material and the
    colours of vertices.

    Attributes
    ----------
    metallic_roughness, normal, emission : Texture or None
        Further images. Occlusion is the red channel of the first one.
    occlusion : bool
        Whether there is any.
    metallic, roughness : float
        Factors.
    emission_factor : tuple of 3 float
        Emitted light, which multiplies the image if there is one; values above 1 are allowed.
    alpha_mode : str or None
        ``"OPAQUE"``, ``"MASK"`` or ``"BLEND"``. With None, materials that the file already has keep their mode, their
        threshold, and whether they are shown on both sides.
    alpha_cutoff : float
    double_sided : bool
    """

    metallic_roughness: Texture | None = None
    normal: Texture | None = None
    emission: Texture | None = None
    occlusion: bool = False
    metallic: float = 0.0
    roughness: float = 1.0
    emission_factor: tuple[float, ...] = (0.0, 0.0, 0.0)
    alpha_mode: str | None = None
    alpha_cutoff: float = 0.5
    double_sided: bool = True


def read_texture(path: str | os.PathLike[str]) -> Texture:
    """Read a PNG or JPEG image.

    Raises
    ------
    MeshFileError
        If the file does not exist, or is neither PNG nor JPEG.
    """
    if (texture := texture_of(read_bytes(path))) is not None:
        return texture
    raise MeshFileError(path, "is not a PNG or JPEG image", remedy="save it as PNG or JPEG")


def texture_of(data: bytes) -> Texture | None:
    """Return the image of a file's bytes; None if it is neither PNG nor JPEG."""
    return next((Texture(data, *kind) for start, kind in _IMAGE_TYPES.items() if data.startswith(start)), None)


def checkerboard() -> Texture:
    """Return a checkerboard texture that repeats without seams."""
    with explain_missing("pictures need Pillow", "pillow"):
        from PIL import Image

    dark = np.indices((_BOARD.squares, _BOARD.squares)).sum(axis=0) % 2 == 1
    squares = np.where(dark[..., None], _BOARD.dark, _BOARD.light).astype(np.uint8)
    pixels = squares.repeat(_BOARD.pixels, axis=0).repeat(_BOARD.pixels, axis=1)
    Image.fromarray(pixels).save(file := BytesIO(), "PNG", optimize=True)
    return Texture(file.getvalue(), "image/png", ".png")
