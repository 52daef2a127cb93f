"""``qhm plot``: draw the map of a file."""

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
        "plot",
        help="draw a map: inverted triangles, distortion, or a checkerboard on the surface",
        description="Draw the map that the input's texture coordinates (vt) give, injective or not.",
        epilog="Exit status: 0 the picture is written; 2 wrong input or call, nothing written.",
    )
    parser.add_argument("input", type=Path, metavar="FILE", help="OBJ, PLY, GLB or glTF file with a map")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="PICTURE", help="picture to write: .png, .svg or .pdf"
    )
    parser.add_argument(
        "--kind",
        choices=("map", "distortion", "texture"),
        help="map: the surface and the map, inverted triangles in red (default); distortion: both coloured by a "
        "measure, and its histogram; texture: a checkerboard of the plane, or --picture, on the surface",
    )
    parser.add_argument(
        "--measure",
        choices=arguments.MEASURES,
        metavar="NAME",
        help="what --kind distortion shows: %(choices)s (default: isometric)",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="a picture, PNG or JPEG, in place of the checkerboard of --kind texture: the unit square, repeated beyond",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read and draw."""
    from quasiharmonic import io
    from quasiharmonic.geometry.exact.certificate import inverted_triangles
    from quasiharmonic.ui.cli import arguments, report
    from quasiharmonic.ui.plot import save_distortion_figure, save_map_figure, save_texture_figure

    report.check_picture("-o", options.output, inputs=(options.input, options.picture))
    shows_measure = options.kind == "distortion"
    arguments.settle(options, "measure", "isometric", asked=shows_measure, belongs="--kind distortion")
    if options.picture is not None and options.kind not in (None, "texture"):
        raise ValueError(f"--picture is not supported by --kind {options.kind}: use --kind texture, or omit it")
    V, F, uv = io.without_idle(*io.cut_at_seams(io.read_mesh(options.input)))
    with report.about(options.input):
        if options.kind == "distortion":
            save_distortion_figure(options.output, V, F, uv, options.measure)
        elif options.kind == "texture" or options.picture is not None:
            save_texture_figure(options.output, V, F, uv, picture=options.picture)
        else:
            save_map_figure(options.output, V, F, uv, inverted=inverted_triangles(F, uv))
    with report.after_writing(options.output):
        print(f"wrote {options.output}", flush=True)
    return 0
