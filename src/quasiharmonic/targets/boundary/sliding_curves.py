"""The curves of an outline along which a boundary slides, and the file that assigns vertices to its sides."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.lowlevel.textual import read_pairs
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
    for number, (vertex, side) in read_pairs(path, "'vertex side'"):
        if side >= sides:
            there = f"only sides 0 … {sides - 1}" if sides > 1 else "only one side, 0"
            raise MeshFileError(path, f"says side {side}, but the outline has {there}", number)
        if vertex in sides_of:
            raise MeshFileError(path, f"lists vertex {vertex} a second time", number)
        sides_of[vertex] = side
    return sides_of
