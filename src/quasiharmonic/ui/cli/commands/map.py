"""``qhm map``: map a mesh onto a target boundary, and certify the written file."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.geometry.mesh.refinement import Refined
    from quasiharmonic.io.seamed_mesh import Island
    from quasiharmonic.problem import Problem
    from quasiharmonic.problem.result import MapResult
    from quasiharmonic.ui.cli.arguments import Commands
    from quasiharmonic.ui.cli.targets import IslandProblem
    from quasiharmonic.ui.cli.written_map import WrittenMap


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments, material, seam_options, slide_options, targets

    parser = commands.add_parser(
        "map",
        description="Place the free vertices of a mesh such that no triangle is inverted. The targets of the "
        "fixed vertices "
        "are the input's texture coordinates (vt), or an outline given by --to.",
        epilog="Exit status: 0 the written file is certified injective; 1 a map was written that is not; "
        "2 wrong input or call, nothing written; 3 a map was written, but the report failed.",
        examples=(
            "qhm map model.obj --to letter:R -o map.obj",
            "qhm map problem/ -o map.obj --refine",
            "qhm map model.glb --to rect:2x1 --corners auto --slide -o map.glb",
        ),
    )
    parser.add_argument(
        "input",
        type=Path,
        help=f"{format_names('read')} file, or a folder with input.obj and handles.txt",
        metavar="INPUT",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, help=f"{format_names('write_map')} file to write")
    targets.add_options(parser)
    parser.add_argument("--plot", type=Path, metavar="IMAGE", help="draw the rest surface, the start and the map")
    parser.add_argument(
        "--kind",
        choices=("map", "distortion"),
        help="for --plot: draw that (default), or the surface and the map coloured by max(σ₁, 1/σ₂) with its histogram",
    )
    seam_options.add_islands(parser)
    seam_options.add_packing(parser)
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
    slide_options.add_options(parser)
    solver = parser.add_argument_group("solution")
    arguments.add_strategy(solver)
    solver.add_argument("--reference", choices=("equilateral", "rest", "corrected"), help="reference triangles")
    solver.add_argument("--max-iterations", type=arguments.count, default=2000, metavar="N", help="(default: 2000)")
    arguments.add_linear_solver(solver)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, map, write, read back, certify, report."""
    from quasiharmonic import io
    from quasiharmonic.apps.atlas.mapped_atlas import each_island, merge_refined
    from quasiharmonic.problem.result import Status
    from quasiharmonic.ui.cli import arguments, material, report, seam_options, slide_options, targets, written_map

    began = time.perf_counter()
    if options.slide and options.no_polish:
        raise ValueError("--slide needs polishing: omit --no-polish")
    slide_options.check_options(options)
    seam_options.check_packing(options)
    arguments.set_default(options, "kind", "map", asked=options.plot is not None, belongs="--plot")
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
    found = seam_options.surface(options, mesh, disks_too=False)
    islands = found.mesh.islands
    if len(islands) > 1 and options.slide and options.to is not None:
        raise ValueError(f"--slide supports one island, but the mesh has {len(islands)}")
    posed: list[IslandProblem] = []

    def solve_island(island: Island) -> MapResult:
        one = targets.make_problem(options, island, fixed, len(posed))
        posed.append(one)
        problem = one.fitted.problem
        chosen = options.strategy or "speed", options.polish, options.max_iterations, options.linear_solver
        result = search(problem, *chosen, slide=one.slide if options.polish else False, refine=options.refine)
        if result.status is Status.INTERRUPTED and not result.history:
            raise KeyboardInterrupt
        if not options.no_polish and options.polish is None and result.status is Status.INJECTIVE:
            fine = refined_by(problem, result.refined)
            result = smooth_briefly(fine, result, options.linear_solver, one.slide)
        return result

    with report.about(mesh_path):
        mapped = each_island(found.mesh, solve_island, reflect=options.to is None, only=options.islands)
    refined = [one.result.refined for one in mapped.islands]
    refined += [None] * (len(islands) - len(refined))
    written = mesh.with_places(mapped.mesh)
    if any(refined):
        written = merge_refined(mesh, mapped.mesh.islands, refined, mapped.places())
    if options.pack:
        written = written.with_places(seam_options.pack_islands(options, io.mapped(written)))
    certified = written_map.write(options.output, written)
    added = sum(one.result.added for one in mapped.islands)
    with report.after_writing(options.output):
        if options.plot is not None:
            problems = zip((one.fitted.problem for one in posed), refined, strict=False)
            draw(options.plot, certified, [refined_by(*one) for one in problems], mapped, options.kind)
        facts = {
            **mapped.to_dict(),
            **certified.to_dict(),
            "vertices": len(written.V),
            "triangles": len(written.F),
            "fixed": sum(len(one.fitted.problem.fixed) for one in posed),
            **({} if options.to is None else {"to": options.to}),
            **found.facts,
            **sum_facts([one.facts for one in posed]),
            **({"added_vertices": added} if options.refine else {}),
            "input": str(options.input),
            "output": str(options.output),
            "seconds_in_all": time.perf_counter() - began,
        }
        notes = [*found.notes, *dict.fromkeys(note for one in posed for note in one.notes)]
        if added:
            notes.append(f"split {added} {'edge' if added == 1 else 'edges'}: new vertices are at the end of the list")
        notes += [
            describe_crowded(island.vertices[one.result.crowded])
            for island, one in zip(islands, mapped.islands, strict=False)
            if one.result.crowded.size
        ]
        written_map.add_old_textures(facts, notes, mesh, written)
        report.emit(
            facts, options.json, "\n".join([written_map.describe_maps(mapped, certified, options.output), *notes])
        )
    return 0 if certified.injective else 1


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
    from quasiharmonic.solver.mapping import solve
    from quasiharmonic.ui.cli import progress_line

    with progress_line.line() as show:
        return solve(
            problem,
            strategy=strategy,
            polish=polish,
            max_iterations=max_iterations,
            linear_solver=linear_solver,
            callback=show,
            slide=slide,
            refine=refine,
        )


def refined_by(problem: Problem, refined: Refined | None) -> Problem:
    """Return the problem on the refined mesh of a result."""
    if refined is None:
        return problem
    from quasiharmonic.solver.refine.attempts import on_refinement

    return on_refinement(problem, refined)


def smooth_briefly(
    problem: Problem, result: MapResult, linear_solver: str, slide: bool | BoundaryCurves = False
) -> MapResult:
    """Run the short default polish, which lowers the worst distortion at little cost."""
    from quasiharmonic.energies.polishing import smooth
    from quasiharmonic.ui.cli import progress_line

    with progress_line.line() as show:
        return smooth(problem, result, linear_solver=linear_solver, callback=show, slide=slide)


def describe_crowded(vertices: NDArray[np.int64]) -> str:
    """Return a sentence about vertices where double precision is too coarse for a map."""
    from quasiharmonic.util.arrays import names_of

    return f"double precision is insufficient next to the fixed {names_of('vertex', 'vertices', vertices)}"


def sum_facts(facts: list[dict[str, int]]) -> dict[str, int]:
    """Return the sum of the report entries of all islands."""
    total: dict[str, int] = {}
    for one in facts:
        for name, value in one.items():
            total[name] = value if isinstance(value, bool) else total.get(name, 0) + value
    return total


def draw(path: Path, certified: WrittenMap, problems: list[Problem], mapped: MappedAtlas, kind: str = "map") -> None:
    """Draw the rest surface, Tutte's embedding if there is one island, and the map; or the distortion."""
    import numpy as np

    from quasiharmonic.linsolve import NotPositiveDefinite
    from quasiharmonic.solver.mapping import quasi_harmonic_map
    from quasiharmonic.ui.plot import save_distortion_figure, save_map_figure

    V, F, uv = certified.V, certified.F, certified.uv
    problem = problems[0]

    def to_frame(uv: NDArray[np.float64]) -> NDArray[np.float64]:
        return problem.frame.inward(uv).view(np.float64).reshape(-1, 2)

    def scale_down(points: NDArray[np.float64]) -> NDArray[np.float64]:
        # Scale to about unit size by a power of two: exact, and coordinates of 1e300 do not overflow.
        return np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))

    rest = scale_down(V)
    if kind == "distortion":
        return save_distortion_figure(path, rest, F, scale_down(uv))
    if len(problems) > 1:
        return save_map_figure(path, rest, F, to_frame(uv), inverted=certified.inverted)
    try:
        tutte = to_frame(quasi_harmonic_map(problem, linear_solver=mapped.islands[0].result.linear_solver))
    except NotPositiveDefinite:
        tutte = None
    save_map_figure(path, rest, F, to_frame(uv), tutte, inverted=certified.inverted, fixed=problem.fixed)
