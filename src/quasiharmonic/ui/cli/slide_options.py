"""Options for sliding boundaries, and the curves that they slide along."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.io.seamed_mesh import Island


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
        help="file that assigns boundary vertices to sides of --to's outline, 'vertex side' on each line, 0-based; "
        "a side ends at the next corner, and sides count along one contour after another",
    )


def check_options(options: argparse.Namespace) -> None:
    """Raise ValueError if ``--pieces`` is given without ``--slide`` and ``--to``."""
    if options.pieces is not None and not (options.slide and options.to is not None):
        raise ValueError("--pieces assigns vertices to sides of the outline: add --slide and --to")


def describe_off_outline(curves: BoundaryCurves, island: Island) -> list[str]:
    """Return a sentence about the boundary vertices that are not on the curves, if there are any."""
    from quasiharmonic.geometry.mesh.topology import boundary_loops
    from quasiharmonic.util.arrays import names_of

    loops = boundary_loops(island.F, len(island.V))
    off = island.vertices[curves.off(loops, island.uv)]
    if not off.size:
        return []
    count = sum(loop.size for loop in loops)
    off_outline = names_of("vertex", "vertices", off)
    return [f"{off.size} of {count} boundary vertices are off the outline and stay fixed: {off_outline}"]
