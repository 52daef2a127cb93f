"""``qhm harmonise``: lower the distortion of a file's map by any energy, and make it injective."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.io.seamed_mesh import SeamedMesh
    from quasiharmonic.problem.result import Step
    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments, material, seam_options

    parser = commands.add_parser(
        "harmonise",
        description="Lower the distortion of the map in the input's texture coordinates (vt), by an energy that "
        "needs no barrier, and keep or make the map injective. If qhm polish has the energy, it is faster.",
        epilog="Exit status: 0 the written file is certified injective; 1 it is not; 2 wrong input or call (for mips "
        "and symmetric-dirichlet, a map that is not injective included), nothing written; 3 written, but the "
        "report failed.",
        examples=(
            "qhm harmonise map.obj -o better.obj",
            "qhm harmonise map.obj --energy area -o better.obj",
        ),
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help=f"{format_names('write_map')} file with a map")
    parser.add_argument("-o", "--output", type=Path, required=True, help=f"{format_names('write_map')} file to write")
    parser.add_argument(
        "--fixed",
        type=Path,
        metavar="FILE",
        help="file of fixed vertices, 0-based, one per line (default: the boundary)",
    )
    parser.add_argument("--energy", choices=arguments.HARMONISED, default="arap", help="(default: arap)")
    parser.add_argument(
        "--eta",
        type=float,
        nargs="+",
        metavar="ETA",
        help="weight of the energy against injectivity, one for each round (default: four rounds, "
        "depending on the energy)",
    )
    parser.add_argument(
        "--unscaled",
        action="store_true",
        help="compare lengths and areas without first scaling the map to the surface's area",
    )
    parser.add_argument(
        "--max-iterations", type=arguments.count, default=40, metavar="N", help="linear solves per round (default: 40)"
    )
    seam_options.add_packing(parser)
    arguments.add_linear_solver(parser)
    material.add_options(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, harmonise, write, certify, report."""
    if options.unscaled and options.energy == "mips":
        raise ValueError("--unscaled has no effect on mips, which measures angles only: omit --unscaled")
    from quasiharmonic.ui.cli.commands import polish

    def lower(mesh: SeamedMesh, fixed: NDArray[np.int64] | None, show: Callable[[Step], None] | None) -> MappedAtlas:
        from quasiharmonic.apps.atlas import island_functions as atlas

        return atlas.harmonise(
            mesh,
            fixed=fixed,
            energy=options.energy,
            eta=options.eta,
            scaled=not options.unscaled,
            max_iterations=options.max_iterations,
            linear_solver=options.linear_solver,
            callback=show,
        )

    return polish.lower_distortion(options, lower)
