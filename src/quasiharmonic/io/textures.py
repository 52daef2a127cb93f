"""Pictures that maps put on surfaces: one's own, or a checkerboard.

A picture is the unit square, v upwards, and is repeated beyond it: every viewer agrees on that.
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
    """A picture, as its file has it.

    Attributes
    ----------
    data : bytes
    media_type, suffix : str
        What it is: ``image/png`` and ``.png``, or ``image/jpeg`` and ``.jpg``.
    """

    data: bytes
    media_type: str
    suffix: str


def read_texture(path: str | os.PathLike[str]) -> Texture:
    """Read a picture, PNG or JPEG.

    Raises
    ------
    MeshFileError
        When there is no such file, or it is no such picture.
    """
    data = read_bytes(path)
    for start, kind in _KINDS.items():
        if data.startswith(start):
            return Texture(data, *kind)
    raise MeshFileError(path, "is not a PNG or JPEG image", remedy="save it as PNG or JPEG")


def checkerboard() -> Texture:
    """A checkerboard, which goes on where it is repeated."""
    dark = np.indices((_SQUARES, _SQUARES)).sum(axis=0) % 2 == 1
    pixels = np.where(dark[..., None], _DARK, _LIGHT).astype(np.uint8).repeat(_PIXELS, axis=0).repeat(_PIXELS, axis=1)
    side = _SQUARES * _PIXELS
    # Each line begins with a byte that says that it is as it stands.
    lines = np.concatenate([np.zeros((side, 1), dtype=np.uint8), pixels.reshape(side, -1)], axis=1)
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    parts = (b"IHDR", head), (b"IDAT", zlib.compress(lines.tobytes(), 9)), (b"IEND", b"")
    (start, kind), *_ = _KINDS.items()
    return Texture(start + b"".join(_chunk(*part) for part in parts), *kind)


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
