"""The options that define what is mapped: the seams and the packing of the surface, and the target of its boundary."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import arguments, report

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.io import MeshData
    from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
    from quasiharmonic.problem import Problem
    from quasiharmonic.targets.boundary.boundary_to import FittedProblem
    from quasiharmonic.targets.boundary.corner_pins import CornerSpec

# A copy of the text in quasiharmonic.targets.specification, so that the parser need not import that module.
FORMS = "disk, ellipse:2x1, rect:2x1, polygon:6, star:5, ring:0.5, letter:G, word:QH, or a file .svg, .txt or .csv"


@dataclass
class SeamedSurface:
    """Surface of a file with its seams."""

    mesh: SeamedMesh
    facts: dict[str, Any] = field(default_factory=dict)  # Entries for the JSON report
    notes: list[str] = field(default_factory=list)  # Sentences for the text report


def pack_islands(options: argparse.Namespace, mesh: SeamedMesh) -> SeamedMesh:
    """Return the map, packed if requested."""
    from quasiharmonic.apps.atlas import island_functions as atlas

    return atlas.pack(mesh, resolution=options.resolution, padding=options.padding) if options.pack else mesh


def check_packing(options: argparse.Namespace) -> None:
    """Raise ValueError if ``--resolution`` or ``--padding`` is given without ``--pack``."""
    arguments.set_default(options, "resolution", arguments.RESOLUTION, asked=options.pack, belongs="--pack")
    arguments.set_default(options, "padding", arguments.PADDING, asked=options.pack, belongs="--pack")


def check_seams(options: argparse.Namespace) -> None:
    """Raise ValueError if the file of edges does not exist."""
    if options.seams not in ("file", "none") and not Path(options.seams).is_file():
        raise ValueError(f"--seams {options.seams}: neither 'file' nor 'none', and no file of that name")


def surface(
    options: argparse.Namespace, mesh: MeshData, *, disks_too: bool, joint: NDArray[np.int64] | None = None
) -> SeamedSurface:
    """Return the surface of a file with the seams that the options request.

    If the mesh is welded, ``joint`` (n,) has the representative of each vertex, which the list of edges may name.
    ValueError if cuts or demanded edges are impossible (`find_cuts`), only some faces have texture coordinates although
    there are seams, or a line of the list of edges is wrong; OSError if that list cannot be read.
    """
    from quasiharmonic import io
    from quasiharmonic.io.seamed_mesh import SeamedMesh
    from quasiharmonic.util.arrays import count_of

    with report.name_source(mesh.source):
        if options.seams == "file":
            if mesh.FT is not None and getattr(options, "to", "") is not None:
                # A partial map is sufficient only if the map defines the target of the boundary.
                io.check_mapped(mesh)
            before = io.seamed(mesh)
        else:
            before = SeamedMesh(mesh.V, mesh.F)
        found = SeamedSurface(before)
        if options.seams not in ("file", "none"):
            from quasiharmonic.apps.atlas.seam_cuts import cut_along

            edges = read_edges(Path(options.seams), len(mesh.V))
            edges = edges if joint is None else joint[edges]
            found.mesh = cut_along(before, edges, polygons=mesh.polygons)
        if options.cut:
            # Imported here because the import takes longer than the work for a small mesh.
            from quasiharmonic.apps.atlas.seam_cuts import cut_apart

            found.mesh = cut_apart(
                found.mesh, polygons=mesh.polygons, disks_too=disks_too, reach=disks_too or options.refine
            )
            found.facts["cut_edges"] = cut = len(found.mesh.seams) - len(before.seams)
            found.notes.append(
                f"cut along {count_of('edge', 'edges', cut)}: seams of the map; the model's faces are unchanged"
                if cut
                else "nothing to cut: the surface can be flattened without further cuts"
            )
    islands = len(found.mesh.islands)
    if islands > 1:
        found.facts["island_count"] = islands
        joined = options.seams != "none" and len(SeamedMesh(mesh.V, mesh.F).islands) < islands
        advice = "use --seams none to map the surface without seams" if joined else "qhm check lists vertices to weld"
        found.notes.append(f"{islands} islands, each mapped on its own ({advice})")
    return found


def read_edges(path: Path, n: int) -> NDArray[np.int64]:
    """Read edges, two vertex indices below ``n`` per line; (k, 2) int64.

    Blanks, commas or colons separate the indices; ``#`` starts a comment.
    """
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.untrusted import read_pairs

    rows = []
    for number, ends in read_pairs(path, "an edge"):
        if max(ends) >= n:
            raise MeshFileError(
                path, f"vertex {max(ends)} does not exist in a mesh of {n} vertices", number, "indices count from 0"
            )
        rows.append(ends)
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


@dataclass
class IslandProblem:
    """Problem of an island as defined by the options."""

    fitted: FittedProblem  # If the boundary slides, its target positions lie on the curves
    notes: list[str] = field(default_factory=list)  # Sentences for the text report
    slide: bool | BoundaryCurves = False  # Whether the boundary slides, and along which curves


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--fixed``, ``--to`` and the related options."""
    group = parser.add_argument_group(
        "targets of the boundary", "By default the targets are the texture coordinates (vt) of the input."
    )
    arguments.add_options(
        group.add_mutually_exclusive_group(),
        "fixed",
        to=arguments.text("OUTLINE", f"outline for the boundary: {FORMS}"),
    )
    arguments.add_options(group, "font", "corners", "corner_angle", "cut", "seams")


def files(options: argparse.Namespace) -> tuple[Path | None, ...]:
    """Return the paths of the options that name existing files; outputs must not replace them."""
    names = options.to, options.font, options.corners
    return tuple(Path(name) if name is not None and os.path.isfile(name) else None for name in names)


def check_options(options: argparse.Namespace, mesh: MeshData, fixed: NDArray[np.int64] | None) -> None:
    """Raise ValueError if options contradict each other, or the mesh defines no target for its boundary."""
    check_seams(options)
    if options.to is not None:
        return
    for name, default in (("font", None), ("corners", None), ("corner_angle", 20.0), ("cut", False)):
        if getattr(options, name) != default:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} applies only to an outline: give one by --to")
    if options.seams != "file":
        raise ValueError("without --to the targets and the seams are those of the input's vt: add --to")
    if mesh.FT is None:
        lacking = "boundary has no targets: add them, or give an outline, as in --to disk"
        if fixed is not None:
            remedy = "export it with uv coordinates (in OBJ: vt lines and faces like 1/1 2/2 3/3)"
            lacking = f"fixed vertices have no targets: {remedy}"
        raise ValueError(f"{mesh.source}: no face refers to texture coordinates (vt), so the {lacking}")


def make_problem(
    options: argparse.Namespace, island: Island, fixed: NDArray[np.int64] | None, beside: int
) -> IslandProblem:
    """Return the problem of an island as defined by the options.

    ``fixed`` (k,) are the mesh's vertices that are fixed at their texture coordinates; the boundaries if None.
    ``beside`` is the index of the island's own copy of the outline, from the left. ValueError, OSError or
    ModuleNotFoundError if options contradict each other, the mesh or the outline is wrong, or they do not fit together.
    """
    from quasiharmonic.targets.boundary.boundary_to import fix_in_place

    if options.to is None:
        posed = IslandProblem(fix_in_place(island, fixed, reference=options.reference))
    else:
        posed = _onto_outline(options, island, beside)
    if options.to is not None and not options.refine:
        with report.name_source(options.input):
            _check_room(posed.fitted.problem, options.to)
    if options.slide:
        _slide(options, posed)
    return posed


def _onto_outline(options: argparse.Namespace, island: Island, beside: int) -> IslandProblem:
    """Map the boundary to an outline."""
    from quasiharmonic.targets import outline
    from quasiharmonic.targets.boundary.boundary_to import fit_boundary

    try:
        contours = outline(options.to, font=options.font)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if options.to in text else f"--to {options.to}: {text}") from error
    corners = None if options.corners is None else read_corners(options.corners).within(island.vertices)
    with report.name_source(f"{options.input} --to {options.to}"):
        fitted = fit_boundary(
            island.V,
            island.F,
            contours,
            corners=corners,
            corner_angle=options.corner_angle,
            reference=options.reference,
            beside=beside,
        )
    posed = IslandProblem(fitted)
    if options.corners == "auto" and fitted.corner_vertices:
        found = ",".join(map(str, island.vertices[fitted.corner_vertices].tolist()))
        posed.notes.append(f"corners by angle, in the outline's order: --corners {found}")
    if fitted.filled_holes:
        holes = fitted.filled_holes
        which = "the hole" if holes == 1 else f"the {holes} holes"
        posed.notes.append(
            f"the surface has no hole, so {which} of {options.to} {'is' if holes == 1 else 'are'} filled"
        )
    return posed


def _slide(options: argparse.Namespace, posed: IslandProblem) -> None:
    """Move the boundary onto the outline's curves; vertices from ``--corners`` stay fixed."""
    from dataclasses import replace

    from quasiharmonic.energies.newton.sliding_boundary import move_onto
    from quasiharmonic.targets.specification import find_sliding_curves

    posed.slide = True
    if options.to is not None:
        posed.slide = find_sliding_curves(
            options.to,
            font=options.font,
            fixed=posed.fitted.corner_vertices,
            corner_angle=options.corner_angle,
            pieces=options.pieces,
        )
    posed.fitted = replace(posed.fitted, problem=move_onto(posed.slide, posed.fitted.problem))


def _check_room(problem: Problem, to: str) -> None:
    """Raise ValueError for edges that the target flattens, before a search that may take long."""
    from quasiharmonic.targets import flattened_edges
    from quasiharmonic.util.arrays import edge_names

    flat = flattened_edges(problem.F, problem.fixed, problem.target)
    if len(flat):
        raise ValueError(
            f"the inner {edge_names(flat)} {'joins' if len(flat) == 1 else 'join'} boundary vertices between which "
            f"{to} does not bend outwards, so the triangles it cuts off degenerate: use --refine, or assign a vertex "
            "in between to a corner with --corners"
        )


def read_corners(text: str) -> CornerSpec:
    """Read the value of ``--corners``, or the file that it names; ValueError if it is malformed."""
    from quasiharmonic.targets.boundary import corner_pins

    try:
        return corner_pins.read_corners(text)
    except ValueError as error:
        raise ValueError(f"--corners {text}: {error}") from None


def check_pieces(options: argparse.Namespace) -> None:
    """Raise ValueError if ``--pieces`` is given without ``--slide`` and ``--to``."""
    if options.pieces is not None and not (options.slide and options.to is not None):
        raise ValueError("--pieces assigns vertices to sides of the outline: add --slide and --to")


def describe_off_outline(curves: BoundaryCurves, island: Island) -> list[str]:
    """Return a sentence about the boundary vertices that are not on the curves, if there are any."""
    from quasiharmonic.geometry.mesh.topology import boundary_loops
    from quasiharmonic.util.arrays import names_of

    loops = boundary_loops(island.F, len(island.V))
    off = island.vertices[curves.find_off_curves(loops, island.uv)]
    if not off.size:
        return []
    count = sum(loop.size for loop in loops)
    off_outline = names_of("vertex", "vertices", off)
    return [f"{off.size} of {count} boundary vertices are off the outline and stay fixed: {off_outline}"]
