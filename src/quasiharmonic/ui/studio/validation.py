"""What a page's messages ask for, each taken out of its message and looked at: nothing in it is taken on trust."""

from __future__ import annotations

import math

import numpy as np

from quasiharmonic.ui.studio.protocol import Frame
from quasiharmonic.util.arrays import FloatArray


class Refused(ValueError):  # noqa: N818
    """What is asked for cannot be done, and the page stays as it is; the message says why."""


def vertex(frame: Frame, n: int) -> int:
    """The vertex, one of ``n``."""
    value = number(frame, "vertex")
    if not 0 <= value < n:
        raise Refused(f"there is no vertex {value}: the surface has {n}, counted from 0")
    return value


def number(frame: Frame, name: str) -> int:
    """A whole number."""
    value = frame.header.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 2**53:
        raise Refused(f"a message without its {name}, a whole number")
    return value


def place(frame: Frame) -> FloatArray:
    """The place in the plane that a hand goes to, (2,) float64."""
    value = frame.header.get("to")
    if not isinstance(value, list) or len(value) != 2:
        raise Refused("a message without the place that a vertex is moved to, two numbers")
    for one in value:
        if isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one) or abs(one) > 1e150:
            raise Refused("a vertex was moved to a position that is not finite")
    return np.array(value, dtype=np.float64)


def text(frame: Frame, name: str) -> str:
    """Some words, of 200 letters at most."""
    value = frame.header.get(name)
    if not isinstance(value, str) or len(value) > 200:
        raise Refused(f"a message without its {name}, some words")
    return value


def content(frame: Frame) -> bytes:
    """The bytes of a file."""
    array = frame.arrays.get("content")
    if array is None or array.dtype != np.uint8:
        raise Refused("a message without the file that it speaks of")
    return array.tobytes()


def points(frame: Frame) -> FloatArray:
    """Points in the plane, (k, 2) float64."""
    array = frame.arrays.get("points")
    if array is None or array.dtype != np.float64 or array.size % 2:
        raise Refused("a message without the points that it speaks of")
    return array.reshape(-1, 2)
