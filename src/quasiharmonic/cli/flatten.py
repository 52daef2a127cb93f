"""``qhm flatten``: a mesh file → a bijective map of it, its boundary where distortion is least."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.cli.arguments import Commands
    from quasiharmonic.io import MeshData
    from quasiharmonic.result import MapResult


# Pieces are so many allowances apart: more than two, or these would touch.
_ROOM = 2.1


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.cli import arguments

    parser = commands.add_parser(
        "flatten",
        help="lay a surface flat, its boundary free, without overlap",
        description="Map a surface with a boundary into the plane, its boundary going where distortion is least. No "
        "triangle is inverted, and nothing overlaps.",
        epilog="Exit status: 0 the written file is certified bijective; 1 it is not; 2 wrong input or call, nothing "
        "written. Ctrl-C writes the best map so far.",
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help="OBJ or OFF file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="OBJ or OFF file to write")
    parser.add_argument(
        "--energy",
        choices=arguments.FLATTENED,
        default="symmetric-dirichlet",
        help="what is lowered; mips is for angles alone, distances for those between vertices some edges apart "
        "(default: symmetric-dirichlet)",
    )
    arguments.add_rings(parser)
    parser.add_argument(
        "--weights", type=Path, metavar="FILE", help="how much each triangle counts, a positive number on each line"
    )
    parser.add_argument(
        "--start", action="store_true", help="begin with the map in the input's texture coordinates (vt)"
    )
    parser.add_argument(
        "--fixed",
        type=Path,
        metavar="FILE",
        help="vertices, 0-based, one a line, that are held where the input's vt have them",
    )
    parser.add_argument("--unit-square", action="store_true", help="scale the map evenly into the unit square")
    parser.add_argument(
        "--cut", action="store_true", help="cut a closed surface, or one with handles, open first (copies vertices)"
    )
    parser.add_argument(
        "--pattern", type=Path, metavar="FILE", help="draw the outline true to scale too, as .svg or .dxf"
    )
    parser.add_argument(
        "--unit", choices=("mm", "cm", "m", "in"), default="mm", help="of the surface, for --pattern (default: mm)"
    )
    parser.add_argument(
        "--allowance", type=float, default=0.0, metavar="WIDTH", help="cut so far outside of the outline, in that unit"
    )
    parser.add_argument(
        "--max-iterations",
        type=arguments.steps,
        default=500,
        metavar="N",
        help="steps on each connected surface; 0 leaves the start as it is (default: 500)",
    )
    arguments.add_linear_solver(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, flatten, write, read back, judge, report."""
    from quasiharmonic import io
    from quasiharmonic.cli import progress, report
    from quasiharmonic.energy.measures import distortion
    from quasiharmonic.exact.certificate import certify
    from quasiharmonic.flattening.distances import distance_error
    from quasiharmonic.flattening.flattened import flatten
    from quasiharmonic.flattening.patterns import write_pattern

    began = time.perf_counter()
    inputs = options.input, options.weights, options.fixed
    report.check_outputs(options.output, None, options.json, inputs, pattern=options.pattern)
    _check_pattern(options)
    mesh = io.read_mesh(options.input)
    given: dict[str, Any] = {}
    if options.start:
        given["start"] = io.map_of(mesh)
    if options.fixed is not None:
        _, _, given["fixed"], given["target"] = io.problem_arrays(mesh, io.read_handles(options.fixed, len(mesh.V)))
    if options.weights is not None:
        given["weights"] = _numbers(options.weights)
    copies = 0
    with report.about(options.input):
        if options.cut:
            if given:
                raise ValueError("--cut makes new vertices, to which --start and --fixed say nothing: leave them out")
            mesh, copies = _opened(mesh)
        with progress.line() as show:
            result = flatten(
                mesh.V,
                mesh.F,
                energy=options.energy,
                unit_square=options.unit_square,
                rings=options.rings,
                gap=_ROOM * options.allowance,
                max_iterations=options.max_iterations,
                linear_solver=options.linear_solver,
                callback=show,
                **given,
            )
    io.write_map(options.output, mesh, result.uv)
    with report.after_writing(options.output):
        written = io.read_mesh(options.output)
        certificate = certify(written.F, io.map_of(written))
        measured = distortion(mesh.V, mesh.F, result.uv)
        facts = {
            **result.to_dict(),
            **report.verdict(certificate),
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
            "copied_vertices": copies,
            "energy": options.energy,
            # Each piece begins anew; of several, none is the energy of all.
            "mean_energy": _mean_energy(result),
            "distortion": measured.to_dict(),
            "input": str(options.input),
            "output": str(options.output),
            "seconds_in_all": time.perf_counter() - began,
        }
        worst = measured.summary("isometric").maximum
        lines = [report.of_map(result, certificate, options.output)]
        if copies:
            lines.append(f"cut open: {copies} vertices along the cut have a copy at the end of the list")
        lines += [f"stretched {worst:.3g} times at worst"]
        if options.energy == "distances":
            error = distance_error(mesh.V, mesh.F, result.uv, rings=options.rings)
            facts["distance_error"] = error.to_dict()
            lines.append(error.summary())
        if options.pattern is not None:
            facts["pattern"] = str(options.pattern)
            write_pattern(options.pattern, mesh.F, result.uv, unit=options.unit, allowance=options.allowance)
            lines.append(f"wrote {options.pattern}, true to scale")
        lines.append(result.status.value)
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if certificate.bijective else 1


def _check_pattern(options: argparse.Namespace) -> None:
    """Refuse before any work what would make no pattern."""
    from quasiharmonic.flattening.patterns import check_pattern

    if options.pattern is None:
        if options.allowance:
            raise ValueError("--allowance is of a pattern: name its file by --pattern")
        return
    if options.unit_square:
        raise ValueError("a pattern is true to scale, and --unit-square is not: leave one of them out")
    check_pattern(options.pattern, unit=options.unit, allowance=options.allowance)


def _mean_energy(result: MapResult) -> float | None:
    """Of a surface in one piece; JSON has neither infinity nor NaN, which pins far apart may bring about."""
    whole = sum(not step.iteration for step in result.history) == 1
    return result.history[-1].energy if whole and isfinite(result.history[-1].energy) else None


def _opened(mesh: MeshData) -> tuple[MeshData, int]:
    """The mesh cut open, if it is closed or has handles, and how many vertices that has copied."""
    from quasiharmonic.apply.cutting import cut_open
    from quasiharmonic.mesh.topology import edges, trace_loops

    found = edges(mesh.F, len(mesh.V))
    euler = len(mesh.V) - len(found.interior) - len(found.boundary) + len(mesh.F)
    if len(found.boundary) and euler == 2 - len(trace_loops(found.boundary)):
        return mesh, 0
    opened = cut_open(mesh.V, mesh.F)
    extra = None if mesh.extra is None else mesh.extra[opened.origin]
    return replace(mesh, V=opened.V, F=opened.F, extra=extra), len(opened.V) - len(mesh.V)


def _numbers(path: Path) -> list[float]:
    """One number on each line."""
    values = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
        text = line.split("#")[0].strip()
        if text:
            try:
                values.append(float(text))
            except ValueError:
                raise ValueError(f"{path}, line {number}: {text!r} is not a number") from None
            if not values[-1] > 0:
                raise ValueError(f"{path}, line {number}: a weight must be positive, not {text}")
    return values
