"""Textures for mapped surfaces: an image file or a checkerboard.

The texture covers the unit square, v upwards, and repeats beyond it, as in every viewer.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.textual import read_bytes

_KINDS = {b"\x89PNG\r\n\x1a\n": ("image/png", ".png"), b"\xff\xd8\xff": ("image/jpeg", ".jpg")}
_LIGHT, _DARK = (237, 237, 230), (41, 97, 191)
_SQUARES, _PIXELS = 16, 32


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


def read_texture(path: str | os.PathLike[str]) -> Texture:
    """Read a PNG or JPEG image.

    Raises
    ------
    MeshFileError
        If the file does not exist, or is neither PNG nor JPEG.
    """
    data = read_bytes(path)
    for start, kind in _KINDS.items():
        if data.startswith(start):
            return Texture(data, *kind)
    raise MeshFileError(path, "is not a PNG or JPEG image", remedy="save it as PNG or JPEG")


def checkerboard() -> Texture:
    """Return a checkerboard texture that repeats without seams."""
    dark = np.indices((_SQUARES, _SQUARES)).sum(axis=0) % 2 == 1
    pixels = np.where(dark[..., None], _DARK, _LIGHT).astype(np.uint8).repeat(_PIXELS, axis=0).repeat(_PIXELS, axis=1)
    side = _SQUARES * _PIXELS
    # Each line starts with a filter byte; 0 means unfiltered.
    lines = np.concatenate([np.zeros((side, 1), dtype=np.uint8), pixels.reshape(side, -1)], axis=1)
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    parts = (b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 9)), (b"IEND", b"")
    (start, kind), *_ = _KINDS.items()
    return Texture(start + b"".join(_chunk(*part) for part in parts), *kind)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
