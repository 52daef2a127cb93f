"""``qhm check``: certify the map of a file exactly."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.ui.cli import arguments

    parser = commands.add_parser(
        "check",
        help="verify a map: inverted triangles and overlaps",
        description="Verify a planar map exactly: the texture coordinates (vt) of an OBJ file whose faces refer to "
        "them, else the first two coordinates of its vertices. A map with seams is verified in the plane.",
        epilog="Exit status: 0 injective (every triangle strictly positive), or the boundary is listed; 1 not; 2 the "
        "file cannot be verified.",
    )
    parser.add_argument("input", type=Path, metavar="FILE", help="OBJ, PLY, GLB, glTF or OFF file")
    parser.add_argument(
        "--as",
        dest="precision",
        choices=("float64", "float32"),
        help="round the positions to this precision first (default: float64)",
    )
    parser.add_argument(
        "--any-triangulation",
        action="store_true",
        help="also require that every face is convex in the plane, so that the result holds for any triangulation",
    )
    parser.add_argument(
        "--boundary",
        action="store_true",
        help="only list the boundary of the surface: its loops, and corners for qhm map --corners",
    )
    parser.add_argument("--plot", type=Path, metavar="PICTURE", help="draw the boundary that --boundary lists")
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, certify, report; or report the boundary."""
    from quasiharmonic import io
    from quasiharmonic.geometry.exact.convexity import not_convex
    from quasiharmonic.ui.cli import boundary, report
    from quasiharmonic.ui.cli import verdict as judging
    from quasiharmonic.util.arrays import counted, named

    report.check_json(options.json, inputs=(options.input,))
    if options.boundary:
        if options.precision is not None or options.any_triangulation:
            raise ValueError("--boundary verifies no map: omit --as and --any-triangulation")
        return boundary.run(options)
    precision = options.precision or "float64"
    if options.plot is not None:
        raise ValueError("--plot needs --boundary: add it, or use qhm plot")
    mesh = io.read_mesh(options.input)
    judged = judging.judge(mesh, precision=precision)
    further = len(judged.V) - len(mesh.V)
    facts = {
        **judged.to_dict(),
        # Mirrored triangles count as inverted here.
        "injective": judged.certificate.injective,
        "input": str(options.input),
        "precision": precision,
        "triangles": len(mesh.F),
        "further_places": further,
    }
    lines = [f"{options.input}: {judged.certificate.summary()}"]
    if judged.summary() != judged.certificate.summary():
        lines.append(judged.summary().removeprefix(judged.certificate.summary()).strip())
    if further:
        lines.append(f"The map has seams: vertices from {len(mesh.V)} on are copies of vertices on the seams.")
    good = judged.certificate.injective
    if options.any_triangulation:
        bent = not_convex(mesh.polygons, judged.F, judged.uv)
        facts["not_convex"] = bent.tolist()
        good = good and not bent.size
        lines.append(
            f"Not injective for every triangulation: {named('face', 'faces', bent)} not convex in the plane."
            if bent.size
            else f"Every one of {counted('face', 'faces', mesh.faces)} is convex in the plane: the "
            f"result holds for any "
            "triangulation."
        )
    report.emit_verdict(facts, options.json, "\n".join(lines))
    return 0 if good else 1
