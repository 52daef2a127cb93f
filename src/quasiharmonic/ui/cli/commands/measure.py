"""``qhm measure``: measure the distortion of a map, in summary and per triangle.

Measure the distortion of every triangle by the map in the input's texture coordinates (vt). Means and quantiles are
weighted by the surface's area. For measures of size the map is scaled to the surface's area first. Of a
finite-element mesh, measure the quality of its elements.

Exit status: 0 measured; 2 wrong input or call, nothing written; 3 exported, but the report failed.

    qhm measure map.obj
    qhm measure map.obj --export distortion.ply --json report.json
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import finite_elements, pipeline, report
from quasiharmonic.ui.cli.arguments import add_files, add_options, file, flag, set_default

if TYPE_CHECKING:
    from quasiharmonic.energies.measures import Distortion


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(parser, f"{format_names('write_map')} file with a map, injective or not", metavar=("FILE",))
    add_options(
        parser,
        export=file(f"write every measure of every triangle as {format_names('encode_values')}"),
        distances=flag("also compare distances between vertices some edges apart, along the surface and in the plane"),
    )
    add_options(parser, "rings", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, measure, export, report."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.atlas.atlas_verdict import mirrored_islands, reflect_mirrored
    from quasiharmonic.energies.measures import distortion
    from quasiharmonic.io.registry import has_elements
    from quasiharmonic.util.arrays import names_of

    set_default(options, "rings", 20, asked=options.distances, belongs="--distances")
    if options.export is not None:
        io.find_format(options.export, "encode_values")
    report.check_new({"--export": options.export}, options.json, inputs=(options.input,))
    if has_elements(options.input):
        return finite_elements.measure(options)
    mesh = io.read_mesh(options.input)
    mapped = io.mapped(mesh)
    mirrored = np.flatnonzero(mirrored_islands(mapped))
    turned = mesh.with_places(reflect_mirrored(mapped)) if mirrored.size else mesh
    V, F, uv = io.without_idle(*io.cut_at_seams(turned))
    with report.name_source(options.input):
        found = distortion(V, F, uv, rings=options.rings if options.distances else None)
    if options.export is not None:
        # Viewers colour by the first value; the isometric distortion bounds the error of a texture.
        values = {"isometric": found.isometric, **found.per_triangle()}
        io.write_per_triangle(options.export, V, F, uv, values)
    facts = {**found.to_dict(), "triangles": len(mesh.F)}
    lines = [_table(found, len(mesh.F))]
    if mesh.FT is None:
        lines.append(
            "The surface in the file is flat and equal to the map, so nothing is distorted. To measure the distortion "
            "of the original surface, write the map as OBJ, PLY or glTF."
        )
    if mirrored.size:
        lines.append(f"mirrored {names_of('island', 'islands', mirrored)} measured with reversed orientation")
    if found.distances is not None:
        lines.append(found.distances.summary())
    account = pipeline.Account({"input": str(options.input), **facts}, lines)
    return pipeline.conclude(options, account, options.export)


def _table(found: Distortion, count: int) -> str:
    """Return a table with a line for each measure."""
    lines = [f"{'':20}{'mean':>12}{'median':>12}{'95 %':>12}{'min':>12}{'max':>12}  at"]
    for name, values in found.per_triangle().items():
        if (values != values).all():
            lines.append(f"{name:20}  undefined: no triangle has area")
            continue
        s = found.statistics(name)
        numbers = "".join(f"{value:12.4g}" for value in (s.mean, s.median, s.p95, s.minimum, s.maximum))
        lines.append(f"{name:20}{numbers}  {s.highest}")
    lines.append(f"{len(found.inverted)} of {count} triangles inverted, {len(found.flat)} degenerate in the rest mesh")
    return "\n".join(lines)
