"""``qhm harmonise``: lower the distortion of a file's map by any energy, and make it injective.

Lower the distortion of the map in the input's texture coordinates (vt), by an energy that needs no barrier, and keep
or make the map injective. If qhm polish has the energy, it is faster.

Exit status: 0 the written file is certified injective; 1 it is not; 2 wrong input or call (for mips and
symmetric-dirichlet, a map that is not injective included), nothing written; 3 written, but the report failed.

    qhm harmonise map.obj -o better.obj
    qhm harmonise map.obj --energy area -o better.obj
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli.arguments import add_files, add_options, declare_options, flag, number
from quasiharmonic.ui.cli.commands import polish
from quasiharmonic.util.options import HarmoniseOptions

if TYPE_CHECKING:
    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.io.seamed_mesh import SeamedMesh


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    form = format_names("write_map")
    add_files(parser, f"{form} file with a map", f"{form} file to write")
    add_options(
        parser,
        "fixed",
        **declare_options(HarmoniseOptions),
        eta=number(
            float,
            "weight of the energy against injectivity, one for each round (default: four rounds, "
            "depending on the energy)",
            metavar="ETA",
            nargs="+",
        ),
        unscaled=flag("compare lengths and areas without first scaling the map to the surface's area"),
    )
    add_options(parser, "pack", "resolution", "padding", "linear_solver", "texture", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, harmonise, write, certify, report."""
    if options.unscaled and options.energy == "mips":
        raise ValueError("--unscaled has no effect on mips, which measures angles only: omit --unscaled")

    def lower(mesh: SeamedMesh, given: dict[str, Any]) -> MappedAtlas:
        from quasiharmonic.apps.atlas import island_functions as atlas

        return atlas.harmonise(mesh, eta=options.eta, scaled=not options.unscaled, **given)

    return polish.lower_distortion(options, lower)
