"""``qhm map``: map a mesh onto a target boundary, and certify the written file."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.mapped import MappedAtlas
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.geometry.mesh.refinement import Refined
    from quasiharmonic.geometry.mesh.seams import Island
    from quasiharmonic.problem import Problem
    from quasiharmonic.problem.result import MapResult
    from quasiharmonic.ui.cli.arguments import Commands
    from quasiharmonic.ui.cli.targets import Posed
    from quasiharmonic.ui.cli.verdict import Judged


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.ui.cli import arguments, material, seams, sliding, targets

    parser = commands.add_parser(
        "map",
        help="map a mesh into the plane without inverted triangles",
        description="Place the free vertices of a mesh such that no triangle is inverted. The targets of the "
        "fixed vertices "
        "are the input's texture coordinates (vt), or an outline given by --to.",
        epilog="Exit status: 0 the written file is certified injective; 1 a map was written that is not; "
        "2 wrong input or call, nothing written; 3 a map was written, but the report failed.",
    )
    parser.add_argument(
        "input",
        type=Path,
        help="OBJ, OFF, PLY, GLB, glTF or STL file, or a folder with input.obj and handles.txt",
        metavar="INPUT",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help="OBJ, PLY, GLB, glTF or OFF file to write")
    targets.add_options(parser)
    parser.add_argument("--plot", type=Path, metavar="PICTURE", help="draw the rest surface, the start and the map")
    parser.add_argument(
        "--plot-kind",
        choices=("map", "distortion"),
        help="for --plot: draw that (default), or the surface and the map coloured by max(σ₁, 1/σ₂) with its histogram",
    )
    seams.add_packing(parser)
    material.add_options(parser)
    arguments.add_report(parser)
    distortion = parser.add_mutually_exclusive_group()
    distortion.add_argument(
        "--polish",
        choices=arguments.ENERGIES,
        metavar="ENERGY",
        help="then lower distortion until it converges: %(choices)s (default: 20 steps of blend, up to "
        "100,000 triangles)",
    )
    distortion.add_argument("--no-polish", action="store_true", help="keep the first injective map")
    sliding.add_options(parser)
    solver = parser.add_argument_group("solution")
    arguments.add_strategy(solver)
    solver.add_argument("--reference", choices=("equilateral", "rest", "corrected"), help="reference triangles")
    solver.add_argument("--max-iterations", type=arguments.count, default=2000, metavar="N", help="(default: 2000)")
    arguments.add_linear_solver(solver)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, map, write, read back, certify, report."""
    from quasiharmonic import io
    from quasiharmonic.apps.atlas.mapped import each_island
    from quasiharmonic.apps.atlas.refined import written_over
    from quasiharmonic.problem.result import Status
    from quasiharmonic.ui.cli import arguments, material, report, seams, sliding, targets
    from quasiharmonic.ui.cli import verdict as judging

    began = time.perf_counter()
    if options.slide and options.no_polish:
        raise ValueError("--slide needs polishing: omit --no-polish")
    sliding.check_options(options)
    seams.check_packing(options)
    arguments.settle(options, "plot_kind", "map", asked=options.plot is not None, belongs="--plot")
    mesh_path, fixed_path = io.problem_files(options.input, options.fixed)
    if options.to is not None:
        # The handles of a folder belong to the target in its own vt.
        fixed_path = None
    report.check_outputs(
        options.output, options.plot, options.json, inputs=(mesh_path, fixed_path, *targets.files(options))
    )
    mesh = material.read_mesh(options, mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    targets.check_options(options, mesh, fixed)
    found = seams.surface(options, mesh, disks_too=False)
    islands = found.mesh.islands
    if len(islands) > 1 and options.slide and options.to is not None:
        raise ValueError(f"--slide supports one island, but the mesh has {len(islands)}")
    posed: list[Posed] = []

    def solved(island: Island) -> MapResult:
        one = targets.pose(options, island, fixed, len(posed))
        posed.append(one)
        problem = one.fitted.problem
        chosen = options.strategy or "speed", options.polish, options.max_iterations, options.linear_solver
        result = search(problem, *chosen, slide=one.slide if options.polish else False, refine=options.refine)
        if result.status is Status.INTERRUPTED and not result.history:
            raise KeyboardInterrupt
        if not options.no_polish and options.polish is None and result.status is Status.INJECTIVE:
            fine = refined_by(problem, result.refined)
            result = smoothed(fine, result, options.linear_solver, one.slide)
        return result

    with report.about(mesh_path):
        mapped = each_island(found.mesh, solved, reflect=options.to is None)
    refined = [one.result.refined for one in mapped.islands]
    refined += [None] * (len(islands) - len(refined))
    written = mesh.with_places(mapped.mesh)
    if any(refined):
        written = written_over(mesh, mapped.mesh.islands, refined, mapped.places())
    if options.pack:
        written = written.with_places(seams.laid_out(options, io.mapped(written)))
    judged = judging.write(options.output, written)
    added = sum(one.result.added for one in mapped.islands)
    with report.after_writing(options.output):
        if options.plot is not None:
            problems = zip((one.fitted.problem for one in posed), refined, strict=False)
            draw(options.plot, judged, [refined_by(*one) for one in problems], mapped, options.plot_kind)
        facts = {
            **mapped.to_dict(),
            **judged.to_dict(),
            "vertices": len(written.V),
            "triangles": len(written.F),
            "fixed": sum(len(one.fitted.problem.fixed) for one in posed),
            **({} if options.to is None else {"to": options.to}),
            **found.facts,
            **summed([one.facts for one in posed]),
            **({"added_vertices": added} if options.refine else {}),
            "input": str(options.input),
            "output": str(options.output),
            "seconds_in_all": time.perf_counter() - began,
        }
        notes = [*found.notes, *dict.fromkeys(note for one in posed for note in one.notes)]
        if added:
            notes.append(f"split {added} {'edge' if added == 1 else 'edges'}: new vertices are at the end of the list")
        notes += [
            crowded_note(island.vertices[one.result.crowded])
            for island, one in zip(islands, mapped.islands, strict=False)
            if one.result.crowded.size
        ]
        report.emit(facts, options.json, "\n".join([report.of_maps(mapped, judged, options.output), *notes]))
    return 0 if judged.injective else 1


def search(
    problem: Problem,
    strategy: str,
    polish: str | None,
    max_iterations: int,
    linear_solver: str,
    slide: bool | BoundaryCurves = False,
    refine: bool = False,
) -> MapResult:
    """Solve with progress on the terminal."""
    from quasiharmonic.solver.search.solving import solve
    from quasiharmonic.ui.cli import progress

    way = solve
    if refine:
        from quasiharmonic.solver.refine.attempts import solve_refining

        way = solve_refining
    with progress.line() as show:
        return way(
            problem,
            strategy=strategy,
            polish=polish,
            max_iterations=max_iterations,
            linear_solver=linear_solver,
            callback=show,
            slide=slide,
        )


def refined_by(problem: Problem, refined: Refined | None) -> Problem:
    """Return the problem on the refined mesh of a result."""
    if refined is None:
        return problem
    from quasiharmonic.solver.refine.attempts import on_refinement

    return on_refinement(problem, refined)


def smoothed(
    problem: Problem, result: MapResult, linear_solver: str, slide: bool | BoundaryCurves = False
) -> MapResult:
    """Run the short default polish, which lowers the worst distortion at little cost."""
    from quasiharmonic.energies import smoothing
    from quasiharmonic.ui.cli import progress

    with progress.line() as show:
        return smoothing.smoothed(problem, result, linear_solver=linear_solver, callback=show, slide=slide)


def crowded_note(vertices: NDArray[np.int64]) -> str:
    """Return a sentence about vertices where double precision is too coarse for a map."""
    from quasiharmonic.util.arrays import named

    return f"double precision is insufficient next to the fixed {named('vertex', 'vertices', vertices)}"


def summed(facts: list[dict[str, int]]) -> dict[str, int]:
    """Return the sum of the report entries of all islands."""
    total: dict[str, int] = {}
    for one in facts:
        for name, value in one.items():
            total[name] = value if isinstance(value, bool) else total.get(name, 0) + value
    return total


def draw(path: Path, judged: Judged, problems: list[Problem], mapped: MappedAtlas, kind: str = "map") -> None:
    """Draw the rest surface, Tutte's embedding if there is one island, and the map; or the distortion."""
    import numpy as np

    from quasiharmonic.linsolve import NotPositiveDefinite
    from quasiharmonic.solver.search.solving import quasi_harmonic_map
    from quasiharmonic.ui.plot import save_distortion_figure, save_map_figure

    V, F, uv = judged.V, judged.F, judged.uv
    problem = problems[0]

    def framed(uv: NDArray[np.float64]) -> NDArray[np.float64]:
        return problem.frame.inward(uv).view(np.float64).reshape(-1, 2)

    def halved(places: NDArray[np.float64]) -> NDArray[np.float64]:
        # Scale to about unit size by a power of two: exact, and coordinates of 1e300 do not overflow.
        return np.ldexp(places, -int(np.frexp(np.abs(places).max())[1]))

    rest = halved(V)
    if kind == "distortion":
        return save_distortion_figure(path, rest, F, halved(uv))
    if len(problems) > 1:
        return save_map_figure(path, rest, F, framed(uv), inverted=judged.inverted)
    try:
        tutte = framed(quasi_harmonic_map(problem, linear_solver=mapped.islands[0].result.linear_solver))
    except NotPositiveDefinite:
        tutte = None
    save_map_figure(path, rest, F, framed(uv), tutte, inverted=judged.inverted, fixed=problem.fixed)
