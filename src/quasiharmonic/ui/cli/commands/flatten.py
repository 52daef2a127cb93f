"""``qhm flatten``: compute a bijective map of a mesh with free boundary and low distortion.

Map a surface with a boundary into the plane. The boundary is free and moves to lower distortion. No triangle is
inverted, and nothing overlaps.

Exit status: 0 the written file is certified bijective; 1 it is not; 2 wrong input or call, nothing written; 3
written, but the report failed. Ctrl-C writes the best map so far.

    qhm flatten scan.obj -o flat.obj
    qhm flatten model.glb --cut --pack --texture checkerboard -o model_uv.glb
    qhm flatten shirt.obj --energy arap-barrier --pattern shirt.svg -o shirt_flat.obj
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
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
    number,
    pick,
    set_default,
    weld,
)
from quasiharmonic.util.options import FlattenOptions
from quasiharmonic.util.outcome import replace_nonfinite

if TYPE_CHECKING:
    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.io import MeshData


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(parser, f"{format_names('read')} file", f"{format_names('write_map')} file to write")
    add_options(
        parser,
        **declare_options(FlattenOptions),
        weights=file("file of triangle weights, one positive number per line"),
        start=flag("start from the map in the input's texture coordinates (vt)"),
        fixed=file("file of vertices to fix at their positions in the input's vt, 0-based, one per line"),
    )
    add_options(
        parser,
        *("rings", "cut", "seams", "islands", "pack", "resolution", "padding"),
        weld=weld("no"),
        pattern=file("also draw the outline true to scale, as .svg or .dxf"),
        unit=choice(("mm", "cm", "m", "in"), "length unit of the surface, for --pattern (default: mm)"),
        allowance=number(
            float,
            "distance of the cutting line outside the outline, in the unit of --unit",
            metavar="WIDTH",
            default=0.0,
        ),
    )
    add_options(parser, "linear_solver", "texture", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, flatten, write, read back, certify, report."""
    began = time.perf_counter()
    map_options.check_seams(options)
    map_options.check_packing(options)
    set_default(options, "rings", 20, asked=options.energy == "distances", belongs="--energy distances")
    set_default(options, "unit", "mm", asked=options.pattern is not None, belongs="--pattern")
    _check_options(options)
    seams = None if options.seams in ("file", "none") else Path(options.seams)
    return pipeline.change_map(
        options, lambda mesh: _flatten(options, mesh, began), inputs=(options.weights, options.fixed, seams)
    )


def _flatten(options: argparse.Namespace, mesh: MeshData, began: float) -> pipeline.Changed:
    """Flatten a mesh."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.atlas import island_functions as atlas
    from quasiharmonic.apps.flattening.patterns import write_pattern
    from quasiharmonic.energies.measures import distortion
    from quasiharmonic.geometry.mesh.splitting import weld_triangles
    from quasiharmonic.problem.inspection import describe_soup, find_close_vertices
    from quasiharmonic.util.arrays import count_of

    given: dict[str, Any] = {}
    if options.start or options.fixed is not None:
        if options.cut or options.seams != "file":
            raise ValueError("--start and --fixed need the input's map, which new seams discard: omit them")
        # Raises an error that names the missing part of the map.
        io.mapped(mesh)
    with report.name_source(options.input):
        F, joint = weld_triangles(mesh.V, mesh.F, options.weld)
    if options.fixed is not None:
        given["fixed"] = np.unique(joint[io.read_handles(options.fixed, len(mesh.V))])
    if options.weights is not None:
        given["weights"] = _weights(options.weights)
    found = map_options.surface(options, replace(mesh, F=F), disks_too=True, joint=joint)
    triangles = np.array([len(island.F) for island in found.mesh.islands])
    kept = np.flatnonzero(joint == np.arange(len(mesh.V)))
    if (close := kept[find_close_vertices(mesh.V[kept], triangles)]).size:
        process.tell(report.in_options(describe_soup(close)))
    given |= pick(options, "start", "rings", "islands", "linear_solver", *declare_options(FlattenOptions))
    with pipeline.show_work(options.input) as show:
        # With a gap of at most two allowances, those of two pieces would touch.
        mapped = atlas.flatten(found.mesh, gap=2.1 * options.allowance, callback=show, **given)

    def describe(written: MeshData) -> pipeline.Account:
        certified = written_map.certify_map(written, weld=options.weld)
        # Some formats hold the map alone; their vertices have the numbers of the surface's.
        V = mesh.V if len(mesh.V) == len(certified.V) else certified.V
        flat = io.without_idle(V, certified.F, certified.uv)
        measured = distortion(*flat, rings=options.rings if options.energy == "distances" else None)
        facts = {
            **mapped.to_dict(),
            **certified.to_dict(),
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
            "welded_vertices": len(mesh.V) - len(kept),
            **found.facts,
            "energy": options.energy,
            # Each island has its own energy, so there is no value for several islands.
            "mean_energy": _mean_energy(mapped),
            "distortion": measured.to_dict(),
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
        if len(kept) < len(mesh.V):
            lines.append(f"{count_of('vertex', 'vertices', len(mesh.V) - len(kept))} welded to an earlier vertex")
        if options.pattern is not None:
            facts["pattern"] = str(options.pattern)
            write_pattern(options.pattern, *flat[1:], unit=options.unit, allowance=options.allowance)
            lines.append(f"wrote {options.pattern}, true to scale")
        return pipeline.Account(facts, [*lines, mapped.message], certified.apart)

    return pipeline.Changed(mesh.with_places(map_options.pack_islands(options, mapped.mesh)), describe)


def _check_options(options: argparse.Namespace) -> None:
    """Raise ValueError for options that exclude each other, and for invalid ones of the pattern."""
    from quasiharmonic.apps.flattening.patterns import check_pattern

    if options.pattern is None and options.allowance:
        raise ValueError("--allowance needs --pattern: add it")
    if options.pattern is not None:
        if options.unit_square:
            raise ValueError("--pattern is true to scale, but --unit-square scales the map: omit one of them")
        check_pattern(options.pattern, unit=options.unit, allowance=options.allowance)
    if options.pack and (options.unit_square or options.fixed is not None or options.pattern is not None):
        raise ValueError("--pack determines size and position: omit --unit-square, --fixed and --pattern")


def _mean_energy(mapped: MappedAtlas) -> float | None:
    """Return the final mean energy of a single bijective island; else None."""
    first = mapped.islands[0].result
    if len(mapped.islands) > 1 or not (first.certificate.bijective and first.history):
        return None
    return replace_nonfinite(first.history[-1].energy)


def _weights(path: Path) -> list[float]:
    """Read one positive number per line."""
    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.untrusted import read_rows

    values = []
    for line, (value,) in read_rows(path, 1):
        if not value > 0:
            raise MeshFileError(path, f"a weight must be positive, not {value:g}", line)
        values.append(value)
    return values
