"""``qhm flatten``: compute a bijective map of a mesh with free boundary and low distortion."""

from __future__ import annotations

import argparse
import time
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.ui.cli.arguments import Commands


# Distance between pieces, in allowances; with 2 or less the allowances would touch.
_PIECE_GAP = 2.1


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments, material, seam_options

    parser = commands.add_parser(
        "flatten",
        description="Map a surface with a boundary into the plane. The boundary is free and moves to lower "
        "distortion. No "
        "triangle is inverted, and nothing overlaps.",
        epilog="Exit status: 0 the written file is certified bijective; 1 it is not; 2 wrong input or call, nothing "
        "written; 3 written, but the report failed. Ctrl-C writes the best map so far.",
        examples=(
            "qhm flatten scan.obj -o flat.obj",
            "qhm flatten model.glb --cut --pack --texture checkerboard -o model_uv.glb",
            "qhm flatten shirt.obj --energy arap-barrier --pattern shirt.svg -o shirt_flat.obj",
        ),
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help=f"{format_names('read')} file")
    parser.add_argument("-o", "--output", type=Path, required=True, help=f"{format_names('write_map')} file to write")
    parser.add_argument(
        "--energy",
        choices=arguments.FLATTENED,
        default="symmetric-dirichlet",
        help="energy to lower; mips preserves only angles, distances preserves distances between nearby vertices "
        "(default: symmetric-dirichlet)",
    )
    arguments.add_rings(parser)
    parser.add_argument(
        "--weights", type=Path, metavar="FILE", help="file of triangle weights, one positive number per line"
    )
    parser.add_argument(
        "--start", action="store_true", help="start from the map in the input's texture coordinates (vt)"
    )
    parser.add_argument(
        "--fixed",
        type=Path,
        metavar="FILE",
        help="file of vertices, 0-based, one per line, to fix at the input's vt",
    )
    parser.add_argument("--unit-square", action="store_true", help="scale the map evenly into the unit square")
    seam_options.add_options(parser)
    seam_options.add_islands(parser)
    seam_options.add_packing(parser)
    parser.add_argument(
        "--pattern", type=Path, metavar="FILE", help="also draw the outline true to scale, as .svg or .dxf"
    )
    parser.add_argument(
        "--unit", choices=("mm", "cm", "m", "in"), help="length unit of the surface, for --pattern (default: mm)"
    )
    parser.add_argument(
        "--allowance",
        type=float,
        default=0.0,
        metavar="WIDTH",
        help="distance of the cutting line outside the outline, in that unit",
    )
    parser.add_argument(
        "--max-iterations",
        type=arguments.steps,
        default=500,
        metavar="N",
        help="maximum steps on each connected surface; 0 keeps the start (default: 500)",
    )
    arguments.add_linear_solver(parser)
    material.add_options(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, flatten, write, read back, certify, report."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.atlas import island_functions as atlas
    from quasiharmonic.apps.flattening.patterns import write_pattern
    from quasiharmonic.energies.measures import distortion
    from quasiharmonic.problem.inspection import describe_soup, find_close_vertices
    from quasiharmonic.ui.cli import arguments, material, progress_line, report, seam_options, streams, written_map

    began = time.perf_counter()
    seam_options.check_options(options)
    seam_options.check_packing(options)
    arguments.set_default(options, "rings", 20, asked=options.energy == "distances", belongs="--energy distances")
    arguments.set_default(options, "unit", "mm", asked=options.pattern is not None, belongs="--pattern")
    inputs = (
        options.input,
        options.weights,
        options.fixed,
        None if options.seams in ("file", "none") else Path(options.seams),
    )
    report.check_outputs(options.output, None, options.json, inputs, pattern=options.pattern)
    _check_pattern(options)
    if options.pack and (options.unit_square or options.fixed is not None or options.pattern is not None):
        raise ValueError("--pack determines size and position: omit --unit-square, --fixed and --pattern")
    mesh = material.read_mesh(options, options.input)
    given: dict[str, Any] = {}
    if options.start or options.fixed is not None:
        if options.cut or options.seams != "file":
            raise ValueError("--start and --fixed need the input's map, which new seams discard: omit them")
        # Raises an error that names the missing part of the map.
        io.mapped(mesh)
    if options.fixed is not None:
        given["fixed"] = io.read_handles(options.fixed, len(mesh.V))
    if options.weights is not None:
        given["weights"] = _weights(options.weights)
    found = seam_options.surface(options, mesh, disks_too=True)
    triangles = np.array([len(island.F) for island in found.mesh.islands])
    if (close := find_close_vertices(mesh.V, triangles)).size:
        streams.tell(describe_soup(close))
    with report.about(options.input), progress_line.line() as show:
        mapped = atlas.flatten(
            found.mesh,
            start=options.start,
            energy=options.energy,
            unit_square=options.unit_square,
            rings=options.rings,
            gap=_PIECE_GAP * options.allowance,
            islands=options.islands,
            max_iterations=options.max_iterations,
            linear_solver=options.linear_solver,
            callback=show,
            **given,
        )
    flattened = mesh.with_places(seam_options.pack_islands(options, mapped.mesh))
    certified = written_map.write(options.output, flattened)
    with report.after_writing(options.output):
        # Some formats hold the map alone; their vertices have the numbers of the surface's.
        V = mesh.V if len(mesh.V) == len(certified.V) else certified.V
        flat = io.without_idle(V, certified.F, certified.uv)
        measured = distortion(*flat, rings=options.rings if options.energy == "distances" else None)
        facts = {
            **mapped.to_dict(),
            **certified.to_dict(),
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
            **found.facts,
            "energy": options.energy,
            # Each island has its own energy, so there is no value for several islands.
            "mean_energy": _mean_energy(mapped),
            "distortion": measured.to_dict(),
            "input": str(options.input),
            "output": str(options.output),
            "seconds_in_all": time.perf_counter() - began,
        }
        worst = measured.statistics("isometric").maximum
        lines = [
            written_map.describe_maps(mapped, certified, options.output),
            *found.notes,
            f"maximum stretch {worst:.3g}",
        ]
        if measured.distances is not None:
            lines.append(measured.distances.summary())
        if options.pattern is not None:
            facts["pattern"] = str(options.pattern)
            write_pattern(options.pattern, *flat[1:], unit=options.unit, allowance=options.allowance)
            lines.append(f"wrote {options.pattern}, true to scale")
        lines.append(mapped.status.value)
        written_map.add_old_textures(facts, lines, mesh, flattened)
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if certified.apart else 1


def _check_pattern(options: argparse.Namespace) -> None:
    """Raise ValueError for invalid pattern options, before any work."""
    from quasiharmonic.apps.flattening.patterns import check_pattern

    if options.pattern is None:
        if options.allowance:
            raise ValueError("--allowance needs --pattern: add it")
        return
    if options.unit_square:
        raise ValueError("--pattern is true to scale, but --unit-square scales the map: omit one of them")
    check_pattern(options.pattern, unit=options.unit, allowance=options.allowance)


def _mean_energy(mapped: MappedAtlas) -> float | None:
    """Return the final mean energy of a single bijective island; else None. JSON has neither infinity nor NaN."""
    first = mapped.islands[0].result
    if len(mapped.islands) > 1 or not (first.certificate.bijective and first.history):
        return None
    energy = first.history[-1].energy
    return energy if isfinite(energy) else None


def _weights(path: Path) -> list[float]:
    """Read one positive number per line."""
    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.lowlevel.textual import read_rows

    values = []
    for line, (value,) in read_rows(path, 1):
        if not value > 0:
            raise MeshFileError(path, f"a weight must be positive, not {value:g}", line)
        values.append(value)
    return values
