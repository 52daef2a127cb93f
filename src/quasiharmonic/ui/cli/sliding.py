"""Options for sliding boundaries, and the curves that they slide along."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.geometry.mesh.seams import Island


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--slide`` and ``--pieces``."""
    parser.add_argument(
        "--slide",
        action="store_true",
        help="let boundary vertices slide along the outline while distortion is lowered; corners stay fixed",
    )
    parser.add_argument(
        "--pieces",
        type=Path,
        metavar="FILE",
        help="boundary vertices that are told their side of --to's outline, 0-based, 'vertex side' on each line: sides "
        "run from a corner to the next, counted from 0 along one contour after the other, as they are drawn",
    )


def check_options(options: argparse.Namespace) -> None:
    """Raise ValueError if ``--pieces`` is given without ``--slide`` and ``--to``."""
    if options.pieces is not None and not (options.slide and options.to is not None):
        raise ValueError("--pieces assigns vertices to sides of the outline: add --slide and --to")


def along(
    to: str,
    *,
    font: str | None = None,
    corner_angle: float = 20.0,
    held: Sequence[int] = (),
    pieces: Path | None = None,
) -> BoundaryCurves:
    """Return the curves of an outline for a sliding boundary.

    Parameters
    ----------
    to, font
        As for `quasiharmonic.targets.outline_curves`.
    corner_angle, held
        As for `BoundaryCurves`; ``held`` are the fixed vertices.
    pieces : Path, optional
        A file that assigns vertices to sides of the outline.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        If a line of the file is wrong or names a missing side, or as for `outline_curves`.
    """
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.targets import outline_curves

    curves = outline_curves(to, font=font)
    if pieces is None:
        return BoundaryCurves(curves, fixed=held, corner_angle=corner_angle)
    sides = [side for curve in curves for side in curve.sides(corner_angle)]
    return BoundaryCurves(sides, on=read_pieces(pieces, len(sides)), fixed=held, corner_angle=corner_angle)


def told_off(rails: BoundaryCurves, island: Island) -> list[str]:
    """Return a sentence about the boundary vertices that are not on the curves, if there are any."""
    from quasiharmonic.geometry.mesh.topology import boundary_loops
    from quasiharmonic.util.arrays import named

    loops = boundary_loops(island.F, len(island.V))
    off = island.vertices[rails.off(loops, island.uv)]
    if not off.size:
        return []
    count = sum(loop.size for loop in loops)
    return [f"of {count} boundary vertices {off.size} are off the outline and stay: {named('vertex', 'vertices', off)}"]


def read_pieces(path: Path, sides: int) -> dict[int, int]:
    """Read lines of a vertex and its side; side indices must be below ``sides``.

    Blanks, commas or colons separate the indices; ``#`` starts a comment.
    """
    from quasiharmonic.io.errors import MeshFileError

    told: dict[int, int] = {}
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
        if vertex in told:
            raise MeshFileError(path, f"lists vertex {vertex} a second time", number)
        told[vertex] = side
    return told
