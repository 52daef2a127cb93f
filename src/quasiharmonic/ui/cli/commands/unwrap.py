"""``qhm unwrap``: compute texture coordinates for any model, packed into a texture."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.apps.unwrapping.result import UnwrapResult, UnwrapStep
    from quasiharmonic.io import MeshData
    from quasiharmonic.ui.cli.arguments import Commands


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments, material

    parser = commands.add_parser(
        "unwrap",
        description="Compute texture coordinates for any model: cut it into few charts with little stretch, and pack "
        "them into a texture. The vertices, faces, materials and other data of the file stay the same. Degenerate and "
        "repeated faces, mixed winding and edges of three or more faces are accepted and reported.",
        epilog="Exit status: 0 every chart is certified bijective, and no two charts overlap; 1 this is not so; 2 "
        "wrong input or call, nothing written; 3 written, but the report failed. Ctrl-C writes nothing.",
        examples=(
            "qhm unwrap model.obj -o out.glb",
            "qhm unwrap scan.ply --max-stretch 1.2 --resolution 4096 --padding 8 -o out.ply",
            "qhm unwrap model.glb --texture checkerboard -o out.glb",
        ),
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help=f"{format_names('read')} file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help=f"{format_names('write_map', 'seams')} file to write"
    )
    parser.add_argument(
        "--max-stretch",
        type=float,
        default=1.5,
        metavar="S",
        help="bound on the stretch, which 99 %% of the surface keep; smaller values need more seams (default: 1.5)",
    )
    parser.add_argument(
        "--max-charts", type=arguments.count, metavar="N", help="maximum number of charts (default: no limit)"
    )
    parser.add_argument(
        "--resolution",
        type=_resolution,
        default=(2048, 2048),
        metavar="N",
        help="side of the texture in texels, or WIDTHxHEIGHT (default: 2048)",
    )
    parser.add_argument(
        "--padding", type=float, default=4.0, metavar="N", help="minimum texels between two charts (default: 4)"
    )
    parser.add_argument(
        "--texels-per-unit",
        type=float,
        metavar="D",
        help="texels per unit of length of the model (default: as many as fit)",
    )
    parser.add_argument("--tiles", type=arguments.count, default=1, metavar="N", help="UDIM tiles (default: 1)")
    parser.add_argument("--no-rotate", action="store_true", help="do not rotate charts to fit better")
    parser.add_argument(
        "--stack", action="store_true", help="let identical and mirrored components share their texture coordinates"
    )
    parser.add_argument(
        "--outward", action="store_true", help="treat closed components that are inside out as turned outward"
    )
    parser.add_argument(
        "--keep-seams",
        action="store_true",
        help="keep the seams of the input's texture coordinates (vt), and add seams only where necessary",
    )
    parser.add_argument(
        "--edge-costs",
        type=Path,
        metavar="FILE",
        help="file of edges: two vertices, 0-based, and a positive factor on the cost of a seam there, on each line",
    )
    parser.add_argument(
        "--seed", type=arguments.steps, default=0, metavar="N", help="seed of random choices (default: 0)"
    )
    parser.add_argument("--jobs", type=arguments.count, metavar="N", help="number of threads (default: all cores)")
    parser.add_argument(
        "--memory",
        type=arguments.byte_count,
        metavar="SIZE",
        help="stop if more resident memory is used, such as 800M or 4G",
    )
    material.add_options(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, unwrap, write, read back, compare, report."""
    from quasiharmonic import io
    from quasiharmonic.apps.unwrapping.model_files import add_map, corner_positions
    from quasiharmonic.apps.unwrapping.unwrap import unwrap
    from quasiharmonic.ui.cli import material, progress_line, report, written_map
    from quasiharmonic.util.arrays import count_of
    from quasiharmonic.util.untrusted import bounded

    began = time.perf_counter()
    io.find_format(options.output, "write_map", "seams")
    report.check_outputs(options.output, None, options.json, inputs=(options.input, options.edge_costs))
    with bounded(options.memory):
        mesh = material.read_mesh(options, options.input)
    with report.about(options.input), progress_line.line(_words) as show:
        result = unwrap(
            mesh.V,
            mesh.F,
            max_stretch=options.max_stretch,
            max_charts=options.max_charts,
            resolution=options.resolution,
            padding=options.padding,
            texels_per_unit=options.texels_per_unit,
            tiles=options.tiles,
            rotate=not options.no_rotate,
            stack=options.stack,
            outward=options.outward,
            edge_costs=_edge_costs(mesh, options.edge_costs),
            uv=corner_positions(mesh) if options.keep_seams else None,
            seed=options.seed,
            callback=_bound_memory(show, options.memory),
            jobs=options.jobs,
        )
    unwrapped, divided = add_map(mesh, result)
    written_map.tell_losses(options.output, unwrapped)
    io.write_mapped(options.output, unwrapped)
    with report.after_writing(options.output):
        same = _is_written(options.output, result)
        facts = {
            **result.to_dict(),
            "success": result.success and same,
            "input": str(options.input),
            "output": str(options.output),
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
            "divided_polygons": divided,
            "seconds": time.perf_counter() - began,
        }
        lines = [f"wrote {options.output}: {result.message}", result.summary(), *_cleaning(result)]
        if divided:
            lines.append(f"{count_of('polygon', 'polygons', divided)} written as triangles, because seams cross them")
        written_map.add_old_textures(facts, lines, mesh, unwrapped)
        written_map.add_bent(facts, lines, unwrapped)
        if not same:
            lines.append(f"{options.output} has other coordinates than were certified")
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if result.success and same else 1


def _resolution(text: str) -> tuple[int, int]:
    """Convert N or WIDTHxHEIGHT; for argparse."""
    from quasiharmonic.ui.cli import arguments

    sides = [arguments.count(side) for side in text.lower().split("x")]
    if len(sides) > 2:
        raise argparse.ArgumentTypeError(f"{text} is neither N nor WIDTHxHEIGHT")
    return sides[0], sides[-1]


def _words(step: UnwrapStep) -> str:
    return f"{step.phase}   {step.done} of {step.total}"


def _edge_costs(mesh: MeshData, path: Path | None) -> Any:
    """Return the cost factors (f, 3) of a file of edges, and a large cost inside polygons; None if all are 1."""
    import numpy as np

    from quasiharmonic.apps.unwrapping.model_files import polygon_costs
    from quasiharmonic.geometry.mesh.topology import edge_keys
    from quasiharmonic.io.lowlevel.textual import read_rows
    from quasiharmonic.util.arrays import edge_names

    if path is None:
        return polygon_costs(mesh)
    n = len(mesh.V)
    keys, costs = edge_keys(mesh.F, mesh.F[:, (1, 2, 0)], n), np.ones(mesh.F.shape)
    table = np.array([row for _, row in read_rows(path, 3)]).reshape(-1, 3)
    pairs = table[:, :2].astype(np.int64)
    wanted = edge_keys(pairs[:, 0], pairs[:, 1], n)
    absent = (pairs != table[:, :2]).any(axis=1) | ~np.isin(wanted, keys)
    if absent.any():
        raise ValueError(f"{path}: {edge_names(pairs[absent])}: not an edge of the mesh")
    order = np.argsort(wanted, kind="stable")
    given = np.isin(keys, wanted)
    costs[given] = table[order, 2][np.searchsorted(wanted[order], keys[given])]
    return polygon_costs(mesh, costs)


def _bound_memory(show: Callable[[UnwrapStep], None] | None, limit: int | None) -> Callable[[UnwrapStep], None] | None:
    """Return a callback that shows steps, and raises MemoryError above the limit of resident memory."""
    from quasiharmonic.ui.batch.supervisor import resident

    if limit is None:
        return show
    if resident(os.getpid()) is None:
        raise ValueError("--memory needs psutil on this system: pip install psutil")

    def check(step: UnwrapStep) -> None:
        used = resident(os.getpid())
        if used is not None and used > limit:
            raise RuntimeError(f"used more than {limit / 2**20:.0f} MiB of memory (--memory), nothing was written")
        if show is not None:
            show(step)

    return check


def _is_written(output: Path, result: UnwrapResult) -> bool:
    """Return whether a file has exactly the certified texture coordinates, triangle by triangle."""
    import numpy as np

    from quasiharmonic import io

    written = io.read_mesh(output)
    if written.vt is None or written.FT is None or written.FT.shape != result.indices.shape:
        return False
    return bool(np.array_equal(written.vt[written.FT], result.uvs[result.indices]))


def _cleaning(result: UnwrapResult) -> list[str]:
    """Return lines on what was cleaned."""
    cleaned = result.cleaned
    if cleaned.report.clean and not cleaned.flipped.any():
        return []
    return cleaned.summary().splitlines()
