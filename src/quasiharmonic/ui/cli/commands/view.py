"""``qhm view``: show a surface and its map in a window.

Show a surface and the map in its texture coordinates (vt) in a window, with a checkerboard, distortion and inverted
triangles. Needs the extra 'view'.

Exit status: 0 shown; 2 wrong input or call, or no window can be opened.

    qhm view map.obj
    qhm view map.obj --screenshot view.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

from quasiharmonic.ui.cli import report
from quasiharmonic.ui.cli.arguments import add_options, file


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    parser.add_argument("input", type=Path, metavar="FILE", help=f"{format_names('write_map')} file with a map")
    shot = file("write the view to this file instead of opening a window; needs no display", metavar="PNG")
    add_options(parser, "surface", screenshot=shot)


def run(options: argparse.Namespace) -> int:
    """Read and show."""
    from quasiharmonic import io
    from quasiharmonic.ui.plot.interactive import show

    if options.screenshot is not None:
        report.check_picture("--screenshot", options.screenshot, inputs=(options.input,), endings=(".png",))
    V, F, uv = io.without_idle(*io.cut_at_seams(io.read_mesh(options.input)))
    with report.name_source(options.input):
        show(V, F, uv, screenshot=options.screenshot)
    return 0
