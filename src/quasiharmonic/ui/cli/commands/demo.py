"""``qhm demo``: map a built-in surface onto a letter.

Make the head of a cat, map it onto the letter R, and write demo.obj, demo.png and demo.json.

Exit status: 0 the written map is certified injective; 1 it is not; 2 nothing was written; 3 the map was written, but
the report failed.

    qhm demo
    qhm demo -o folder/
"""

from __future__ import annotations

import argparse
from pathlib import Path

LETTER = "R"


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("qhm-demo"),
        metavar="DIR",
        help="folder to write to (default: qhm-demo)",
    )


def run(options: argparse.Namespace) -> int:
    """Make the surface, map it, write, certify, draw, report."""
    from quasiharmonic import io, targets
    from quasiharmonic.apps.atlas.mapped_atlas import each_island
    from quasiharmonic.geometry import surfaces
    from quasiharmonic.io.seamed_mesh import SeamedMesh
    from quasiharmonic.problem import Problem
    from quasiharmonic.solver.mapping import solve
    from quasiharmonic.ui.cli import process, report, written_map
    from quasiharmonic.ui.cli.commands import map

    folder: Path = options.output
    output = folder / "demo.obj"
    with io.new_folder(folder):
        V, F = surfaces.cat()
        problem = Problem(V, F, *targets.boundary_to(V, F, f"letter:{LETTER}"))
        with process.progress_line() as show:
            mapped = each_island(SeamedMesh(V, F), lambda _: solve(problem, callback=show))
        io.write_mapped(output, io.MeshData(V, F).with_places(mapped.mesh))
    with report.after_writing(output):
        written = written_map.certify_map(io.read_mesh(output))
        map.draw(folder / "demo.png", written, problem, mapped)
        facts = {**mapped.to_dict(), **written.to_dict(), **report.sizes(problem.domain)}
        report.emit(facts, str(folder / "demo.json"), written_map.describe_maps(mapped, written, output))
        print(f"also wrote {folder / 'demo.png'} and {folder / 'demo.json'}", flush=True)
    return 0 if written.injective else 1
