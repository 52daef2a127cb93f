"""The outline of one glyph of a TrueType font, straight from its tables.

What matplotlib loads before it can be asked takes a tenth of a second, a third of what mapping a small mesh takes in
all, and the font that letters are made of by default is of this kind. What is handed back is what FreeType makes of
such a glyph at 100 pixels, unhinted, to the last bit: points rounded to 1/64 of a pixel, ties away from zero [1]_. What
is not as plain as that is None: matplotlib can be asked.

References
----------
.. [1] Apple, TrueType Reference Manual; Microsoft, OpenType specification 1.9: head, maxp, cmap, loca, glyf.
"""

from __future__ import annotations

import struct
from itertools import pairwise
from pathlib import Path
from unicodedata import category

import numpy as np

from quasiharmonic.arrays import IntArray
from quasiharmonic.targets.contours import Pieces

# Pixels of an em, and parts of a pixel that points are rounded to.
_PIXELS, _PARTS = 100, 64
# Beyond Latin, Greek and Cyrillic there is what is written from right to left, joined or stacked, by rules of its own;
# and so are marks, and what is not to be seen. Of the rest characters are letters, numbers, punctuation and symbols.
_SIMPLE, _KINDS = 0x530, "LNPS"
# Bits of a point, and of a component of a glyph.
_ON, _X_BYTE, _Y_BYTE, _REPEAT, _X_SAME, _Y_SAME = 1, 2, 4, 8, 16, 32
_WORDS, _OFFSETS, _SCALED, _MORE, _METRICS = 0x1, 0x2, 0x8 | 0x40 | 0x80, 0x20, 0x200
# The tables that are read.
_TABLES = {b"head", b"maxp", b"hhea", b"hmtx", b"cmap", b"loca", b"glyf"}
# Components of a glyph, those of components included, at most.
_COMPONENTS = 64

Contours = list[tuple[IntArray, IntArray]]


class _OtherError(Exception):
    """Something that is not plain TrueType."""


def glyph(file: Path, character: str) -> list[Pieces] | None:
    """Closed paths of lines and quadratic Bézier curves that a character is drawn by.

    Parameters
    ----------
    file : Path
    character : str
        A single one.

    Returns
    -------
    list of list of (2 or 3, 2) float64, or None
        Control points in units of the font size, each piece from where the one before ends. None where the font or the
        character is not of the kind that is read here, or has no glyph.
    """
    code = ord(character)
    if code >= _SIMPLE or category(character)[0] not in _KINDS:
        return None
    try:
        contours = _Font(file.read_bytes()).contours(code)
    except (OSError, struct.error, ArithmeticError, IndexError, ValueError, _OtherError):
        return None
    return [_pieces(points, on.tolist()) for points, on in contours if len(points)]


class _Font:
    """Tables of a font file; raises whatever comes when they are damaged."""

    def __init__(self, data: bytes) -> None:
        kind, count = struct.unpack_from(">4sH", data)
        if kind not in (b"\0\1\0\0", b"true"):
            raise _OtherError
        entries = struct.iter_unpack(">4s4xII", data[12 : 12 + 16 * count])
        self._tables = {name: data[start : start + length] for name, start, length in entries}
        if b"fvar" in self._tables or not set(self._tables) >= _TABLES:
            raise _OtherError
        head = self._tables[b"head"]
        (self._units,), (long,) = struct.unpack_from(">H", head, 18), struct.unpack_from(">h", head, 50)
        (glyphs,) = struct.unpack_from(">H", self._tables[b"maxp"], 4)
        (self._advances,) = struct.unpack_from(">H", self._tables[b"hhea"], 34)
        starts = np.frombuffer(self._tables[b"loca"], ">u4" if long else ">u2", glyphs + 1)
        self._starts = starts.astype(np.int64) * (1 if long else 2)

    def contours(self, code: int) -> Contours:
        """Points of a character's contours in 1/64 of a pixel, and which of them are on the curve."""
        number = self._number(code)
        if number == 0:
            raise _OtherError
        self._components = 0
        contours, left = self._glyph(number)
        return [(points - (left, 0), on) for points, on in contours]

    def _number(self, code: int) -> int:
        """Of the glyph of a character of the basic plane; 0 if there is none."""
        table = self._tables[b"cmap"]
        (count,) = struct.unpack_from(">H", table, 2)
        for platform, encoding, start in struct.iter_unpack(">HHI", table[4 : 4 + 8 * count]):
            if (platform, encoding) == (3, 1) and struct.unpack_from(">H", table, start) == (4,):
                break
        else:
            raise _OtherError
        (twice,) = struct.unpack_from(">H", table, start + 6)
        # The last codes of the segments, two bytes of nothing, the first codes, shifts, and where there are lists.
        words = np.frombuffer(table, ">u2", offset=start + 14, count=(len(table) - start - 14) // 2).astype(np.int64)
        n = twice // 2
        k = int(np.searchsorted(words[:n], code))
        first, shift, listed = words[n + 1 + k], words[2 * n + 1 + k], words[3 * n + 1 + k]
        if code < first:
            return 0
        if listed == 0:
            return int((code + shift) % 0x10000)
        found = int(words[3 * n + 1 + k + listed // 2 + code - first])
        return (found + int(shift)) % 0x10000 if found else 0

    def _glyph(self, number: int) -> tuple[Contours, int]:
        """Contours of a glyph, and where the pen stands before it is drawn."""
        start, end = self._starts[number : number + 2].tolist()
        data = self._tables[b"glyf"][start:end]
        if not data:
            return [], 0
        count, lowest = struct.unpack_from(">hh", data)
        # After the pairs of advance and bearing there are bearings alone.
        at = 4 * number + 2 if number < self._advances else 2 * (number + self._advances)
        (bearing,) = struct.unpack_from(">h", self._tables[b"hmtx"], at)
        left = int(self._scaled(np.array(lowest - bearing)))
        return (self._simple(data, count), left) if count >= 0 else self._composite(data, left)

    def _simple(self, data: bytes, count: int) -> Contours:
        """A glyph with contours of its own."""
        ends = np.array(struct.unpack_from(f">{count}H", data, 10), dtype=np.int64) + 1
        (instructions,) = struct.unpack_from(">H", data, 10 + 2 * count)
        at = 12 + 2 * count + instructions
        n = int(ends[-1]) if count else 0
        flags: list[int] = []
        while len(flags) < n:
            flags += [data[at]] * (1 + data[at + 1] if data[at] & _REPEAT else 1)
            at += 2 if data[at] & _REPEAT else 1
        points = np.empty((n, 2), dtype=np.int64)
        for axis, (byte, same) in enumerate(((_X_BYTE, _X_SAME), (_Y_BYTE, _Y_SAME))):
            here = 0
            for k, flag in enumerate(flags[:n]):
                if flag & byte:
                    here += data[at] if flag & same else -data[at]
                    at += 1
                elif not flag & same:
                    here += struct.unpack_from(">h", data, at)[0]
                    at += 2
                points[k, axis] = here
        on = (np.array(flags[:n], dtype=np.int64) & _ON).astype(np.int64)
        points = self._scaled(points)
        return [(points[a:b], on[a:b]) for a, b in pairwise([0, *ends.tolist()])]

    def _composite(self, data: bytes, left: int) -> tuple[Contours, int]:
        """A glyph made of others, each moved, one of which may say where the pen stands."""
        found: Contours = []
        at, flags = 10, _MORE
        while flags & _MORE:
            flags, number = struct.unpack_from(">HH", data, at)
            self._components += 1
            if flags & _SCALED or not flags & _OFFSETS or self._components > _COMPONENTS:
                raise _OtherError
            offset = self._scaled(np.array(struct.unpack_from(">hh" if flags & _WORDS else ">bb", data, at + 4)))
            at += 8 if flags & _WORDS else 6
            contours, own = self._glyph(number)
            found += [(points + offset, on) for points, on in contours]
            left = own if flags & _METRICS else left
        return found, left

    def _scaled(self, units: IntArray) -> IntArray:
        """Font units in 1/64 of a pixel, rounded as FreeType does, by a scale that is itself a fraction of 2^16."""
        scale = ((_PIXELS * _PARTS << 16) + self._units // 2) // self._units
        return np.sign(units) * (np.abs(units) * scale + 0x8000 >> 16)


def _pieces(points: IntArray, on: list[int]) -> Pieces:
    """A contour as lines and quadratic curves, between two points off the curve one on it in their middle."""
    corners = points.tolist()
    if not on[0]:
        # It begins where it ends, or else in the middle between its first and its last point.
        start = corners.pop() if on[-1] else _middle(corners[0], corners[-1])
        on = [1, *(on[:-1] if on[-1] else on)]
        corners = [start, *corners]
    pieces: list[list[list[int]]] = []
    here, control = corners[0], None
    for point, is_on in zip([*corners[1:], corners[0]], [*on[1:], 1], strict=True):
        if control is None:
            if is_on:
                pieces.append([here, point])
                here = point
            else:
                control = point
            continue
        end = point if is_on else _middle(control, point)
        pieces.append([here, control, end])
        here, control = end, None if is_on else point
    return [np.array(piece) / _PARTS / _PIXELS for piece in pieces]


def _middle(a: list[int], b: list[int]) -> list[int]:
    """Between two points, rounded towards zero as C divides."""
    return [int((p + q) / 2) for p, q in zip(a, b, strict=True)]
