"""Check the options of sliding boundaries, and describe vertices that cannot slide."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.io.seamed_mesh import Island


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
