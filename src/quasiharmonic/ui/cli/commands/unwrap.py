"""``qhm unwrap``: compute texture coordinates for any model, packed into a texture.

Compute texture coordinates for any model: cut it into few charts with little stretch, and pack them into a texture.
The vertices, faces, materials and other data of the file stay the same. Degenerate and repeated faces, mixed winding
and edges of three or more faces are accepted and reported.

Exit status: 0 every chart is certified bijective, and no two charts overlap; 1 this is not so, or --bake could not bake
the whole look; 2 wrong input or call, nothing written; 3 written, but the report failed. Ctrl-C writes nothing.

    qhm unwrap model.obj -o out.glb
    qhm unwrap scan.ply --max-stretch 1.2 --resolution 4096 --padding 8 -o out.ply
    qhm unwrap model.glb --texture checkerboard -o out.glb
    qhm unwrap model.glb --bake -o out.glb
    qhm unwrap model.glb --channel 1 -o out.glb
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import pipeline, process, written_map
from quasiharmonic.ui.cli.arguments import (
    add_files,
    add_options,
    byte_count,
    choice,
    declare_options,
    degrees,
    file,
    flag,
    number,
    pick,
    set_default,
    steps,
    text,
    texture_size,
    weld,
)
from quasiharmonic.util.hints import with_extra
from quasiharmonic.util.options import INSTANCES, BakeOptions, UnwrapOptions

if TYPE_CHECKING:
    from quasiharmonic.apps.unwrapping.result import UnwrapResult, UnwrapStep
    from quasiharmonic.io import MeshData


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(parser, f"{format_names('read')} file", f"{format_names('write_map', 'seams')} file to write")
    own = declare_options(UnwrapOptions)
    add_options(
        parser,
        **own,
        resolution=number(
            texture_size, "side of the texture in texels, or WIDTHxHEIGHT (default: 2048)", default=(2048, 2048)
        ),
        tile_by=choice(("material",), "give each material a UDIM tile of its own (default: all share them)"),
        no_rotate=flag("do not rotate charts to fit better"),
        stack=choice(
            ("mirrored",),
            "let identical and mirrored components share their texture coordinates, or only the mirror images of a "
            "symmetric model",
            nargs="?",
            const=True,
            default=False,
        ),
        weld=weld("yes"),
        instances=choice(
            INSTANCES,
            "whether all occurrences of a mesh in a glTF file share their texture coordinates, or each becomes a mesh "
            "of its own (default: share, with --lightmap own)",
        ),
        keep_seams=flag("keep the seams of the input's texture coordinates (vt), and add seams only where necessary"),
        edge_costs=file(
            "file of edges: two vertices, 0-based, and a positive factor on the cost of a seam there, on each line"
        ),
        hard_edges=number(
            _hard_edges,
            "make seams of all edges with a larger angle between the normals, in degrees; file: of the edges with "
            "split normals or between smoothing groups",
            metavar="ANGLE",
        ),
        seams=file("file of edges that become seams: two vertices, 0-based, on each line"),
        no_seams=file("file of edges that must not become seams"),
        labels=text(
            "WHICH",
            "parts of the model, between which seams cost almost nothing: groups, materials, or a file with the number "
            "of the part of each face, one on each line",
        ),
        faces=file(
            "file of face numbers, 0-based, one on each line: unwrap only these, and keep the texture coordinates of "
            "all others"
        ),
        channel=number(
            steps,
            "set of texture coordinates to write, such as 1 for lightmaps; the sets below are kept (default: 0); "
            "GLB, glTF, PLY",
            default=0,
        ),
        seams_channel=number(
            steps, "set of the file's texture coordinates that --keep-seams and --faces keep (default: 0)"
        ),
        bake=flag("bake the look of the model into textures for the new texture coordinates"),
        memory=number(byte_count, "stop if more resident memory is used, such as 800M or 4G", metavar="SIZE"),
    )
    add_options(parser, "texture", "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, unwrap, write, read back, compare, report."""
    from quasiharmonic import io

    began = time.perf_counter()
    keeps = options.keep_seams or options.faces is not None
    set_default(options, "seams_channel", 0, asked=keeps, belongs="--keep-seams")
    io.find_format(options.output, "write_map", "seams")
    if options.channel:
        io.find_format(options.output, "write_map", "channels")
    if options.channel and (options.bake or options.texture is not None):
        raise ValueError("images are shown by the first texture coordinates: omit --bake and --texture, or --channel")
    if options.bake:
        _check_bake(options)
    if options.lightmap and options.instances == "share":
        raise ValueError("a lightmap gives each occurrence of a mesh a place of its own: omit --instances share")
    return pipeline.change_map(
        options,
        lambda mesh: _unwrap(options, mesh, began),
        inputs=(options.edge_costs, options.seams, options.no_seams, options.faces, _labels_file(options.labels)),
        read=_read,
    )


def _read(options: argparse.Namespace, source: Path) -> MeshData:
    """Read the model within the limit of memory."""
    from quasiharmonic.io.formats.gltf.reader import GPU_INSTANCES
    from quasiharmonic.io.mesh_files import read_model, separates_instances
    from quasiharmonic.io.untrusted import use_bound

    separated = separates_instances(source, vars(options))
    with use_bound(options.memory):
        if options.instances == "own" and not separated:
            raise ValueError(f"{source} has no instances: omit --instances, or give a glTF file")
        if not separated:
            return pipeline.read_mesh(options, source)
        if options.texture is not None:
            word = "--lightmap" if options.lightmap else "--instances"
            raise ValueError(f"--texture makes one material for all meshes: omit --texture or {word}")
        mesh = read_model(source, vars(options))
        if mesh.carried is not None and GPU_INSTANCES in mesh.carried.further():
            process.tell(f"{GPU_INSTANCES} share their texture coordinates: to separate them, save each as a node")
        return mesh


def _unwrap(options: argparse.Namespace, mesh: MeshData, began: float) -> pipeline.Changed:
    """Unwrap a mesh."""
    from quasiharmonic import io
    from quasiharmonic.apps.unwrapping.model_files import add_map, corner_positions, is_written, material_densities
    from quasiharmonic.apps.unwrapping.unwrap import unwrap
    from quasiharmonic.io.errors import printable_path
    from quasiharmonic.util.arrays import count_of

    for k in range(options.channel):
        io.select_channel(mesh, k)  # raises an error before the work if the file does not have this one
    given = pick(options, "resolution", "stack", "weld", *declare_options(UnwrapOptions))
    if options.symmetry == "none":
        given["symmetry"] = None
    keeps = options.keep_seams or options.faces is not None
    with pipeline.show_work(options.input, _words) as show:
        result = unwrap(
            mesh,
            rotate=not options.no_rotate,
            edge_costs=_edge_costs(mesh, options.edge_costs),
            hard_edges=options.hard_edges,
            tile_by=None if options.tile_by is None else _labels(mesh, "materials", "--tile-by"),
            seams=_read_integers(options.seams, 2),
            no_seams=_read_integers(options.no_seams, 2),
            labels=_labels(mesh, options.labels),
            uv=corner_positions(io.select_channel(mesh, options.seams_channel)) if keeps else None,
            faces=_faces(mesh, options.faces),
            callback=_bound_memory(show, options.memory),
            **given,
        )
    unwrapped, divided = add_map(mesh, result)
    unwrapped = io.place_map(unwrapped, mesh, options.channel)
    baked = None
    if options.bake:
        from quasiharmonic.apps.baking import bake

        baked = bake(mesh, unwrapped, size=options.resolution)
        unwrapped = baked.mesh

    def describe(written: MeshData) -> pipeline.Account:
        same = is_written(written, result)
        done = result.success and same and (baked is None or baked.success)
        facts = {
            **result.to_dict(),
            "success": done,
            "vertices": len(mesh.V),
            "triangles": len(mesh.F),
            "divided_polygons": divided,
            "seconds": time.perf_counter() - began,
        }
        lines = [f"wrote {options.output}: {result.message}", result.summary(), *_cleaning(result)]
        if options.stack == "mirrored" and not result.symmetry.applied:
            lines.append("--stack mirrored has no effect: seams and charts are not mirrored, see --symmetry")
        if densities := material_densities(mesh, result):
            facts["material_texels_per_unit"] = densities
            shown = ", ".join(f"{printable_path(name)} {density:.4g}" for name, density in densities.items())
            lines.append(f"texels per unit by material: {shown}")
        if baked is not None:
            facts["bake"] = baked.to_dict()
            lines.append(baked.summary())
        if divided:
            lines.append(f"{count_of('polygon', 'polygons', divided)} written as triangles, because seams cross them")
        account = pipeline.Account(facts, lines, done)
        written_map.add_bent(account.facts, account.closing, unwrapped)
        if not same:
            account.closing.append(f"{options.output} has other coordinates than were certified")
        return account

    return pipeline.Changed(unwrapped, describe)


def _hard_edges(text: str) -> float | str:
    """Convert an angle, or leave the word file; for argparse."""
    return text if text == "file" else degrees(text)


def _check_bake(options: argparse.Namespace) -> None:
    """Raise ValueError if the look cannot be baked with these options."""
    if options.texture is not None:
        raise ValueError("--bake makes the texture: omit --texture")
    if options.tiles > 1 or options.tile_by is not None:
        raise ValueError("--bake makes one texture: omit --tiles and --tile-by")
    BakeOptions(size=options.resolution)
    pipeline.check_image_output(options)


def _words(step: UnwrapStep) -> str:
    return f"{step.phase}   {step.done} of {step.total}"


def _edge_costs(mesh: MeshData, path: Path | None) -> Any:
    """Return the cost factors (f, 3) of a file of edges, and a large cost inside polygons; None if all are 1."""
    import numpy as np

    from quasiharmonic.apps.unwrapping.model_files import polygon_costs
    from quasiharmonic.geometry.mesh.topology import edge_keys
    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.untrusted import read_rows
    from quasiharmonic.util.arrays import edge_names

    if path is None:
        return polygon_costs(mesh)
    n = len(mesh.V)
    keys, costs = edge_keys(mesh.F, mesh.F[:, (1, 2, 0)], n), np.ones(mesh.F.shape)
    rows, known = read_rows(path, 3), dict[tuple[float, ...], float]()
    for line, (i, j, factor) in rows:
        if factor <= 0:
            raise MeshFileError(path, f"the factor {factor:g} is not positive", line)
        if (other := known.setdefault((min(i, j), max(i, j)), factor)) != factor:
            raise MeshFileError(path, f"edge ({i:g}, {j:g}) has two factors, {other:g} and {factor:g}", line)
    table = np.array([row for _, row in rows]).reshape(-1, 3)
    pairs = table[:, :2].astype(np.int64)
    wanted = edge_keys(pairs[:, 0], pairs[:, 1], n)
    absent = (pairs != table[:, :2]).any(axis=1) | ~np.isin(wanted, keys)
    if absent.any():
        raise ValueError(f"{path}: {edge_names(pairs[absent])}: not an edge of the mesh")
    order = np.argsort(wanted, kind="stable")
    given = np.isin(keys, wanted)
    costs[given] = table[order, 2][np.searchsorted(wanted[order], keys[given])]
    return polygon_costs(mesh, costs)


def _read_integers(path: Path | None, columns: int) -> Any:
    """Return the whole numbers of a file, (k, columns); None without a file."""
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.untrusted import read_rows

    if path is None:
        return None
    rows = read_rows(path, columns)
    for line, row in rows:
        if any(not value.is_integer() for value in row):
            raise MeshFileError(path, "not a whole number", line)
    return np.array([row for _, row in rows], dtype=np.int64).reshape(-1, columns)


def _labels_file(which: str | None) -> Path | None:
    """Return the file that ``--labels`` names."""
    return None if which in (None, "groups", "materials") else Path(str(which))


def _labels(mesh: MeshData, which: str | None, option: str = "--labels") -> Any:
    """Return the labels (f,) of the triangles that an option names."""
    from quasiharmonic.apps.unwrapping.model_files import PARTS, has_parts, statement_labels
    from quasiharmonic.util.arrays import count_of

    if which is None:
        return None
    if (path := _labels_file(which)) is None:
        if not has_parts(mesh, which):
            other = ", or give a file with the part of each face" if option == "--labels" else ""
            raise ValueError(f"the file has no {which}: omit {option}{other}")
        return statement_labels(mesh, *PARTS[which])
    labels = _read_integers(path, 1)[:, 0]
    if len(labels) != mesh.faces:
        raise ValueError(f"{path}: {count_of('number', 'numbers', len(labels))} for {mesh.faces} faces: give one each")
    return labels[mesh.rings.of_triangle]


def _faces(mesh: MeshData, path: Path | None) -> Any:
    """Return a mask (f,) of the triangles of the faces that a file lists."""
    from quasiharmonic.util.arrays import check_range, mark

    if path is None:
        return None
    listed = _read_integers(path, 1)[:, 0]
    check_range(str(path), listed, mesh.faces, "face", "faces")
    return mark(mesh.faces, listed)[mesh.rings.of_triangle]


def _bound_memory(show: Callable[[UnwrapStep], None] | None, limit: int | None) -> Callable[[UnwrapStep], None] | None:
    """Return a callback that shows steps, and raises RuntimeError above the limit of resident memory."""
    if limit is None:
        return show
    from quasiharmonic.ui.batch.supervisor import resident

    if resident(os.getpid()) is None:
        raise ValueError(f"--memory needs psutil on this system: pip install {with_extra('batch')}")

    def check(step: UnwrapStep) -> None:
        used = resident(os.getpid())
        if used is not None and used > limit:
            raise RuntimeError(f"used more than {limit / 2**20:.0f} MiB of memory (--memory), nothing was written")
        if show is not None:
            show(step)

    return check


def _cleaning(result: UnwrapResult) -> list[str]:
    """Return lines on what was cleaned."""
    cleaned = result.cleaned
    moved = (result.V[cleaned.representatives] != result.V).any()
    if cleaned.report.clean and not cleaned.flipped.any() and not moved:
        return []
    return cleaned.summary().splitlines()
