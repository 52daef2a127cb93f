"""``qhm check``: judge any map in a file, exactly."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.cli import arguments

    parser = commands.add_parser(
        "check",
        help="judge a map: every triangle positive? no overlap?",
        description="Judge a planar map exactly: the texture coordinates (vt) of an OBJ file whose faces refer to "
        "them, else the first two coordinates of its vertices. A map with seams is judged as it lies in the plane.",
        epilog="Exit status: 0 injective (every triangle strictly positive), or the boundary is told; 1 not; 2 the "
        "file cannot be judged.",
    )
    parser.add_argument("input", type=Path, metavar="FILE", help="OBJ or OFF file")
    parser.add_argument(
        "--as",
        dest="precision",
        choices=("float64", "float32"),
        default="float64",
        help="judge the positions as a reader in this precision sees them (default: float64)",
    )
    parser.add_argument(
        "--boundary",
        action="store_true",
        help="judge nothing, but number the boundary of the surface: its loops, and corners for qhm map --corners",
    )
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the boundary that --boundary numbers")
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, judge, report; or tell of the boundary."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.cli import boundary, report
    from quasiharmonic.exact.certificate import certify

    report.check_json(options.json, inputs=(options.input,))
    if options.boundary:
        return boundary.run(options)
    if options.plot is not None:
        raise ValueError("--plot draws what --boundary numbers: ask for that too, or for qhm plot")
    mesh = io.read_mesh(options.input)
    V, F, uv = io.cut_at_seams(mesh)
    if options.precision == "float32":
        with np.errstate(over="ignore"):
            uv = uv.astype(np.float32)
    certificate = certify(F, uv)
    further = len(V) - len(mesh.V)
    facts = {
        **report.verdict(certificate),
        "input": str(options.input),
        "precision": options.precision,
        "triangles": len(mesh.F),
        "further_places": further,
    }
    text = f"{options.input}: {certificate.summary()}"
    if further:
        text += f"\nThe map has seams: vertices from {len(mesh.V)} on are further places of vertices there."
    report.emit(facts, options.json, text)
    return 0 if certificate.injective else 1
