"""Parser of SVG path data (the attribute ``d``), which returns Bézier curves.

W3C, Scalable Vector Graphics (SVG) 2, chapter 9 and appendix B.2, https://www.w3.org/TR/SVG2/paths.html.
"""

from __future__ import annotations

import cmath
import math
import re
from typing import Any

import numpy as np

from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.targets.outlines.contours import MAX_POINTS, Pieces
from quasiharmonic.util.arrays import to_points

_BLANKS = re.compile(r"[ \t\r\n\f]*")
_COMMA = re.compile(r"[ \t\r\n\f]*,?[ \t\r\n\f]*")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
# Arguments of each command: x is a number, F a flag, a single 0 or 1.
_ARGUMENTS = {"M": "xx", "L": "xx", "H": "x", "V": "x", "C": "x" * 6, "S": "x" * 4, "Q": "x" * 4, "T": "xx"}
_ARGUMENTS |= {"A": "xxxFFxx", "Z": ""}
# Numbers that a command takes, at least 1, by its letter.
_WIDTHS = {letter: len(kinds) or 1 for upper, kinds in _ARGUMENTS.items() for letter in (upper, upper.lower())}
# Number of cubic curves per half turn of an arc. Each deviates from a circle by 6.6e-8 of the radius.
_HALF_TURN = 8
# A letter other than e and E, and the text up to the next such letter.
_COMMAND = re.compile(r"([A-DF-Za-df-z])([^A-DF-Za-df-z]*)")


def parse_path(d: str, *, arcs: bool = False) -> list[Pieces]:
    """Parse path data of SVG 2 into the pieces of each subpath; empty subpaths are left out.

    A piece is a Bézier curve given by its control points. With ``arcs``, arcs are `Arc` objects; otherwise they become
    cubic curves with an error below 1e-7 of their larger radius. ValueError gives the position of invalid data.
    """
    pen = _Pen(arcs)
    scan = _Scanner(d)
    command = ""
    while (token := scan.command(command)) is not None:
        if not command and token not in "Mm":
            raise scan.error("path data begin with M")
        command = token
        values = [scan.number() if kind == "x" else scan.flag() for kind in _ARGUMENTS[command.upper()]]
        if not all(map(math.isfinite, values)):
            raise scan.error("a number is too large")
        pen.draw(command, values)
        if pen.count > MAX_POINTS:
            raise scan.error(f"more than {MAX_POINTS:,} pieces")
    return [subpath for subpath in pen.subpaths if subpath]


def commands(d: str, max_count: int) -> int:
    """Count the commands in path data up to ``max_count``, much faster than parsing them.

    An arc counts as the number of curves of half a turn. The count is too low only if the flags of arcs are written
    without a separator after them.
    """
    if len(d) > max_count and (letters := sum(map(d.count, _WIDTHS))) > max_count:
        return letters
    total = 0
    for letter, numbers in _COMMAND.findall(d):
        width = _WIDTHS.get(letter, 1)
        # Several numbers need at least one character between any two. The number of substitutions needs no memory.
        several = len(numbers) + 1 >= 4 * width
        count = max(1, _NUMBER.subn("", numbers)[1] // width) if several else 1
        total += count * (_HALF_TURN if letter in "Aa" else 1)
        if total > max_count:
            break
    return total


class _Scanner:
    """Read numbers and commands from path data."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self._skip()

    def command(self, previous: str) -> str | None:
        """Return the next command; arguments without a letter repeat the previous command."""
        if self.at == len(self.text):
            return None
        character = self.text[self.at]
        if character.isascii() and character.upper() in _ARGUMENTS:
            self.at += 1
            self._skip()
            return character
        if previous in ("", "z", "Z") or not _NUMBER.match(self.text, self.at):
            raise self.error("a command, which is a letter, is missing")
        # Further pairs of numbers after a move are lines.
        return {"M": "L", "m": "l"}.get(previous, previous)

    def number(self) -> float:
        found = _NUMBER.match(self.text, self.at)
        if found is None:
            raise self.error("a number is missing")
        self.at = found.end()
        self._skip(comma=True)
        return float(found.group())

    def flag(self) -> float:
        if self.text[self.at : self.at + 1] not in ("0", "1"):
            raise self.error("a flag, 0 or 1, is missing")
        self.at += 1
        value = float(self.text[self.at - 1])
        self._skip(comma=True)
        return value

    def _skip(self, comma: bool = False) -> None:
        found = (_COMMA if comma else _BLANKS).match(self.text, self.at)
        self.at = self.at if found is None else found.end()

    def error(self, what: str) -> ValueError:
        near = self.text[max(0, self.at - 10) : self.at + 10]
        return ValueError(f"path data: {what} at character {self.at + 1} (near {near!a})")


class _Pen:
    """Execute the commands of a path; points are complex numbers x + iy."""

    def __init__(self, arcs: bool) -> None:
        # Control points, and `Arc` objects if arcs are kept.
        self.subpaths: list[list[Any]] = []
        self.count = 0
        self.arcs = arcs
        self.here = self.start = 0j
        # The last control point of the previous curve, and its command.
        self.control = 0j
        self.before = ""

    def draw(self, command: str, values: list[float]) -> None:
        kind = command.upper()
        origin = self.here if command.islower() else 0j
        if kind == "Z":
            self._line(self.start)
            self.subpaths.append([])
        elif kind == "M":
            self.here = self.start = origin + complex(*values)
            self.subpaths.append([])
        elif kind == "H":
            self._line(complex(origin.real + values[0], self.here.imag))
        elif kind == "V":
            self._line(complex(self.here.real, origin.imag + values[0]))
        elif kind == "A":
            radii, turn, large, sweep = values[:2], math.radians(values[2]), values[3] > 0, values[4] > 0
            self._arc(radii[0], radii[1], turn, large, sweep, origin + complex(*values[5:]))
        else:
            points = [origin + complex(*pair) for pair in zip(values[::2], values[1::2], strict=True)]
            if kind in "ST":
                points.insert(0, self._reflect_control("CS" if kind == "S" else "QT"))
            if kind != "L":
                self.control = points[-2]
            self._piece(points)
        self.before = kind

    def _reflect_control(self, alike: str) -> complex:
        """Control point that continues the previous curve smoothly.

        The current point if the previous command is not a curve of the same degree.
        """
        return 2 * self.here - self.control if self.before and self.before in alike else self.here

    def _line(self, end: complex) -> None:
        if end != self.here:
            self._piece([end])

    def _piece(self, points: list[complex]) -> None:
        every = np.array([self.here, *points])
        self.subpaths[-1].append(to_points(every))
        self.here = points[-1]
        self.count += 1

    def _arc(self, rx: float, ry: float, turn: float, large: bool, sweep: bool, end: complex) -> None:
        """Append an elliptical arc, converted to its centre and angles (SVG 2, appendix B.2.4)."""
        rx, ry = abs(rx), abs(ry)
        if end == self.here:
            return
        if rx == 0 or ry == 0:
            self._line(end)
            return
        # In coordinates in which the ellipse is the unit circle.
        axis = cmath.exp(1j * turn)

        def inward(z: complex) -> complex:
            z /= axis
            return complex(z.real / rx, z.imag / ry)

        half = inward((self.here - end) / 2)
        size = abs(half)
        if size > 1:  # radii too small: scale them up until the ellipse reaches both ends
            rx, ry, half, size = rx * size, ry * size, half / size, 1.0
        middle = half * 1j * math.sqrt(max(0.0, 1 - size**2)) / size
        if large != sweep:
            middle = -middle
        first, last = cmath.phase(half - middle), cmath.phase(-half - middle)
        angle = (last - first) % (2 * math.pi) if sweep else -((first - last) % (2 * math.pi))
        # Map the unit circle to the ellipse through both end points.
        centre = (self.here + end) / 2 + axis * complex(middle.real * rx, middle.imag * ry)

        if self.arcs:
            rows = to_points(np.array([centre, axis * rx, 1j * axis * ry]))
            self.subpaths[-1].append(Arc(rows[0], rows[1], rows[2], first, first + angle))
            self.here = end
            self.count += 1
            return
        steps = max(1, math.ceil(abs(angle) / (math.pi / _HALF_TURN)))
        lever = 1j * 4 / 3 * math.tan(angle / steps / 4)
        at = np.exp(1j * (first + angle * np.arange(steps + 1) / steps))
        circle = np.stack([at[:-1], at[:-1] * (1 + lever), at[1:] * (1 - lever), at[1:]], axis=1)
        pieces = centre + axis * (circle.real * rx + 1j * (circle.imag * ry))
        pieces[0, 0], pieces[-1, -1] = self.here, end
        self.subpaths[-1].extend(pieces.view(np.float64).reshape(steps, 4, 2))
        self.here = end
        self.count += steps
