"""``qhm polish``: lower the distortion of an injective map of a file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any, TypeAlias

    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.energies.measures import Distortion
    from quasiharmonic.io.seamed_mesh import SeamedMesh
    from quasiharmonic.problem.result import Step
    from quasiharmonic.ui.cli.arguments import Commands

    Lower: TypeAlias = Callable[[SeamedMesh, NDArray[np.int64] | None, Callable[[Step], None] | None], MappedAtlas]


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments, material, seam_options, slide_options

    parser = commands.add_parser(
        "polish",
        description="Lower the distortion of the injective map that the input's texture coordinates (vt) give.",
        epilog="Exit status: 0 the written file is certified injective; 1 it is not; 2 wrong input or call (a map "
        "that is not injective included), nothing written; 3 written, but the report failed.",
        examples=(
            "qhm polish map.obj -o polished.obj",
            "qhm polish map.obj --energy mips --free -o polished.obj",
        ),
    )
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help=f"{format_names('write_map')} file with an injective map"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help=f"{format_names('write_map')} file to write")
    parser.add_argument(
        "--fixed",
        type=Path,
        metavar="FILE",
        help="file of fixed vertices, 0-based, one per line (default: the boundary; with --slide none but the corners)",
    )
    parser.add_argument(
        "--energy", choices=arguments.ENERGIES, default="symmetric-dirichlet", help="(default: symmetric-dirichlet)"
    )
    parser.add_argument("--max-iterations", type=arguments.count, default=200, metavar="N", help="(default: 200)")
    parser.add_argument(
        "--free",
        action="store_true",
        help="free the boundary; each island stays near its position",
    )
    slide_options.add_options(parser)
    parser.add_argument(
        "--to",
        metavar="OUTLINE",
        help="the outline of the boundary, as for qhm map (default: the polygon of the boundary)",
    )
    seam_options.add_islands(parser)
    seam_options.add_packing(parser)
    arguments.add_linear_solver(parser)
    material.add_options(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, polish, write, certify, report."""
    from quasiharmonic.targets.boundary.sliding_curves import find_sliding_curves
    from quasiharmonic.ui.cli import slide_options

    if options.to is not None and not options.slide:
        raise ValueError("--to gives the outline to slide along: add --slide")
    if options.free and (options.slide or options.fixed is not None):
        raise ValueError("--free frees the boundary: omit --slide and --fixed")
    slide_options.check_options(options)

    notes: list[str] = []

    def lower(mesh: SeamedMesh, fixed: NDArray[np.int64] | None, show: Callable[[Step], None] | None) -> MappedAtlas:
        from quasiharmonic.apps.atlas import island_functions as atlas

        given: dict[str, Any] = {
            "energy": options.energy,
            "max_iterations": options.max_iterations,
            "linear_solver": options.linear_solver,
            "callback": show,
            "islands": options.islands,
        }
        if options.free:
            return atlas.polish(mesh, free=True, **given)
        if options.to is not None and len(mesh.islands) > 1:
            raise ValueError(f"--slide --to supports one island, but the mesh has {len(mesh.islands)}")
        if options.to is None:
            return atlas.polish(mesh, fixed=fixed, slide=options.slide, **given)
        curves = find_sliding_curves(options.to, pieces=options.pieces)
        notes.extend(slide_options.describe_off_outline(curves, mesh.islands[0]))
        return atlas.polish(mesh, fixed=fixed, slide=curves, **given)

    return lower_distortion(options, lower, inputs=(options.pieces,), notes=notes)


def lower_distortion(
    options: argparse.Namespace, lower: Lower, inputs: Sequence[Path | None] = (), notes: Sequence[str] = ()
) -> int:
    """Read a map, lower its distortion, write, certify, report; used by every command that does so.

    ``inputs`` are further files that outputs must not replace. ``notes`` are added to the report; `lower` may append to
    them.
    """
    from quasiharmonic import io
    from quasiharmonic.apps.atlas.atlas_verdict import reflect_mirrored
    from quasiharmonic.energies.measures import distortion
    from quasiharmonic.ui.cli import material, progress_line, report, seam_options, written_map

    seam_options.check_packing(options)
    report.check_outputs(options.output, None, options.json, inputs=(options.input, options.fixed, *inputs))
    mesh = material.read_mesh(options, options.input)
    before = io.mapped(mesh)
    fixed = None if options.fixed is None else io.read_handles(options.fixed, len(mesh.V))
    with report.about(options.input), progress_line.line() as show:
        after = lower(before, fixed, show)
    lowered = mesh.with_places(seam_options.pack_islands(options, after.mesh))
    written = written_map.write(options.output, lowered)
    with report.after_writing(options.output):
        # Each map is cut at its own seams, which may differ.
        opened = reflect_mirrored(before).opened(), reflect_mirrored(after.mesh).opened()
        measured = [distortion(*io.without_idle(m.V, m.F, m.uv)) for m in opened if m.uv is not None]
        facts = {
            **after.to_dict(),
            **written.to_dict(),
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
            "input": str(options.input),
            "output": str(options.output),
            "distortion_before": measured[0].to_dict(),
            "distortion": measured[1].to_dict(),
        }
        lines = [written_map.describe_maps(after, written, options.output)]
        if written.injective:
            lines += [*notes, _change(*measured), *([] if written.mirrored else [after.status.value])]
        written_map.add_old_textures(facts, lines, mesh, lowered)
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if written.injective else 1


def _change(before: Distortion, after: Distortion) -> str:
    """Return a sentence about the change of angle and length distortion."""
    angles = [found.statistics("mips").mean for found in (before, after)]
    lengths = [found.statistics("isometric").maximum for found in (before, after)]
    return (
        f"MIPS from {angles[0]:.3g} to {angles[1]:.3g} on average, "
        f"isometric distortion from {lengths[0]:.3g} to {lengths[1]:.3g} at worst"
    )
