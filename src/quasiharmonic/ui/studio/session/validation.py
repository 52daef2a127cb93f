"""Extract and validate the parameters of messages from a page, which are untrusted.

Files arrive as bytes, and are stored for functions that read paths.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from quasiharmonic.ui.studio.protocol import MessageFrame
from quasiharmonic.util.arrays import FloatArray


class RequestError(ValueError):
    """A request cannot be fulfilled and the page is unchanged; the message states the reason."""


def vertex(frame: MessageFrame, n: int, name: str = "vertex") -> int:
    """Return a vertex index, below ``n``."""
    value = number(frame, name)
    if not 0 <= value < n:
        raise RequestError(f"there is no vertex {value}: the surface has {n}, counted from 0")
    return value


def number(frame: MessageFrame, name: str) -> int:
    """Return an integer."""
    value = frame.header.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 2**53:
        raise RequestError(f"the message lacks {name}, a whole number")
    return value


def place(frame: MessageFrame) -> FloatArray:
    """Return the target position of a drag, (2,) float64."""
    value = frame.header.get("to")
    if not isinstance(value, list) or len(value) != 2:
        raise RequestError("the message lacks the target position, two numbers")
    for one in value:
        if isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one) or abs(one) > 1e150:
            raise RequestError("the target position of a vertex must be finite")
    return np.array(value, dtype=np.float64)


def text(frame: MessageFrame, name: str) -> str:
    """Return a string of at most 200 characters."""
    value = frame.header.get(name)
    if not isinstance(value, str) or len(value) > 200:
        raise RequestError(f"the message lacks {name}, a text")
    return value


def content(frame: MessageFrame) -> bytes:
    """Return the bytes of a file."""
    array = frame.arrays.get("content")
    if array is None or array.dtype != np.uint8:
        raise RequestError("the message lacks the file")
    return array.tobytes()


def points(frame: MessageFrame) -> FloatArray:
    """Return points in the plane, (k, 2) float64."""
    array = frame.arrays.get("points")
    if array is None or array.dtype != np.float64 or array.size % 2:
        raise RequestError("the message lacks the points")
    return array.reshape(-1, 2)


def amount(frame: MessageFrame, name: str, low: float, high: float, default: float) -> float:
    """Return a number between two bounds, ``default`` if there is none."""
    value = frame.header.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise RequestError(f"{name} must be a number from {low:g} to {high:g}")
    return value


def indices(frame: MessageFrame, name: str, n: int) -> list[int]:
    """Return a list of different indices below ``n``, ascending."""
    values = frame.header.get(name)
    if not isinstance(values, list) or not all(type(value) is int and 0 <= value < n for value in values):
        raise RequestError(f"the message lacks {name}, a list of numbers below {n}")
    return sorted(set(values))


@contextmanager
def stored_file(name: str, content: bytes) -> Iterator[Path]:
    """Store a file under a name in a temporary folder during the block; return its path."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        yield path
