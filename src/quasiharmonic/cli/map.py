"""``qhm map``: a mesh file and a place for its boundary → a certified map in a file."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from . import arguments

    parser = commands.add_parser(
        "map",
        help="map a mesh into the plane without inverted triangles",
        description="Place the free vertices of a mesh such that no triangle is inverted. Where the fixed vertices "
        "go is read from the input's texture coordinates (vt).",
        epilog="Exit status: 0 the written file is certified injective; 1 a map was written that is not; "
        "2 wrong input or call, nothing written.",
    )
    parser.add_argument(
        "input", type=Path, help="OBJ file, or a folder with input.obj and handles.txt", metavar="INPUT"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="OBJ or OFF file to write")
    parser.add_argument(
        "--fixed", type=Path, metavar="FILE", help="fixed vertices, 0-based, one a line (default: the boundary)"
    )
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the rest surface, the start and the map")
    arguments.add_report(parser)
    solver = parser.add_argument_group("how it is solved")
    solver.add_argument("--reference", choices=("equilateral", "rest", "corrected"), help="reference triangles")
    solver.add_argument("--max-iterations", type=arguments.positive, default=2000, metavar="N")
    solver.add_argument(
        "--linear-solver", default="auto", choices=("auto", "pardiso", "cholmod", "qdldl", "superlu")
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Map, write, read back, judge, report."""
    from quasiharmonic import io
    from quasiharmonic.certificate import certify
    from quasiharmonic.inject import solve
    from quasiharmonic.problem import Problem

    from . import progress, report

    began = time.perf_counter()
    io.check_output(options.output)
    for extra in (options.plot, *([options.json] if report.is_file(options.json) else [])):
        if extra is not None:
            io.check_writable(extra)
    mesh, arrays = io.read_mesh_problem(options.input, options.fixed)
    problem = Problem(*arrays, reference=options.reference)
    with progress.line() as show:
        result = solve(
            problem, max_iterations=options.max_iterations, linear_solver=options.linear_solver, callback=show
        )
    io.write_map(options.output, mesh, result.uv)
    # The verdict is on the file as a reader gets it.
    written = io.read_mesh(options.output)
    certificate = certify(written.F, io.map_of(written))
    facts: dict[str, Any] = {
        **result.to_dict(),
        **report.verdict(certificate),
        "input": str(options.input),
        "output": str(options.output),
        "vertices": problem.n,
        "triangles": len(problem.F),
        "fixed": len(problem.fixed),
    }
    if options.plot is not None:
        from quasiharmonic.plot import save_map_figure

        save_map_figure(options.plot, problem, result.uv)
    facts["seconds_in_all"] = time.perf_counter() - began
    report.emit(facts, options.json, report.of_map(result, certificate, options.output))
    return 0 if certificate.injective else 1
