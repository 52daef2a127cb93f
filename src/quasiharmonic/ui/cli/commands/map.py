"""``qhm map``: map a mesh onto a target boundary, and certify the written file.

Place the free vertices of a mesh such that no triangle is inverted. The targets of the fixed vertices are the input's
texture coordinates (vt), or an outline given by --to.

Exit status: 0 the written file is certified injective; 1 a map was written that is not; 2 wrong input or call,
nothing written; 3 a map was written, but the report failed.

    qhm map model.obj --to letter:R -o map.obj
    qhm map problem/ -o map.obj --refine
    qhm map model.glb --to rect:2x1 --corners auto --slide -o map.glb
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import map_options, pipeline, process, report, written_map
from quasiharmonic.ui.cli.arguments import (
    add_files,
    add_options,
    choice,
    declare_options,
    file,
    flag,
    pick,
    set_default,
)
from quasiharmonic.util.options import ENERGIES, DescentOptions, MapOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.io import MeshData
    from quasiharmonic.io.seamed_mesh import Island
    from quasiharmonic.problem import Problem
    from quasiharmonic.problem.result import MapResult
    from quasiharmonic.solver.search.stages import Stages
    from quasiharmonic.ui.cli.map_options import IslandProblem
    from quasiharmonic.ui.cli.written_map import WrittenMap


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(
        parser,
        f"{format_names('read')} file, or a folder with input.obj (or .ply) and handles.txt",
        f"{format_names('write_map')} file to write",
    )
    map_options.add_options(parser)
    kind = (
        "for --plot: map, as described there (default); distortion: the surface and the map coloured by "
        "max(σ₁, 1/σ₂), and its histogram"
    )
    add_options(
        parser,
        plot=file("image to write: the surface, the initial map and the map", metavar="IMAGE"),
        kind=choice(("map", "distortion"), kind),
    )
    add_options(parser, "islands", "pack", "resolution", "padding", "texture", "json", "surface")
    add_options(
        parser.add_mutually_exclusive_group(),
        polish=choice(
            ENERGIES,
            "lower the distortion of the injective map until it converges: %(choices)s (default: 20 steps of blend, "
            "up to 100,000 triangles)",
            metavar="ENERGY",
        ),
        no_polish=flag("keep the first injective map"),
    )
    add_options(parser, "slide", "pieces")
    solver = parser.add_argument_group("solution")
    add_options(solver, *declare_options(MapOptions), **declare_options(DescentOptions))
    add_options(solver, "reference", "linear_solver")


def run(options: argparse.Namespace) -> int:
    """Read, map, write, read back, certify, report."""
    from quasiharmonic import io

    began = time.perf_counter()
    if options.slide and options.no_polish:
        raise ValueError("--slide needs polishing: omit --no-polish")
    map_options.check_pieces(options)
    map_options.check_packing(options)
    set_default(options, "kind", "map", asked=options.plot is not None, belongs="--plot")
    source, fixed = io.problem_files(options.input, options.fixed)
    if options.to is not None:
        # The handles of a folder belong to the target in its own vt.
        fixed = None
    return pipeline.change_map(
        options,
        lambda mesh: _map(options, mesh, source, fixed, began),
        source=source,
        inputs=(fixed, *map_options.files(options)),
    )


def _map(
    options: argparse.Namespace, mesh: MeshData, source: Path, fixed_path: Path | None, began: float
) -> pipeline.Changed:
    """Map a mesh, island by island."""
    from quasiharmonic import io
    from quasiharmonic.apps.atlas.mapped_atlas import each_island, merge_refined
    from quasiharmonic.solver.search.stages import select_strategy

    strategy = select_strategy(options.strategy, **pick(options, *declare_options(DescentOptions)))
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    map_options.check_options(options, mesh, fixed)
    found = map_options.surface(options, mesh, disks_too=False)
    islands = found.mesh.islands
    if len(islands) > 1 and options.slide and options.to is not None:
        raise ValueError(f"--slide supports one island, but the mesh has {len(islands)}")
    posed: list[IslandProblem] = []

    def solve_island(island: Island) -> MapResult:
        posed.append(map_options.make_problem(options, island, fixed, len(posed)))
        return _solve(options, posed[-1], strategy)

    with report.name_source(source):
        mapped = each_island(found.mesh, solve_island, reflect=options.to is None, only=options.islands)
    refined = [one.result.refined for one in mapped.islands]
    refined += [None] * (len(islands) - len(refined))
    new = mesh.with_places(mapped.mesh)
    if any(refined):
        new = merge_refined(mesh, mapped.mesh.islands, refined, mapped.places())
    if options.pack:
        new = new.with_places(map_options.pack_islands(options, io.mapped(new)))

    def describe(written: MeshData) -> pipeline.Account:
        certified = written_map.certify_map(written)
        if options.plot is not None:
            draw(options.plot, certified, posed[0].fitted.problem, mapped, options.kind)
        facts = {
            **mapped.to_dict(),
            **certified.to_dict(),
            "vertices": len(new.V),
            "triangles": len(new.F),
            **_list_facts(options, found.facts, posed, mapped),
            "seconds_in_all": time.perf_counter() - began,
        }
        lines = [written_map.describe_maps(mapped, certified, options.output), *found.notes]
        lines += [*_describe_problems(posed, mapped, islands), *written_map.describe_end(mapped, certified)]
        return pipeline.Account(facts, lines, certified.injective)

    return pipeline.Changed(new, describe)


def _solve(options: argparse.Namespace, posed: IslandProblem, strategy: str | Stages) -> MapResult:
    """Map an island and polish its map, as the options demand. KeyboardInterrupt if there is no map yet."""
    from quasiharmonic.energies.polishing import smooth
    from quasiharmonic.problem.result import Status
    from quasiharmonic.problem.run import run_within
    from quasiharmonic.solver.mapping import solve
    from quasiharmonic.solver.refinement import on_refinement

    problem = posed.fitted.problem
    given = pick(options, "polish", "linear_solver", *declare_options(MapOptions)) | {"strategy": strategy}
    with process.progress_line() as show:
        result = solve(problem, slide=posed.slide if options.polish else False, callback=show, **given)
    if result.status is Status.INTERRUPTED and not result.history:
        raise KeyboardInterrupt
    left = None if options.time_limit is None else options.time_limit - result.seconds
    by_default = not options.no_polish and options.polish is None
    if not by_default or result.status is not Status.INJECTIVE or (left is not None and left <= 0):
        return result
    # The short default polish lowers the worst distortion at little cost.
    fine = on_refinement(problem, result.refined)
    with process.progress_line() as show:
        polish = partial(smooth, fine, result, callback=show, linear_solver=options.linear_solver, slide=posed.slide)
        return run_within(left, polish)


def _list_facts(
    options: argparse.Namespace, facts: dict[str, Any], posed: list[IslandProblem], mapped: MappedAtlas
) -> dict[str, Any]:
    """Return what the report says about the problems, with ``facts`` about the surface."""
    filled = sum(one.fitted.filled_holes for one in posed)
    return {
        "fixed": sum(len(one.fitted.problem.fixed) for one in posed),
        **({} if options.to is None else {"to": options.to}),
        **facts,
        **({"filled_holes": filled} if filled else {}),
        **({"slide": True} if options.slide else {}),
        **({"added_vertices": sum(one.result.added for one in mapped.islands)} if options.refine else {}),
    }


def _describe_problems(posed: list[IslandProblem], mapped: MappedAtlas, islands: Sequence[Island]) -> list[str]:
    """Return the notes on the problems, on added vertices, and on vertices where double precision is insufficient."""
    from quasiharmonic.util.arrays import count_of, names_of

    notes = list(dict.fromkeys(note for one in posed for note in one.notes))
    if added := sum(one.result.added for one in mapped.islands):
        notes.append(f"split {count_of('edge', 'edges', added)}: new vertices are at the end of the list")
    for island, one in zip(islands, mapped.islands, strict=False):
        if one.result.crowded.size:
            crowded = names_of("vertex", "vertices", island.vertices[one.result.crowded])
            notes.append(f"double precision is insufficient next to the fixed {crowded}")
    return notes


def draw(path: Path, certified: WrittenMap, problem: Problem, mapped: MappedAtlas, kind: str = "map") -> None:
    """Draw the rest surface, Tutte's embedding if there is one island, and the map; or the distortion.

    ``problem`` is that of the first island that was mapped, before its refinement.
    """
    import numpy as np

    from quasiharmonic.linsolve import NotPositiveDefinite
    from quasiharmonic.solver.mapping import quasi_harmonic_map
    from quasiharmonic.solver.refinement import on_refinement
    from quasiharmonic.ui.plot import save_distortion_figure, save_map_figure

    V, F, uv = certified.V, certified.F, certified.uv

    def to_frame(uv: NDArray[np.float64]) -> NDArray[np.float64]:
        return problem.frame.inward(uv).view(np.float64).reshape(-1, 2)

    def scale_down(points: NDArray[np.float64]) -> NDArray[np.float64]:
        # Scale to about unit size by a power of two: exact, and coordinates of 1e300 do not overflow.
        return np.ldexp(points, -int(np.frexp(np.abs(points).max())[1]))

    rest = scale_down(V)
    if kind == "distortion":
        return save_distortion_figure(path, rest, F, scale_down(uv))
    if len(mapped.islands) > 1:
        return save_map_figure(path, rest, F, to_frame(uv), inverted=certified.inverted)
    result = mapped.islands[0].result
    problem = on_refinement(problem, result.refined)
    try:
        tutte = to_frame(quasi_harmonic_map(problem, linear_solver=result.linear_solver))
    except NotPositiveDefinite:
        tutte = None
    save_map_figure(path, rest, F, to_frame(uv), tutte, inverted=certified.inverted, fixed=problem.fixed)
