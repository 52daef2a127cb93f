"""``qhm check``: say what a mesh is, certify its map exactly, and find what prevents a map.

Report the components, boundaries, genus and defects of a mesh. If the file has a map (vt of an OBJ; a planar mesh
without vt is its own map), verify it exactly. A map with seams is verified in the plane. If some faces have no texture
coordinates, the other faces are verified. Tetrahedra are verified in space. If the map is not injective, look for
obstructions: conditions that no map with these fixed vertices meets.

Exit status: 0 every island of the map is injective (every triangle with texture coordinates strictly positive; of
several islands some may be mirrored), or there is no map and the mesh has no defect, or the boundary is listed; 1
otherwise; 2 the file cannot be read.

    qhm check model.obj
    qhm check problem/ --json report.json
    qhm check model.obj --boundary --plot boundary.png
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any, NamedTuple

from quasiharmonic.ui.cli import finite_elements, pipeline, report, written_map
from quasiharmonic.ui.cli.arguments import add_files, add_options, choice, file, flag, weld

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.io import MeshData
    from quasiharmonic.problem.diagnosis import Diagnosis
    from quasiharmonic.problem.inspection import MeshReport
    from quasiharmonic.targets import BoundaryLoop
    from quasiharmonic.ui.cli.written_map import WrittenMap


class CornerLimits(NamedTuple):
    """Limits of the list of corners."""

    # Maximum number of corners per loop.
    corners: int = 12
    # Minimum turning angle of a corner in degrees, as for outlines.
    min_turn: float = 20.0
    # Maximum number of vertices per loop in the text report.
    listed: int = 100


_LIMITS = CornerLimits()
# Texels along a side of the texture, and the largest distance between islands that is measured, in texels.
_RESOLUTION, _FAR = 2048, 8


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(
        parser,
        f"{format_names('read')} file, a finite-element mesh ({format_names('read_elements')}), or a folder with "
        "input.obj (or .ply) and handles.txt",
        metavar=("FILE",),
    )
    add_options(
        parser, fixed=file("file of fixed vertices for the obstructions, 0-based, one per line (default: the boundary)")
    )
    precision = "round the positions to this precision first (default: float64)"
    parser.add_argument("--as", dest="precision", **choice(("float64", "float32"), precision))
    add_options(
        parser,
        any_triangulation=flag(
            "also require that every face is convex in the plane, so that the result holds for any triangulation"
        ),
        weld=weld("no"),
        boundary=flag("only list the boundary of the surface: its loops, and corners for qhm map --corners"),
        plot=file("draw the boundary that --boundary lists", metavar="IMAGE"),
    )
    add_options(parser, "json", "surface")


def run(options: argparse.Namespace) -> int:
    """Read, inspect, certify, diagnose, report; or report the boundary."""
    from quasiharmonic import io
    from quasiharmonic.io.registry import has_elements
    from quasiharmonic.problem.inspection import inspect_mesh

    if options.boundary and (options.precision or options.any_triangulation or options.fixed or options.weld):
        raise ValueError("--boundary verifies no map: omit --as, --any-triangulation, --fixed and --weld")
    options.input, options.fixed = io.problem_files(options.input, options.fixed)
    if options.weld and options.fixed is not None:
        raise ValueError("the fixed vertices are those of the file: omit --weld, or give the mesh without --fixed")
    report.check_new({}, options.json, inputs=(options.input, options.fixed))
    if options.boundary:
        return _list_boundary(options)
    if options.plot is not None:
        raise ValueError("--plot needs --boundary: add it, or use qhm plot")
    if has_elements(options.input):
        return finite_elements.check(options)
    mesh = io.read_mesh(options.input)
    fixed = None if options.fixed is None else io.read_handles(options.fixed, len(mesh.V))
    with report.name_source(options.input):
        found = inspect_mesh(mesh.V, mesh.F, weld=options.weld)
    facts: dict[str, Any] = {"input": str(options.input), "mesh": found.to_dict()}
    lines = [f"{options.input}: {found.summary()}"]
    if not io.has_map(mesh):
        if options.precision is not None or options.any_triangulation:
            raise ValueError(f"{options.input} has no map: omit --as and --any-triangulation")
        if not found.clean:
            facts["changes"], table = _clean(mesh, options.weld)
            lines.append(table)
        lines.append("The file has no map: no texture coordinates, and the mesh is not planar.")
        return pipeline.conclude(options, pipeline.Account({**facts, "injective": None}, lines, found.clean))
    good, more, text = _verify(mesh, options, fixed, found)
    return pipeline.conclude(options, pipeline.Account({**facts, **more}, [*lines, *text], good))


def _clean(mesh: MeshData, weld: bool | float) -> tuple[dict[str, Any], str]:
    """Return the changes that ``qhm unwrap`` makes to a mesh with defects, and a table of them."""
    from quasiharmonic.apps.unwrapping.cleaning import clean

    command = "qhm unwrap" if isinstance(weld, bool) else f"qhm unwrap --weld {weld:g}"
    try:
        cleaned = clean(mesh.V, mesh.F, weld=weld or True)
    except ValueError as error:  # All triangles are degenerate.
        return {}, f"{command} rejects the mesh: {error}"
    changes = {name: elements.tolist() for name, elements in cleaned.changes.items()}
    table = cleaned.tabulate_changes()
    return changes, f"{command} uses this mesh " + (f"with these changes:\n{table}" if table else "without changes.")


def _verify(
    mesh: MeshData, options: argparse.Namespace, fixed: NDArray[np.int64] | None, found: MeshReport
) -> tuple[bool, dict[str, Any], list[str]]:
    """Certify the map of a mesh; return whether it passes, the entries of the report, and its text."""
    precision = options.precision or "float64"
    certified = written_map.certify_map(mesh, precision=precision, weld=options.weld)
    further = len(certified.V) - len(mesh.V)
    good = certified.injective
    facts = {**certified.to_dict(), "precision": precision, "triangles": len(mesh.F), "further_places": further}
    lines = [certified.summary(), *_describe_gaps(certified)]
    if further:
        lines.append(f"The map has seams: vertices from {len(mesh.V)} on are copies of vertices on the seams.")
    if options.any_triangulation:
        bent, text = _convexity(mesh, certified)
        facts["not_convex"] = bent.tolist()
        good = good and not bent.size
        lines.append(text)
    # The diagnosis would name vertices of the mesh without welding, and needs all faces.
    diagnosis = None if good or len(found.welded) or certified.unmapped.size else _diagnose(mesh, fixed)
    facts["diagnosis"] = None if diagnosis is None else diagnosis.to_dict()
    return good, facts, lines if diagnosis is None else [*lines, diagnosis.summary()]


def _describe_gaps(certified: WrittenMap) -> list[str]:
    """Return a sentence on the smallest distance between islands in the unit square that do not overlap."""
    import numpy as np

    from quasiharmonic.apps.unwrapping.chart_verdict import measure_clearance
    from quasiharmonic.geometry.mesh.topology import components

    uv = certified.uv
    if certified.verdict is None or not certified.apart or np.nanmin(uv) < 0 or np.nanmax(uv) > 1:
        return []
    # Triangles that the verdict reverses are apart in the cut mesh. Those that it leaves out are in no island.
    part, island = components(certified.F, len(uv)), np.full(len(uv), -1)
    for k, one in enumerate(certified.verdict.islands):
        island[part[certified.F[one.triangles]]] = k
    island = island[part]
    loops = tuple(loop for loop in certified.certificate.loops if island[loop[0]] >= 0)
    gap = measure_clearance(loops, uv * _RESOLUTION, island, reach=_FAR)
    apart = f"at least {gap:.3g}" if gap < float("inf") else f"more than {_FAR}"
    return [f"Islands are {apart} texels apart at {_RESOLUTION} × {_RESOLUTION}."]


def _convexity(mesh: MeshData, certified: WrittenMap) -> tuple[NDArray[np.int64], str]:
    """Return the faces that are not convex in the plane, and a sentence about them."""
    import numpy as np

    from quasiharmonic.geometry.exact.triangles import find_concave
    from quasiharmonic.util.arrays import count_of, names_of

    bent = np.setdiff1d(find_concave(mesh.rings, certified.F, certified.uv), certified.unmapped)
    if bent.size:
        return (
            bent,
            f"Not injective for every triangulation: {names_of('face', 'faces', bent)} not convex in the plane.",
        )
    faces = count_of("face", "faces", mesh.faces - len(certified.unmapped))
    return bent, f"Every one of {faces} is convex in the plane: the result holds for any triangulation."


def _diagnose(mesh: MeshData, fixed: NDArray[np.int64] | None) -> Diagnosis | None:
    """Return the obstructions to a map with these fixed vertices; None if the file is not such a problem.

    Without fixed vertices, meshes that are not a surface with one map are skipped.
    """
    from quasiharmonic import io
    from quasiharmonic.problem import Problem
    from quasiharmonic.problem.diagnosis import diagnose

    try:
        return diagnose(Problem(*io.problem_arrays(mesh, fixed), reference="equilateral"))
    except ValueError:
        if fixed is not None:
            raise
        return None


def _list_boundary(options: argparse.Namespace) -> int:
    """Read the surface, find its boundary loops, draw them and report."""
    from dataclasses import replace

    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.targets import boundary_turning
    from quasiharmonic.ui.plot import save_boundary_figure
    from quasiharmonic.util.arrays import count_of

    if options.plot is not None:
        report.check_picture("--plot", options.plot, (options.input,))
    mesh = io.read_mesh(options.input)
    with report.name_source(options.input):
        opened = io.seamed(mesh).opened()
        # A seam vertex has several copies; each boundary copy is listed with the vertex's number.
        origin = np.arange(len(opened.V))
        origin[opened.F] = mesh.F
        turning = boundary_turning(opened.V, opened.F)
        loops = [replace(loop, vertices=origin[loop.vertices]) for loop in turning]
    described = [_describe_loop(loop, mesh.V) for loop in loops]
    facts: dict[str, Any] = {
        "input": str(options.input),
        "vertices": len(mesh.V),
        "triangles": len(mesh.F),
        "loops": described,
    }
    count = count_of("boundary loop", "boundary loops", len(loops)) if loops else "the surface is closed"
    text = [f"{options.input}: {count}; vertices are counted from 0"]
    text += [line for i, one in enumerate(described) for line in _sentences(i, one)]
    if options.plot is not None:
        marked = [corner["vertex"] for loop in described for corner in loop["corners"]]
        save_boundary_figure(options.plot, mesh.V, mesh.F, [loop.vertices for loop in loops], np.array(marked))
        text.append(f"wrote {options.plot}")
    return pipeline.conclude(options, pipeline.Account(facts, text), options.plot)


def _describe_loop(loop: BoundaryLoop, V: NDArray[np.float64]) -> dict[str, Any]:
    """Return a loop in plain Python types; its corners sorted by decreasing turning angle."""
    import numpy as np

    positions, turning = loop.corners(min(_LIMITS.corners, len(loop.vertices)))
    vertices, own = loop.vertices[positions], loop.turning[positions]
    corners = [
        {"vertex": vertex, "place": V[vertex].tolist(), "turning": angle, "turning_at_vertex": alone}
        for vertex, angle, alone in zip(
            vertices.tolist(), np.degrees(turning).tolist(), np.degrees(own).tolist(), strict=True
        )
        if abs(angle) >= _LIMITS.min_turn
    ]
    return {
        "vertices": loop.vertices.tolist(),
        "length": float(loop.lengths.sum()),
        "corners": sorted(corners, key=lambda corner: -abs(float(corner["turning"]))),
    }


def _sentences(i: int, loop: dict[str, Any]) -> list[str]:
    vertices = loop["vertices"]
    more = f", … ({len(vertices)} in all; --json lists them)" if len(vertices) > _LIMITS.listed else ""
    lines = [
        f"loop {i}: {len(vertices)} vertices, length {loop['length']:.6g}, the surface to the left",
        "  in order: " + ", ".join(map(str, vertices[: _LIMITS.listed])) + more,
    ]
    for corner in loop["corners"]:
        x, y, z = corner["place"]
        lines.append(
            f"  corner: vertex {corner['vertex']} at ({x:.6g}, {y:.6g}, {z:.6g}), turning by "
            f"{corner['turning_at_vertex']:.0f}° at the vertex, by {corner['turning']:.0f}° with its surroundings"
        )
    if not loop["corners"]:
        lines.append(f"  no corner of {_LIMITS.min_turn:g}° or more")
    return lines
