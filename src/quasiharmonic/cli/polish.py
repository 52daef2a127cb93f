"""``qhm polish``: an injective map in a file → one of less distortion."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.cli.arguments import Commands
    from quasiharmonic.energy.measures import Distortion
    from quasiharmonic.problem import Domain
    from quasiharmonic.result import MapResult, Step

    Lower: TypeAlias = Callable[[Domain, NDArray[np.float64], Callable[[Step], None] | None], MapResult]


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.cli import arguments

    parser = commands.add_parser(
        "polish",
        help="lower the distortion of an injective map, which stays injective",
        description="Lower the distortion of the injective map that the input's texture coordinates (vt) give.",
        epilog="Exit status: 0 the written file is certified injective; 1 it is not; 2 wrong input or call (a map "
        "that is not injective included), nothing written; 3 written, but not what should be told about it.",
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help="OBJ file with an injective map")
    parser.add_argument("-o", "--output", type=Path, required=True, help="OBJ or OFF file to write")
    parser.add_argument(
        "--fixed", type=Path, metavar="FILE", help="vertices that stay, 0-based, one a line (default: the boundary)"
    )
    parser.add_argument(
        "--energy", choices=arguments.ENERGIES, default="symmetric-dirichlet", help="(default: symmetric-dirichlet)"
    )
    parser.add_argument("--max-iterations", type=arguments.count, default=200, metavar="N", help="(default: 200)")
    parser.add_argument(
        "--slide", action="store_true", help="let boundary vertices glide along the outline, its corners held"
    )
    parser.add_argument(
        "--to",
        metavar="OUTLINE",
        help="the outline that the boundary is on, as qhm map names it (default: the polygon that the boundary is)",
    )
    arguments.add_linear_solver(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, polish, write, judge, report."""
    if options.to is not None and not options.slide:
        raise ValueError("--to names the outline to slide along: add --slide")

    def lower(domain: Domain, uv: NDArray[np.float64], show: Callable[[Step], None] | None) -> MapResult:
        from quasiharmonic.curves import Rails
        from quasiharmonic.energy.polishing import polish_map
        from quasiharmonic.targets import outline_curves

        return polish_map(
            domain,
            uv,
            energy=options.energy,
            max_iterations=options.max_iterations,
            linear_solver=options.linear_solver,
            callback=show,
            slide=options.slide if options.to is None else Rails(outline_curves(options.to)),
        )

    return improve(options, lower)


def improve(options: argparse.Namespace, lower: Lower) -> int:
    """Read a map, lower its distortion, write, judge, report; for every command that does so."""
    from quasiharmonic import io
    from quasiharmonic.cli import map, progress, report
    from quasiharmonic.energy.measures import distortion
    from quasiharmonic.problem import Domain

    report.check_outputs(options.output, None, options.json, inputs=(options.input, options.fixed))
    mesh = io.read_mesh(options.input)
    uv = io.map_of(mesh)
    fixed = None if options.fixed is None else io.read_handles(options.fixed, len(mesh.V))
    with report.about(options.input):
        V, F, held, _ = io.problem_arrays(mesh, fixed)
        domain = Domain(V, F, held)
        domain.check_boundary_fixed()
        with progress.line() as show:
            result = lower(domain, uv, show)
    certificate = map.write(options.output, mesh, result)
    with report.after_writing(options.output):
        before, after = (distortion(domain.V, domain.F, w) for w in (uv, result.uv))
        facts = {
            **result.to_dict(),
            **report.verdict(certificate),
            **report.sizes(domain),
            "input": str(options.input),
            "output": str(options.output),
            "distortion_before": before.to_dict(),
            "distortion": after.to_dict(),
        }
        lines = [report.of_map(result, certificate, options.output)]
        if certificate.injective:
            lines += [_change(before, after), result.status.value]
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if certificate.injective else 1


def _change(before: Distortion, after: Distortion) -> str:
    """What was won, or paid, in angles and in lengths."""
    angles = [found.summary("mips").mean for found in (before, after)]
    lengths = [found.summary("isometric").maximum for found in (before, after)]
    return (
        f"MIPS from {angles[0]:.3g} to {angles[1]:.3g} on average, "
        f"isometric distortion from {lengths[0]:.3g} to {lengths[1]:.3g} at worst"
    )
