"""``qhm polish``: lower the distortion of an injective map of a file.

Lower the distortion of the injective map that the input's texture coordinates (vt) give.

Exit status: 0 the written file is certified injective; 1 it is not; 2 wrong input or call (a map that is not
injective included), nothing written; 3 written, but the report failed.

    qhm polish map.obj -o polished.obj
    qhm polish map.obj --energy mips --free -o polished.obj
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import map_options, pipeline, written_map
from quasiharmonic.ui.cli.arguments import (
    add_files,
    add_options,
    declare_options,
    file,
    flag,
    pick,
    text,
)
from quasiharmonic.util.options import PolishOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from typing import Any, TypeAlias

    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.energies.measures import Distortion
    from quasiharmonic.io import MeshData
    from quasiharmonic.io.seamed_mesh import SeamedMesh

    Lower: TypeAlias = Callable[[SeamedMesh, dict[str, Any]], MappedAtlas]

# Energies: their names in reports, and their values on each triangle in terms of measured distortion.
_MEASURED: dict[str, tuple[str, Callable[[Distortion], NDArray[np.float64]]]] = {
    "symmetric-dirichlet": ("symmetric Dirichlet", lambda found: found.symmetric_dirichlet),
    "mips": ("MIPS", lambda found: found.mips),
    "blend": ("blend", lambda found: (127 * found.mips + found.area_ratio + 1 / found.area_ratio - 2) / 128),
    "arap": ("ARAP", lambda found: found.arap),
    "arap-barrier": ("ARAP", lambda found: found.arap),
    "arap-unsigned": ("ARAP", lambda found: found.arap),
    "area": ("squared error of areas", lambda found: (found.area_ratio - 1) ** 2),
}


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    form = format_names("write_map")
    add_files(parser, f"{form} file with an injective map", f"{form} file to write")
    add_options(
        parser,
        fixed=file(
            "file of fixed vertices, 0-based, one per line (default: the boundary; with --slide only the corners)"
        ),
        **declare_options(PolishOptions),
        free=flag("free the boundary; each island stays near its position"),
    )
    add_options(
        parser,
        "slide",
        "pieces",
        to=text("OUTLINE", "the outline of the boundary, as for qhm map (default: the polygon of the boundary)"),
    )
    add_options(parser, "islands", "pack", "resolution", "padding", "linear_solver", "texture", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, polish, write, certify, report."""
    if options.to is not None and not options.slide:
        raise ValueError("--to gives the outline to slide along: add --slide")
    if options.free and (options.slide or options.fixed is not None):
        raise ValueError("--free frees the boundary: omit --slide and --fixed")
    map_options.check_pieces(options)
    notes: list[str] = []

    def lower(mesh: SeamedMesh, given: dict[str, Any]) -> MappedAtlas:
        from quasiharmonic.apps.atlas import island_functions as atlas
        from quasiharmonic.targets.specification import find_sliding_curves

        given |= {"islands": options.islands, "free": options.free, "time_limit": options.time_limit}
        if options.free:
            return atlas.polish(mesh, **given)
        slide = options.slide
        if options.to is not None:
            if len(mesh.islands) > 1:
                raise ValueError(f"--slide --to supports one island, but the mesh has {len(mesh.islands)}")
            slide = find_sliding_curves(options.to, pieces=options.pieces)
            notes.extend(map_options.describe_off_outline(slide, mesh.islands[0]))
        return atlas.polish(mesh, slide=slide, **given)

    return lower_distortion(options, lower, inputs=(options.pieces,), notes=notes)


def lower_distortion(
    options: argparse.Namespace, lower: Lower, inputs: Sequence[Path | None] = (), notes: Sequence[str] = ()
) -> int:
    """Read a map, lower its distortion, write, certify, report; used by every command that does so.

    `lower` gets the map, and the options that all of these functions have. ``inputs`` are further files that outputs
    must not replace. ``notes`` are added to the report; `lower` may append to them.
    """
    map_options.check_packing(options)

    def change(mesh: MeshData) -> pipeline.Changed:
        from quasiharmonic import io
        from quasiharmonic.apps.atlas.atlas_verdict import reflect_mirrored
        from quasiharmonic.energies.measures import distortion

        before = io.mapped(mesh)
        given = pick(options, "energy", "max_iterations", "linear_solver")
        given["fixed"] = None if options.fixed is None else io.read_handles(options.fixed, len(mesh.V))
        with pipeline.show_work(options.input) as show:
            after = lower(before, {**given, "callback": show})

        def describe(file: MeshData) -> pipeline.Account:
            written = written_map.certify_map(file)
            # Each map is cut at its own seams, which may differ.
            opened = reflect_mirrored(before).opened(), reflect_mirrored(after.mesh).opened()
            measured = [distortion(*io.without_idle(m.V, m.F, m.uv)) for m in opened if m.uv is not None]
            facts = {
                **after.to_dict(),
                **written.to_dict(),
                "vertices": len(mesh.V),
                "triangles": len(mesh.F),
                "distortion_before": measured[0].to_dict(),
                "distortion": measured[1].to_dict(),
            }
            lines = [written_map.describe_maps(after, written, options.output)]
            if written.injective:
                lines += [*notes, _change(options.energy, *measured), *written_map.describe_end(after, written)]
            return pipeline.Account(facts, lines, written.injective)

        return pipeline.Changed(mesh.with_places(map_options.pack_islands(options, after.mesh)), describe)

    return pipeline.change_map(options, change, inputs=(options.fixed, *inputs))


def _change(energy: str, before: Distortion, after: Distortion) -> str:
    """Return a sentence about the change of the energy that was lowered, if it is measured, and of lengths."""
    lengths = [found.statistics("isometric").maximum for found in (before, after)]
    words = f"isometric distortion from {lengths[0]:.3g} to {lengths[1]:.3g} at worst"
    if energy in _MEASURED:
        name, measure = _MEASURED[energy]
        means = [float(found.share @ measure(found)) for found in (before, after)]
        words = f"{name} from {means[0]:.3g} to {means[1]:.3g} on average, {words}"
    return words
