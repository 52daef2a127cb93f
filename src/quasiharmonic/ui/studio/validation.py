"""Extract and validate the parameters of messages from a page, which are untrusted."""

from __future__ import annotations

import math

import numpy as np

from quasiharmonic.ui.studio.protocol import Frame
from quasiharmonic.util.arrays import FloatArray


class Refused(ValueError):  # noqa: N818
    """A request cannot be fulfilled and the page is unchanged; the message states the reason."""


def vertex(frame: Frame, n: int) -> int:
    """Return the vertex index, below ``n``."""
    value = number(frame, "vertex")
    if not 0 <= value < n:
        raise Refused(f"there is no vertex {value}: the surface has {n}, counted from 0")
    return value


def number(frame: Frame, name: str) -> int:
    """Return an integer."""
    value = frame.header.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 2**53:
        raise Refused(f"a message without its {name}, a whole number")
    return value


def place(frame: Frame) -> FloatArray:
    """Return the target position of a drag, (2,) float64."""
    value = frame.header.get("to")
    if not isinstance(value, list) or len(value) != 2:
        raise Refused("a message without the place that a vertex is moved to, two numbers")
    for one in value:
        if isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one) or abs(one) > 1e150:
            raise Refused("a vertex was moved to a position that is not finite")
    return np.array(value, dtype=np.float64)


def text(frame: Frame, name: str) -> str:
    """Return a string of at most 200 characters."""
    value = frame.header.get(name)
    if not isinstance(value, str) or len(value) > 200:
        raise Refused(f"a message without its {name}, some words")
    return value


def content(frame: Frame) -> bytes:
    """Return the bytes of a file."""
    array = frame.arrays.get("content")
    if array is None or array.dtype != np.uint8:
        raise Refused("a message without the file that it speaks of")
    return array.tobytes()


def points(frame: Frame) -> FloatArray:
    """Return points in the plane, (k, 2) float64."""
    array = frame.arrays.get("points")
    if array is None or array.dtype != np.float64 or array.size % 2:
        raise Refused("a message without the points that it speaks of")
    return array.reshape(-1, 2)
