"""The curves of an outline along which a boundary slides, and the file that assigns vertices to its sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.targets.outlines.outline_curves import outline_curves


def find_sliding_curves(
    to: str,
    *,
    font: str | None = None,
    corner_angle: float = 20.0,
    fixed: Sequence[int] = (),
    pieces: Path | None = None,
) -> BoundaryCurves:
    """Return the curves of an outline for a sliding boundary; arguments and errors as `outline_curves`,
    `BoundaryCurves`.

    The file ``pieces`` assigns vertices to sides of the outline; ValueError if a line is wrong or names a missing side.
    """
    curves = outline_curves(to, font=font)
    if pieces is None:
        return BoundaryCurves(curves, fixed=fixed, corner_angle=corner_angle)
    sides = [side for curve in curves for side in curve.sides(corner_angle)]
    return BoundaryCurves(sides, on=read_pieces(pieces, len(sides)), fixed=fixed, corner_angle=corner_angle)


def read_pieces(path: Path, sides: int) -> dict[int, int]:
    """Read lines of a vertex and its side; side indices must be below ``sides``.

    Blanks, commas or colons separate the indices; ``#`` starts a comment.
    """
    sides_of: dict[int, int] = {}
    try:
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise MeshFileError(path, f"cannot be read: {error.strerror or error}") from error
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].replace(",", " ").replace(":", " ").split()
        if not words:
            continue
        if len(words) != 2 or not all(word.isascii() and word.isdigit() for word in words):
            raise MeshFileError(path, f"is not 'vertex side', two whole numbers from 0 on: {line[:60]!r}", number)
        vertex, side = map(int, words)
        if side >= sides:
            there = f"only sides 0 … {sides - 1}" if sides > 1 else "only one side, 0"
            raise MeshFileError(path, f"says side {side}, but the outline has {there}", number)
        if vertex in sides_of:
            raise MeshFileError(path, f"lists vertex {vertex} a second time", number)
        sides_of[vertex] = side
    return sides_of
