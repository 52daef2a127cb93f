"""``qhm check --boundary``: list and draw the boundary of a surface with vertex numbers."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import pipeline, report

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.targets import BoundaryLoop

# Maximum number of corners per loop.
_MAX_CORNERS = 12
# Minimum turning angle of a corner in degrees, as for outlines.
_MIN_TURN = 20.0
# Maximum number of vertices per loop in the text report.
_LISTED = 100


def run(options: argparse.Namespace) -> int:
    """Read the surface, find its boundary loops, draw them and report."""
    from dataclasses import replace

    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.targets import boundary_turning
    from quasiharmonic.ui.plot import save_boundary_figure
    from quasiharmonic.util.arrays import count_of

    if options.plot is not None:
        report.check_picture("--plot", options.plot, (options.input,))
    mesh = io.read_mesh(options.input)
    with report.about(options.input):
        opened = io.seamed(mesh).opened()
        # A seam vertex has several copies; each boundary copy is listed with the vertex's number.
        origin = np.arange(len(opened.V))
        origin[opened.F] = mesh.F
        turning = boundary_turning(opened.V, opened.F)
        loops = [replace(loop, vertices=origin[loop.vertices]) for loop in turning]
    described = [_describe_loop(loop, mesh.V) for loop in loops]
    facts: dict[str, Any] = {
        "input": str(options.input),
        "vertices": len(mesh.V),
        "triangles": len(mesh.F),
        "loops": described,
    }
    count = count_of("boundary loop", "boundary loops", len(loops)) if loops else "the surface is closed"
    text = [f"{options.input}: {count}; vertices are counted from 0"]
    text += [line for i, one in enumerate(described) for line in _sentences(i, one)]
    if options.plot is not None:
        marked = [corner["vertex"] for loop in described for corner in loop["corners"]]
        save_boundary_figure(options.plot, mesh.V, mesh.F, [loop.vertices for loop in loops], np.array(marked))
        text.append(f"wrote {options.plot}")
    account = pipeline.Account(facts, text)
    if options.plot is None:
        return pipeline.conclude(options, account)
    return pipeline.finish(options, lambda: account, options.plot)


def _describe_loop(loop: BoundaryLoop, V: NDArray[np.float64]) -> dict[str, Any]:
    """Return a loop in plain Python types; its corners sorted by decreasing turning angle."""
    import numpy as np

    positions, turning = loop.corners(min(_MAX_CORNERS, len(loop.vertices)))
    vertices, own = loop.vertices[positions], loop.turning[positions]
    corners = [
        {"vertex": vertex, "place": V[vertex].tolist(), "turning": angle, "turning_at_vertex": alone}
        for vertex, angle, alone in zip(
            vertices.tolist(), np.degrees(turning).tolist(), np.degrees(own).tolist(), strict=True
        )
        if abs(angle) >= _MIN_TURN
    ]
    return {
        "vertices": loop.vertices.tolist(),
        "length": float(loop.lengths.sum()),
        "corners": sorted(corners, key=lambda corner: -abs(float(corner["turning"]))),
    }


def _sentences(i: int, loop: dict[str, Any]) -> list[str]:
    vertices = loop["vertices"]
    more = f", … ({len(vertices)} in all; --json lists them)" if len(vertices) > _LISTED else ""
    lines = [
        f"loop {i}: {len(vertices)} vertices, length {loop['length']:.6g}, the surface to the left",
        "  in order: " + ", ".join(map(str, vertices[:_LISTED])) + more,
    ]
    for corner in loop["corners"]:
        x, y, z = corner["place"]
        lines.append(
            f"  corner: vertex {corner['vertex']} at ({x:.6g}, {y:.6g}, {z:.6g}), turning by "
            f"{corner['turning_at_vertex']:.0f}° at the vertex, by {corner['turning']:.0f}° with its surroundings"
        )
    if not loop["corners"]:
        lines.append(f"  no corner of {_MIN_TURN:g}° or more")
    return lines
