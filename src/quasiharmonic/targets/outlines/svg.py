"""Outlines from SVG drawings: the geometry of shapes and paths, with transforms and groups.

Fill, stroke and opacity are ignored. Every closed shape is a contour, an open one is closed by a straight line, and a
contour inside an odd number of others is a hole. References to other files or addresses are not followed.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from typing import Any
from xml.parsers import expat

import numpy as np

from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.io.errors import MeshFileError, check_path, report_damage
from quasiharmonic.io.untrusted import read_text
from quasiharmonic.targets.outlines.contours import MAX_POINTS, Pieces, arrange, flatten
from quasiharmonic.targets.outlines.svgpath import commands, parse_path
from quasiharmonic.util.arrays import FloatArray, check_numbers, to_complex

_SVG = "http://www.w3.org/2000/svg"
MAX_BYTES = 64 << 20
_DEEPEST = 200
_MAX_TRANSFORMS = 1000
_TOO_MANY = f"more than {MAX_POINTS:,} pieces in all"
# Bound that keeps squares of coordinates and their sums from overflow and underflow.
_LARGEST = 1e150
_CONTAINERS = "svg", "g", "a", "switch"
# Visible elements that the reader cannot convert to outlines.
_FOREIGN = {
    "text": "turn the text into paths (in Inkscape: Path > Object to Path)",
    "use": "turn the clone into a path (in Inkscape: Edit > Clone > Unlink Clone)",
}
_LENGTH = re.compile(r"\s*([+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)\s*([a-z%]*)\s*", re.IGNORECASE)
_UNITS = {"": 1.0, "px": 1.0, "in": 96.0, "cm": 96 / 2.54, "mm": 96 / 25.4, "pt": 96 / 72, "pc": 16.0}
_TRANSFORM = re.compile(r"[\s,]*([a-zA-Z]+)\s*\(([^()]*)\)[\s,]*")
# Style properties that would change the geometry. They are not read, so they raise an error.
_SHAPING = re.compile(
    r"(?:^|[;{\s])\s*(transform(?:-origin)?|translate|rotate|scale|offset-path|d|[cr]?[xy]|r)\s*:", re.IGNORECASE
)
# Rules of style sheets that would hide shapes. It is not read to which shapes they apply, so they raise an error.
_HIDING = re.compile(r"[;{\s](display\s*:\s*none|visibility\s*:\s*(?:hidden|collapse))\b", re.IGNORECASE)
_HIDDEN = re.compile(r"(?:^|;)\s*(?:display\s*:\s*none|visibility\s*:\s*(?:hidden|collapse))\s*(?:;|!|$)")


def read_svg(path: str | os.PathLike[str], *, tolerance: float = 1e-6) -> list[FloatArray]:
    """Read the outline that an SVG file draws.

    Parameters
    ----------
    path : str or path-like
        A file with ``path``, ``rect``, ``circle``, ``ellipse``, ``polygon`` and ``polyline`` elements, in groups and
        with transforms.
    tolerance : float
        Maximum deviation of the contours from the drawing's curves, as a share of its larger side; at least 1e-7.

    Returns
    -------
    list of (k, 2) float64
        The contours by decreasing area, in the units of the file. The y-axis is reversed to point upwards, so the
        outline looks like the drawing. Each contour keeps its first point and its orientation; `nested` orients
        contours.

    Raises
    ------
    MeshFileError
        With the line number:

        - when the file is not an SVG drawing, is malformed or declares entities;
        - when it has text or clones, which are not outlines, or styles that move or shape elements;
        - when it is larger than 64 MiB, nested more than 200 deep, or draws nothing that encloses an area;
        - as `nested` for contours that meet themselves or each other.
    ValueError
        When the tolerance is out of range.
    """
    check_numbers(tolerance=tolerance)
    if not 1e-7 <= tolerance < 1:
        raise ValueError(
            f"tolerance must be a fraction of the drawing's size, at least 1e-7 and less than 1, not {tolerance}"
        )
    subpaths = svg_paths(path)
    controls = [control for pieces in subpaths for control in pieces]
    if not controls:
        raise MeshFileError(path, "has no path or shape", remedy="convert texts to paths")
    every = np.concatenate(controls)
    if not np.abs(every).max() < _LARGEST:
        raise MeshFileError(path, "has coordinates that are too large")
    size = float(np.ptp(every, axis=0).max())
    contours = []
    with report_damage(path):
        for pieces in subpaths if size > 1 / _LARGEST else []:
            contour = flatten(pieces, tolerance * size)
            if len(contour) > 2 and _breadth(contour) > (tolerance * size) ** 2:
                contours.append(contour)
    if not contours:
        raise MeshFileError(path, "has no path or shape that encloses an area")
    with report_damage(path, describe=lambda error: f"{error} (in units of the drawing, the y-axis upwards)"):
        return [one.points for one in arrange(contours)]


def svg_paths(path: str | os.PathLike[str], *, arcs: bool = False) -> list[Pieces]:
    """Paths that an SVG file draws, as read by `read_svg`; ``arcs`` as in `parse_path`."""
    check_path("path", path)
    if os.path.isfile(path) and os.path.getsize(path) > MAX_BYTES:
        raise MeshFileError(path, f"is larger than {MAX_BYTES >> 20} MiB", remedy="simplify the drawing")
    with np.errstate(over="ignore", invalid="ignore"):
        return _Drawing(path, arcs).read(read_text(path))


def _breadth(contour: FloatArray) -> float:
    """Sum of the areas of the triangles that the sides span with the first point; 0 only for collinear points."""
    w = to_complex(contour - contour[0])
    return float(np.abs((w.conj() * np.roll(w, -1)).imag).sum()) / 2


class _Drawing:
    """Traverse the elements of a drawing and collect their transformed paths."""

    def __init__(self, path: str | os.PathLike[str], arcs: bool) -> None:
        self.path, self.arcs = path, arcs
        # Tag, line, path data and transform of each shape; parsed after the limits have been checked.
        self.shapes: list[tuple[str, int, str, FloatArray]] = []
        self.elements = self.commands = 0
        # Transform of homogeneous coordinates for every open container.
        self.transforms = [np.diag([1.0, -1.0, 1.0])]
        self.depth = 0
        # Depth of the element whose contents are skipped; 0 if none.
        self.skipped = 0
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.EntityDeclHandler = self._refuse_entity
        self.parser.CharacterDataHandler = self._add_text
        # Text of the current style sheet.
        self.sheet: list[str] | None = None

    def read(self, data: bytes) -> list[Pieces]:
        try:
            self.parser.Parse(data, True)
        except expat.ExpatError as error:
            what = f"is not well-formed XML: {expat.ErrorString(error.code)}"
            raise MeshFileError(self.path, what, error.lineno) from None
        drawn: list[tuple[list[Any], FloatArray]] = []
        count = 0
        for tag, line, d, transform in self.shapes:
            with report_damage(self.path, f"<{tag}>: ", line=line):
                for pieces in parse_path(d, arcs=self.arcs):
                    count += len(pieces)
                    if count > MAX_POINTS:
                        raise ValueError(_TOO_MANY)
                    drawn.append((pieces, transform))
        return [_apply_transform(pieces, transform) for pieces, transform in drawn]

    def _error(self, what: str, remedy: str = "") -> MeshFileError:
        return MeshFileError(self.path, what, self.parser.CurrentLineNumber, remedy)

    def _refuse_entity(self, name: str, *_: object) -> None:
        raise self._error(f"declares the entity {name[:40]!a}, but entities are not supported", "save it as plain SVG")

    def _add_text(self, text: str) -> None:
        if self.sheet is not None:
            self.sheet.append(text)

    def _check_style(self, tag: str, style: str) -> None:
        if found := _SHAPING.search(style):
            remedy = "write it as an attribute, or apply the transform to the paths in a drawing program"
            raise self._error(f"<{tag}>: {found.group(1)!r} in a style is not supported", remedy)

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self.depth += 1
        self.elements += 1
        if self.elements > MAX_POINTS:
            raise self._error(f"more than {MAX_POINTS:,} elements")
        if self.depth > _DEEPEST:
            raise self._error(f"elements nested more than {_DEEPEST} deep")
        namespace, _, tag = name.rpartition(" ")
        if tag == "style" and namespace in ("", _SVG):
            # Style sheets apply even inside definitions that draw nothing.
            self.sheet = []
        if self.skipped:
            return
        if self.depth == 1 and (tag != "svg" or namespace not in ("", _SVG)):
            raise self._error(f"is not an SVG drawing: the root element is {tag[:40]!a}")
        shown = (attributes.get(name, "").strip() for name in ("display", "visibility"))
        hidden = not {"none", "hidden", "collapse"}.isdisjoint(shown) or _HIDDEN.search(attributes.get("style", ""))
        if namespace not in ("", _SVG) or hidden or not (tag in _CONTAINERS or tag in _SHAPES or tag in _FOREIGN):
            self.skipped = self.depth
            return
        if tag in _FOREIGN:
            raise self._error(f"the outline of a <{tag}> is not supported", _FOREIGN[tag])
        self._check_style(tag, attributes.get("style", ""))
        if "transform" in attributes and "transform-origin" in attributes:
            raise self._error(f"<{tag}>: transform-origin is not supported", "apply the transform in a drawing program")
        with report_damage(self.path, f"<{tag}>: ", line=self.parser.CurrentLineNumber):
            transform = self.transforms[-1]
            if "transform" in attributes:
                transform = transform @ _parse_transform(attributes["transform"])
            if tag == "svg" and self.depth > 1:
                if "viewBox" in attributes:
                    raise ValueError("an inner <svg> with a viewBox")
                transform = transform @ _affine(1, 0, 0, 1, _length(attributes, "x"), _length(attributes, "y"))
            if tag in _SHAPES:
                self._add_shape(tag, _SHAPES[tag](attributes), transform)
                # Children of a shape, such as titles and animations, draw nothing.
                self.skipped = self.depth
            else:
                self.transforms.append(transform)

    def _end(self, name: str) -> None:
        if self.sheet is not None:
            sheet, self.sheet = "".join(self.sheet), None
            self._check_style("style", sheet)
            if found := _HIDING.search(sheet):
                remedy = "hide the shapes by attributes, or delete them"
                raise self._error(f"<style>: {found.group(1)!r} in a style sheet is not supported", remedy)
        if self.skipped == self.depth:
            self.skipped = 0
        elif not self.skipped:
            self.transforms.pop()
        self.depth -= 1

    def _add_shape(self, tag: str, d: str, transform: FloatArray) -> None:
        self.commands += commands(d, MAX_POINTS - self.commands)
        if self.commands > MAX_POINTS:
            raise ValueError(_TOO_MANY)
        self.shapes.append((tag, self.parser.CurrentLineNumber, d, transform))


def _apply_transform(pieces: list[Any], transform: FloatArray) -> list[Any]:
    matrix, shift = transform[:2, :2], transform[:2, 2]
    return [p.transform(matrix, shift) if isinstance(p, Arc) else p @ matrix.T + shift for p in pieces]


def _affine(a: float, b: float, c: float, d: float, e: float, f: float) -> FloatArray:
    """Matrix of the SVG transform ``matrix(a, b, c, d, e, f)``."""
    return np.array([(a, c, e), (b, d, f), (0, 0, 1)], dtype=np.float64)


def _parse_transform(text: str) -> FloatArray:
    """Parse the attribute ``transform``: a product of matrix, translate, scale, rotate, skewX and skewY."""
    text = text.rstrip()
    product, at, count = np.eye(3), 0, 0
    while at < len(text):
        found = _TRANSFORM.match(text, at)
        count += 1
        if count > _MAX_TRANSFORMS:
            raise ValueError(f"more than {_MAX_TRANSFORMS:,} transforms of one element")
        if found is None:
            raise ValueError(f"the transform {text[at : at + 40]!a} is not supported")
        name, at = found.group(1), found.end()
        try:
            values = [float(word) for word in found.group(2).replace(",", " ").split()]
        except ValueError:
            values = []
        if name not in _TRANSFORMS or len(values) not in _TRANSFORMS[name][0] or not all(map(math.isfinite, values)):
            raise ValueError(f"the transform {found.group().strip()[:40]!a} is not supported")
        product = product @ _TRANSFORMS[name][1](*values)
    return np.asarray(product)


def _rotation(degrees: float, x: float = 0.0, y: float = 0.0) -> FloatArray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return _affine(1, 0, 0, 1, x, y) @ _affine(c, s, -s, c, 0, 0) @ _affine(1, 0, 0, 1, -x, -y)


# Allowed numbers of arguments of each transform, and its matrix.
_TRANSFORMS: dict[str, tuple[tuple[int, ...], Callable[..., FloatArray]]] = {
    "matrix": ((6,), _affine),
    "translate": ((1, 2), lambda x, y=0.0: _affine(1, 0, 0, 1, x, y)),
    "scale": ((1, 2), lambda x, y=None: _affine(x, 0, 0, x if y is None else y, 0, 0)),
    "rotate": ((1, 3), _rotation),
    "skewX": ((1,), lambda degrees: _affine(1, 0, math.tan(math.radians(degrees)), 1, 0, 0)),
    "skewY": ((1,), lambda degrees: _affine(1, math.tan(math.radians(degrees)), 0, 1, 0, 0)),
}


def _length(attributes: dict[str, str], name: str, default: float = 0.0) -> float:
    """Return a length in user units.

    Raises ValueError for negative radii or sides, and for units without a fixed size.
    """
    if name not in attributes:
        return default
    found = _LENGTH.fullmatch(attributes[name])
    if found is None or found.group(2).lower() not in _UNITS:
        raise ValueError(f"{name}={attributes[name][:40]!a} is not a length in px or another fixed unit")
    value = float(found.group(1)) * _UNITS[found.group(2).lower()]
    if not math.isfinite(value) or (value < 0 and name not in ("x", "y", "cx", "cy")):
        raise ValueError(f"{name}={attributes[name][:40]!a} is out of range")
    return value


def _rect(attributes: dict[str, str]) -> str:
    x, y, w, h = (_length(attributes, name) for name in ("x", "y", "width", "height"))
    if w == 0 or h == 0:
        return ""
    rx = _length(attributes, "rx", _length(attributes, "ry"))
    ry = _length(attributes, "ry", rx)
    rx, ry = min(rx, w / 2), min(ry, h / 2)
    if rx == 0 or ry == 0:
        return f"M{x!r},{y!r}h{w!r}v{h!r}h{-w!r}z"
    corner = f"a{rx!r},{ry!r} 0 0 1 "
    return (
        f"M{x + rx!r},{y!r}H{x + w - rx!r}{corner}{rx!r},{ry!r}V{y + h - ry!r}{corner}{-rx!r},{ry!r}"
        f"H{x + rx!r}{corner}{-rx!r},{-ry!r}V{y + ry!r}{corner}{rx!r},{-ry!r}z"
    )


def _ellipse(attributes: dict[str, str], *radii: str) -> str:
    x, y = _length(attributes, "cx"), _length(attributes, "cy")
    rx, ry = (_length(attributes, name) for name in radii)
    if rx == 0 or ry == 0:
        return ""
    half = f"a{rx!r},{ry!r} 0 0 1 "
    return f"M{x + rx!r},{y!r}{half}{-2 * rx!r},0{half}{2 * rx!r},0z"


def _polygon(attributes: dict[str, str]) -> str:
    return f"M{points}z" if (points := attributes.get("points", "").strip()) else ""


# Conversion of every shape to path data.
_SHAPES: dict[str, Callable[[dict[str, str]], str]] = {
    "path": lambda attributes: attributes.get("d", ""),
    "rect": _rect,
    "circle": lambda attributes: _ellipse(attributes, "r", "r"),
    "ellipse": lambda attributes: _ellipse(attributes, "rx", "ry"),
    "polygon": _polygon,
    "polyline": _polygon,
}
