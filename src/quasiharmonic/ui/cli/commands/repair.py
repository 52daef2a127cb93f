"""``qhm repair``: repair the inverted triangles of a UV map, with unchanged boundary."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments, material

    parser = commands.add_parser(
        "repair",
        description="Untangle the inverted triangles of the map in the input's texture coordinates (vt). The map "
        "may have seams; each of its islands is repaired separately. Boundaries and all vertices that need not "
        "move stay fixed.",
        epilog="Exit status: 0 every triangle in the written file is certified positive; 1 some are not; 2 wrong input "
        "or call, nothing written; 3 written, but the report failed.",
        examples=(
            "qhm repair model.obj -o repaired.obj",
            "qhm repair model.glb --whole -o repaired.glb",
        ),
    )
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help=f"{format_names('read', 'seams')} file with texture coordinates"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help=f"{format_names('write_map', 'seams')} file to write"
    )
    parser.add_argument(
        "--whole",
        action="store_true",
        help="recompute whole islands that have inverted triangles (default: only patches around them)",
    )
    parser.add_argument(
        "--unmirror",
        action="store_true",
        help="reflect mirrored islands in place (default: keep them, because some are intentional)",
    )
    parser.add_argument(
        "--max-iterations",
        type=arguments.count,
        default=2000,
        metavar="N",
        help="maximum iterations on a whole island (default: 2000)",
    )
    arguments.add_linear_solver(parser)
    material.add_options(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, repair, write, certify, report."""
    from dataclasses import replace

    from quasiharmonic import io
    from quasiharmonic.apps.atlas.atlas_verdict import certify
    from quasiharmonic.apps.repair.uv_repair import repair
    from quasiharmonic.io.seamed_mesh import SeamedMesh
    from quasiharmonic.ui.cli import material, progress_line, report, written_map

    io.find_format(options.output, "write_map", "seams")
    report.check_outputs(options.output, None, options.json, inputs=(options.input,))
    mesh = material.read_mesh(options, options.input)
    if mesh.vt is None or mesh.FT is None or (mesh.FT < 0).any(axis=1).all():
        raise ValueError(
            f"{options.input}: there is no map to repair: no face has texture coordinates (vt) at all three corners"
        )
    with report.about(options.input), progress_line.line() as show:
        result = repair(
            mesh.V,
            mesh.F,
            mesh.vt,
            FT=mesh.FT,
            whole=options.whole,
            unmirror=options.unmirror,
            max_iterations=options.max_iterations,
            linear_solver=options.linear_solver,
            callback=show,
        )
    repaired = replace(mesh, vt=result.uv, FT=result.FT)
    written_map.tell_losses(options.output, repaired)
    io.write_mapped(options.output, repaired)
    written = io.read_mesh(options.output)
    with report.after_writing(options.output):
        verdict = certify(SeamedMesh(written.V, written.F, written.FT, written.vt))
        facts = {
            **result.to_dict(),
            "injective": verdict.injective,
            "input": str(options.input),
            "output": str(options.output),
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
        }
        lines = [f"wrote {options.output}: {result.summary()}"]
        written_map.add_old_textures(facts, lines, mesh, repaired)
        written_map.add_bent(facts, lines, repaired)
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if verdict.injective else 1
