"""``qhm map``: a mesh file and a place for its boundary → a certified map in a file."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.cli.arguments import Commands
    from quasiharmonic.curves import Rails
    from quasiharmonic.exact.certificate import Certificate
    from quasiharmonic.io import MeshData
    from quasiharmonic.problem import Problem
    from quasiharmonic.result import MapResult

# What is done unasked. On some 10,000 triangles these steps take a few times as long as the first map, and go nearly as
# far as convergence: a fifth of the MIPS energy, a hundredth of the worst stretch. On larger meshes they are felt.
STEPS, LARGEST = 20, 100_000


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.cli import arguments, targets

    parser = commands.add_parser(
        "map",
        help="map a mesh into the plane without inverted triangles",
        description="Place the free vertices of a mesh such that no triangle is inverted. Where the fixed vertices "
        "go is read from the input's texture coordinates (vt), or chosen by --to.",
        epilog="Exit status: 0 the written file is certified injective; 1 a map was written that is not; "
        "2 wrong input or call, nothing written; 3 a map was written, but not what should be told about it.",
    )
    parser.add_argument(
        "input", type=Path, help="OBJ file, or a folder with input.obj and handles.txt", metavar="INPUT"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="OBJ or OFF file to write")
    targets.add_options(parser)
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw the rest surface, the start and the map")
    parser.add_argument(
        "--plot-kind",
        choices=("map", "distortion"),
        default="map",
        help="draw that (default), or the surface and the map coloured by max(σ₁, 1/σ₂), with its histogram",
    )
    arguments.add_report(parser)
    distortion = parser.add_mutually_exclusive_group()
    distortion.add_argument(
        "--polish",
        choices=arguments.ENERGIES,
        metavar="ENERGY",
        help="then lower distortion until it converges: %(choices)s (default: 20 steps of blend, up to "
        "100,000 triangles)",
    )
    distortion.add_argument("--no-polish", action="store_true", help="leave the first injective map as it is found")
    parser.add_argument(
        "--slide",
        action="store_true",
        help="let boundary vertices glide along the outline while distortion is lowered, its corners held",
    )
    solver = parser.add_argument_group("how it is solved")
    solver.add_argument(
        "--strategy", choices=("speed", "quality"), default="speed", help="soonest, or slower and kinder to angles"
    )
    solver.add_argument("--reference", choices=("equilateral", "rest", "corrected"), help="reference triangles")
    solver.add_argument("--max-iterations", type=arguments.count, default=2000, metavar="N", help="(default: 2000)")
    arguments.add_linear_solver(solver)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Map, write, read back, judge, report."""
    from quasiharmonic import io
    from quasiharmonic.cli import report, targets
    from quasiharmonic.result import Status

    began = time.perf_counter()
    if options.slide and options.no_polish:
        raise ValueError("--slide moves the boundary while distortion is lowered, which --no-polish forbids")
    mesh_path, fixed_path = io.problem_files(options.input, options.fixed)
    if options.to is not None:
        # The handles of a folder say which vertices its own vt hold.
        fixed_path = None
    report.check_outputs(
        options.output, options.plot, options.json, inputs=(mesh_path, fixed_path, *targets.files(options))
    )
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    posed = targets.pose(options, mesh, fixed)
    problem, slide = posed.problem, posed.slide
    found = options.strategy, options.polish, options.max_iterations, options.linear_solver
    result = search(problem, *found, slide=slide if options.polish else False)
    if result.status is Status.INTERRUPTED and not result.history:
        raise KeyboardInterrupt
    if not options.no_polish and options.polish is None and result.status is Status.INJECTIVE:
        result = smoothed(problem, result, slide)
    certificate = write(options.output, posed.mesh, result)
    with report.after_writing(options.output):
        if options.plot is not None:
            draw(options.plot, problem, result, certificate, options.plot_kind)
        facts = {
            **result.to_dict(),
            **report.verdict(certificate),
            **report.sizes(problem.domain),
            **posed.facts,
            "input": str(options.input),
            "output": str(options.output),
            "seconds_in_all": time.perf_counter() - began,
        }
        report.emit(facts, options.json, "\n".join([report.of_map(result, certificate, options.output), *posed.notes]))
    return 0 if certificate.injective else 1


def search(
    problem: Problem,
    strategy: str,
    polish: str | None,
    max_iterations: int,
    linear_solver: str,
    slide: bool | Rails = False,
) -> MapResult:
    """Solve with progress on the terminal."""
    from quasiharmonic.cli import progress
    from quasiharmonic.search.solving import solve

    with progress.line() as show:
        return solve(
            problem,
            strategy=strategy,
            polish=polish,
            max_iterations=max_iterations,
            linear_solver=linear_solver,
            callback=show,
            slide=slide,
        )


def smoothed(problem: Problem, result: MapResult, slide: bool | Rails = False) -> MapResult:
    """Take the worst distortion off a map, where that is cheap: what this command does unasked."""
    from quasiharmonic.cli import progress
    from quasiharmonic.energy.polishing import polished
    from quasiharmonic.mesh.shapes import rest_shapes
    from quasiharmonic.result import Status

    if (len(problem.F) > LARGEST and slide is False) or rest_shapes(problem.V, problem.F).flat.size:
        return result
    with progress.line() as show:
        smoother = polished(problem, result, energy="blend", max_iterations=STEPS, callback=show, slide=slide)
    # Nobody asked for convergence, so it is not missed.
    interrupted = smoother.status is Status.INTERRUPTED
    return smoother if interrupted else replace(smoother, status=Status.INJECTIVE)


def write(output: Path, mesh: MeshData, result: MapResult) -> Certificate:
    """Write a map and judge the file as a reader gets it."""
    from quasiharmonic import io
    from quasiharmonic.cli import report
    from quasiharmonic.exact.certificate import certify

    io.write_map(output, mesh, result.uv)
    with report.after_writing(output):
        written = io.read_mesh(output)
        return certify(written.F, io.map_of(written))


def draw(path: Path, problem: Problem, result: MapResult, certificate: Certificate, kind: str = "map") -> None:
    """Draw the rest surface, Tutte's embedding and the map; or how it distorts."""
    import numpy as np

    from quasiharmonic.linsolve import NotPositiveDefinite
    from quasiharmonic.plot import save_distortion_figure, save_map_figure
    from quasiharmonic.search.solving import quasi_harmonic_map

    def framed(uv: NDArray[np.float64]) -> NDArray[np.float64]:
        # Of unit size, so that a picture of coordinates of 1e300 does not overflow.
        return problem.frame.inward(uv).view(np.float64).reshape(-1, 2)

    rest = np.ldexp(problem.V, -int(np.frexp(np.abs(problem.V).max())[1]))
    if kind == "distortion":
        return save_distortion_figure(path, rest, problem.F, framed(result.uv))
    try:
        tutte = framed(quasi_harmonic_map(problem, linear_solver=result.linear_solver))
    except NotPositiveDefinite:
        tutte = None
    inverted = np.concatenate([certificate.flipped, certificate.degenerate])
    save_map_figure(path, rest, problem.F, framed(result.uv), tutte, flipped=inverted, fixed=problem.fixed)
