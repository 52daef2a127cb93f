"""``qhm plot``: draw the map of a file.

Draw the map that the input's texture coordinates (vt) give, injective or not. A displacement field is drawn with its
folds, and a finite-element mesh with its element quality.

Exit status: 0 the image is written; 2 wrong input or call, nothing written.

    qhm plot map.obj -o map.png
    qhm plot map.obj --kind distortion --measure area_ratio -o distortion.svg
    qhm plot model.glb --kind unwrap -o model.png
    qhm plot field.npy -o folds.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

from quasiharmonic.ui.cli import finite_elements, report, written_map
from quasiharmonic.ui.cli.arguments import MEASURES, add_files, add_options, choice, set_default, text
from quasiharmonic.ui.cli.pipeline import CHECKERBOARD


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(
        parser,
        f"{format_names('write_map')} file with a map, a finite-element mesh, or a displacement field (.npy, .nii, "
        ".nii.gz, .mha, .nrrd)",
        "image to write: .png, .svg or .pdf",
        metavar=("FILE", "IMAGE"),
    )
    add_options(
        parser,
        kind=choice(
            ("map", "distortion", "texture", "unwrap"),
            "map: the surface and the map, inverted triangles in red (default); distortion: both coloured by a "
            "measure, and its histogram; texture: the surface with the model's own texture, --texture, or a "
            "checkerboard; unwrap: the charts, and the surface with a checkerboard, the stretch and the texel density",
        ),
        measure=choice(MEASURES, "measure for --kind distortion: %(choices)s (default: isometric)", metavar="NAME"),
        texture=text(
            "IMAGE",
            "texture of --kind texture: a PNG or JPEG file, which repeats beyond the unit square, or checkerboard "
            "(default: the model's own texture if it has one)",
        ),
    )
    add_options(parser, "surface")


def run(options: argparse.Namespace) -> int:
    """Read and draw."""
    from quasiharmonic import io
    from quasiharmonic.io.fields import FIELD_SUFFIXES, read_field
    from quasiharmonic.io.registry import has_elements
    from quasiharmonic.ui.plot import (
        plot_field,
        plot_unwrap,
        save_distortion_figure,
        save_map_figure,
        save_texture_figure,
    )
    from quasiharmonic.ui.plot.canvas import save_picture

    image = None if options.texture in (None, CHECKERBOARD) else Path(options.texture)
    report.check_picture("-o", options.output, inputs=(options.input, image))
    if options.input.name.lower().endswith(FIELD_SUFFIXES):
        if (options.kind, options.measure, options.texture) != (None, None, None):
            raise ValueError(f"{options.input} is a displacement field: omit --kind, --measure and --texture")
        given = read_field(options.input)
        with report.name_source(options.input):
            save_picture(options.output, plot_field(given.field, spacing=given.spacing))
        return report.tell_written(options.output)
    if has_elements(options.input, FIELD_SUFFIXES):
        return finite_elements.plot(options)
    shows_measure = options.kind == "distortion"
    set_default(options, "measure", "isometric", asked=shows_measure, belongs="--kind distortion")
    if options.texture is not None and options.kind not in (None, "texture"):
        raise ValueError(f"--texture is not supported by --kind {options.kind}: use --kind texture, or omit it")
    mesh = io.read_mesh(options.input)
    V, F, uv = io.without_idle(*io.cut_at_seams(mesh))
    with report.name_source(options.input):
        if options.kind == "distortion":
            save_distortion_figure(options.output, V, F, uv, options.measure)
        elif options.kind == "unwrap":
            save_picture(options.output, plot_unwrap(V, F, uv))
        elif options.kind == "texture" or options.texture is not None:
            texture = io.own_texture(mesh) if options.texture is None else image
            save_texture_figure(options.output, V, F, uv, texture=texture)
        else:
            save_map_figure(options.output, V, F, uv, inverted=written_map.certify_map(mesh).inverted)
    return report.tell_written(options.output)
