"""Extract and validate what a page gives, which is untrusted: fields of messages, files, and outlines.

Each function ``read_…`` of a message returns one field and raises RequestError if it is missing or invalid.
`docs/development/page_protocol.md` lists the fields of each message.

Files arrive as bytes, and are stored for functions that read paths. An outline is a named shape, an uploaded drawing,
or a polygon drawn by hand. No file is read whose name comes from a page.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from quasiharmonic.apps.unwrapping.model_files import PARTS
from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.targets import outline, outline_curves, read_svg
from quasiharmonic.ui.studio.page import OPTION_NAMES
from quasiharmonic.ui.studio.protocol import MessageFrame
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.options import UnwrapOptions

# A decimal number of limited length.
_NUMBER = r"\d{1,6}(?:\.\d{1,6})?"
_SHAPES = re.compile(
    rf"disk|ellipse:{_NUMBER}x{_NUMBER}|ring:{_NUMBER}|rect:{_NUMBER}x{_NUMBER}|polygon:\d{{1,4}}|star:\d{{1,4}}"
    r"|letter:\S|word:\S{1,20}"
)
#: Maximum size of an uploaded drawing in bytes.
MAX_BYTES = 8 << 20
#: Maximum number of points drawn by hand.
MAX_POINTS = 10_000


# Texture sizes of messages without them. The page always states both; the buttons of the notebook's widget do not, and
# then act as calls of the library do.
#: Side of the texture in texels: the default of `unwrap`.
RESOLUTION = 2048
#: Side of the texture in texels: the default of `atlas.pack`.
PACKING_RESOLUTION = 1024
#: Texels between islands: the default of both.
PADDING = 4.0
# The largest side of a texture that most graphics cards accept.
_LARGEST_TEXTURE = 16_384
# The maximum in the page's field, in texels.
_LARGEST_PADDING = 64


class RequestError(ValueError):
    """A request cannot be fulfilled and the page is unchanged; the message states the reason."""


def read_vertex(frame: MessageFrame, n: int, name: str = "vertex") -> int:
    """Return a vertex index, below ``n``."""
    value = read_number(frame, name)
    if not 0 <= value < n:
        raise RequestError(f"there is no vertex {value}: the surface has {n}, counted from 0")
    return value


def read_number(frame: MessageFrame, name: str) -> int:
    """Return an integer."""
    value = frame.header.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) >= 2**53:
        raise RequestError(f"the message lacks {name}, a whole number")
    return value


def read_place(frame: MessageFrame) -> FloatArray:
    """Return the field ``to``, a position or a vector in the plane, (2,) float64."""
    value = frame.header.get("to")
    if not isinstance(value, list) or len(value) != 2:
        raise RequestError("the message lacks the target position, two numbers")
    for one in value:
        if isinstance(one, bool) or not isinstance(one, int | float) or not math.isfinite(one) or abs(one) > 1e150:
            raise RequestError("the target position of a vertex must be finite")
    return np.array(value, dtype=np.float64)


def read_text(frame: MessageFrame, name: str) -> str:
    """Return a string of at most 200 characters."""
    value = frame.header.get(name)
    if not isinstance(value, str) or len(value) > 200:
        raise RequestError(f"the message lacks {name}, a text")
    return value


def read_content(frame: MessageFrame) -> bytes:
    """Return the bytes of a file."""
    array = frame.arrays.get("content")
    if array is None or array.dtype != np.uint8:
        raise RequestError("the message lacks the file")
    return array.tobytes()


def read_points(frame: MessageFrame) -> FloatArray:
    """Return points in the plane, (k, 2) float64."""
    array = frame.arrays.get("points")
    if array is None or array.dtype != np.float64 or array.size % 2:
        raise RequestError("the message lacks the points")
    return array.reshape(-1, 2)


def read_amount(frame: MessageFrame, name: str, low: float, high: float, default: float) -> float:
    """Return a number between two bounds, ``default`` if there is none."""
    value = frame.header.get(name, default)
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise RequestError(f"{name} must be a number from {low:g} to {high:g}")
    return value


def read_indices(frame: MessageFrame, name: str, n: int) -> list[int]:
    """Return a list of different indices below ``n``, ascending."""
    values = frame.header.get(name)
    if not isinstance(values, list) or not all(type(value) is int for value in values):
        raise RequestError(f"the message lacks {name}, a list of whole numbers")
    if wrong := [value for value in values if not 0 <= value < n]:
        raise RequestError(f"there is no {name.removesuffix('s')} {wrong[0]}, only 0 ... {n - 1}")
    return sorted(set(values))


def read_options(frame: MessageFrame) -> dict[str, Any]:
    """Return the options of `unwrap`; ValueError or TypeError for invalid ones."""
    given = frame.header.get("options", {})
    if not isinstance(given, dict) or not set(given) <= set(OPTION_NAMES):
        raise RequestError(f"options of unwrap are {', '.join(OPTION_NAMES)}")
    if given.get("labels", "groups") not in PARTS:
        raise RequestError(f"labels are {' or '.join(PARTS)}")
    if given.get("symmetry") == "none":
        given = {**given, "symmetry": None}
    UnwrapOptions(**given)
    return given


def read_texture_size(frame: MessageFrame, resolution: int = RESOLUTION) -> dict[str, Any]:
    """Return the options ``resolution``, by default the given one, and ``padding``."""
    return {
        "resolution": int(read_amount(frame, "resolution", 16, _LARGEST_TEXTURE, resolution)),
        "padding": float(read_amount(frame, "padding", 0, _LARGEST_PADDING, PADDING)),
    }


@contextmanager
def stored_file(name: str, content: bytes) -> Iterator[Path]:
    """Store a file under a name in a temporary folder during the block; return its path."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        yield path


@dataclass(frozen=True, eq=False)
class Outline:
    """Contours, and the argument that reproduces them."""

    to: str  # Argument of ``--to``: the name of a shape, or the file name for ``content``
    contours: list[FloatArray]  # each (k, 2)
    content: bytes | None = None  # Contents of that file; None if ``to`` is the name of a shape

    @property
    def texts(self) -> dict[str, bytes]:
        """Contents of the files that ``to`` names, by name."""
        return {} if self.content is None else {self.to: self.content}

    def curves(self) -> list[Curve]:
        """Return the curves for a sliding boundary."""
        if self.content is None:
            return outline_curves(self.to)
        with stored_file(self.to, self.content) as path:
            return outline_curves(path)


def make_outline(word: object) -> Outline:
    """Return the outline of a named shape, such as ``letter:R``; ValueError for other names, also those of files."""
    if not isinstance(word, str) or not _SHAPES.fullmatch(word):
        raise ValueError(
            f"unknown outline {str(word)[:40]!r}: use disk, ellipse:2x1, ring:0.5, rect:2x1, polygon:6, star:5, "
            "letter:R and word:QH"
        )
    return Outline(word, outline(word))


def read_drawing(name: str, content: bytes) -> Outline:
    """Return the outline of an uploaded SVG drawing; ValueError if it is not a valid drawing, or too large."""
    shown = re.sub(r"[^\w.-]", "_", PurePosixPath(name.replace("\\", "/")).stem)[:60].strip(".-") or "drawing"
    if len(content) > MAX_BYTES:
        raise ValueError(f"{shown}.svg has {len(content):,} bytes; at most {MAX_BYTES:,} are allowed")
    with stored_file("dropped.svg", content) as path:
        try:
            contours = read_svg(path)
        except (ValueError, OSError) as error:
            raise ValueError(str(error).replace(str(path), f"{shown}.svg")) from None
    return Outline(f"{shown}.svg", contours, content)


def make_polygon(points: FloatArray) -> Outline:
    """Return the outline of a polygon (k, 2) drawn on the page.

    ValueError if it has fewer than three or too many corners, or a corner is not finite.
    """
    if points.ndim != 2 or points.shape[1:] != (2,) or not 3 <= len(points) <= MAX_POINTS:
        raise ValueError(f"a polygon has 3 to {MAX_POINTS:,} corners")
    if not np.isfinite(points).all():
        raise ValueError("a corner of the polygon is not finite")
    content = "".join(f"{x!r}, {y!r}\n" for x, y in points.tolist()).encode()
    return Outline("polygon.txt", [np.array(points, dtype=np.float64)], content)
