"""``qhm morph``: move the boundary of a mesh, planar or of tetrahedra, and keep its interior valid.

Move some nodes of a mesh and place the others such that no element is inverted: planar triangles of three or six
nodes, quadrilaterals of four, or tetrahedra of four. Boundary nodes without a displacement stay fixed; mid-side nodes
move with their sides. Only positions change in the file; data, time steps and physical groups stay unchanged.

Exit status: 0 all steps are done, no element of the written mesh is inverted, verified exactly, and tetrahedra cover no
point twice; 1 otherwise; 2 wrong input or call, nothing written; 3 written, but the report failed.

    qhm morph mesh.msh --positions boundary.csv -o moved.msh
    qhm morph mesh.vtu --field displacement --slide -o moved.vtu
    qhm morph wing.msh --group flap --rotate 20 --centre 1,0 --steps 10 -o moved.msh
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from quasiharmonic.ui.cli import pipeline, report
from quasiharmonic.ui.cli.arguments import (
    add_files,
    add_options,
    choice,
    count,
    file,
    flag,
    number,
    text,
)
from quasiharmonic.ui.cli.finite_elements import MOTIONS, in_order, list_motions, move_groups, read_tetrahedra
from quasiharmonic.util.options import ENERGIES
from quasiharmonic.util.outcome import replace_nonfinite

if TYPE_CHECKING:
    from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
    from quasiharmonic.apps.tetrahedra.result import TetrahedraResult
    from quasiharmonic.io.fem.files import FemMesh
    from quasiharmonic.util.arrays import FloatArray, IntArray

    # Vertices that move, and the function from the share of the motion to their positions
    Moved: TypeAlias = tuple[IntArray, Callable[[float], FloatArray]]


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    add_files(
        parser,
        f"{format_names('read_elements')} file, text or binary",
        "mesh to write, in the same format",
        metavar=("MESH", "MESH"),
    )
    # Before Python 3.14, argparse takes -1e-9 for an option.
    parser._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(,.*)?$")
    add_options(
        parser.add_mutually_exclusive_group(required=True),
        group=in_order(
            str,
            "NAME",
            "move the nodes of a physical group of Gmsh or a named set, such as flap, or curve:flap if there is also "
            "surface:flap; the motions after it are applied in their order; without motions the group is fixed; "
            "repeat for several groups",
        ),
        positions=file(
            "file of target positions: lines 'vertex,x,y', or 'vertex,x,y,z' for tetrahedra, counting from 0",
            metavar="CSV",
        ),
        field=text("NAME", "point data of the mesh with the displacements of boundary vertices, of the last time step"),
    )
    add_options(parser, **MOTIONS)
    add_options(
        parser,
        steps=number(
            count, "move in N equal steps, and write the series MESH.pvd of .vtu files with the quality, for ParaView"
        ),
        energy=choice(ENERGIES, "energy to lower (default: symmetric-dirichlet)"),
        no_polish=flag("keep the first valid mesh"),
        slide=flag(
            "let boundary vertices without a displacement slide along the boundary between its corners; for "
            "tetrahedra, along all flat parts of the boundary"
        ),
        slide_plane=number(
            float,
            "for tetrahedra: let boundary vertices without a displacement slide on the plane A x + B y + C z = D; "
            "repeat for several planes",
            metavar=("A", "B", "C", "D"),
            nargs=4,
            action="append",
        ),
        rest=file(
            "reference mesh of distortion, such as the first of several steps (default: the input). For planar meshes "
            "the report gives the distance of the written mesh from the result of a single step from there",
            metavar="MESH",
        ),
    )
    add_options(parser, "max_iterations", "linear_solver", "json")


def run(options: argparse.Namespace) -> int:
    """Read, morph, write, read back, certify, report."""
    from quasiharmonic.io.fem.files import check_fem_output, read_fem
    from quasiharmonic.io.fem.vtu import list_series

    if options.no_polish and options.energy is not None:
        raise ValueError("--energy needs polishing: omit --no-polish")
    if options.motions and options.motions[0][0] != "group":
        raise ValueError(f"--{options.motions[0][0]} needs a group: put --group NAME before it")
    inputs = options.input, options.positions, options.rest
    report.check_new({"-o": options.output}, options.json, inputs=inputs)
    check_fem_output(options.output, options.input)
    if options.steps is not None:
        series = dict.fromkeys(map(str, list_series(options.output, options.steps)))
        report.check_new({name: Path(name) for name in series}, options.json, (*inputs, options.output))
    volume = read_tetrahedra(options.input)
    if volume is not None:
        return _morph_volume(options, volume)
    if options.slide_plane is not None:
        raise ValueError("--slide-plane is for tetrahedra: use --slide for planar meshes")
    if options.slide and options.no_polish:
        raise ValueError("--slide of planar meshes needs polishing: omit --no-polish")
    return _morph_planar(options, read_fem(options.input))


def _morph_planar(options: argparse.Namespace, mesh: FemMesh) -> int:
    """Morph a planar mesh."""
    from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
    from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
    from quasiharmonic.geometry.mesh.elements import rim
    from quasiharmonic.io.fem.files import read_fem, write_fem
    from quasiharmonic.util.arrays import count_of

    rest = _rest(options.rest, mesh, read_fem)
    moved = _targets(options, mesh, lambda: rim(mesh.F), slide=options.slide)
    energy = None if options.no_polish else options.energy or "symmetric-dirichlet"
    given = {"energy": energy, "linear_solver": options.linear_solver, "slide": options.slide, "rest": rest}
    morphed, notes, complete = _morph(options, mesh, moved, given)
    assert isinstance(morphed, MorphResult)
    write_fem(options.output, mesh, morphed.points)

    def describe() -> pipeline.Account:
        # Certify the file as read back, because a format may store fewer digits.
        inverted = inverted_elements(morphed.F, read_fem(options.output).points)
        drift = None if rest is None else morphed.drift()
        reversed_rows = int((morphed.F != mesh.F).any(axis=1).sum())
        facts = {
            **morphed.to_dict(),
            "injective": not inverted.size,
            "inverted": inverted.tolist(),
            "drift": None if drift is None else replace_nonfinite(drift),
            "moved": len(moved[0]),
            "reversed": reversed_rows,
            **pipeline.name_files(options),
        }
        lines = _sentences(morphed, len(inverted), drift, options.output)
        if reversed_rows:
            lines.append(_describe_reversed(count_of("element", "elements", reversed_rows)))
        lines += notes
        return pipeline.Account(facts, lines, complete and not inverted.size)

    return pipeline.finish(options, describe, options.output)


def _morph_volume(options: argparse.Namespace, mesh: FemMesh) -> int:
    """Morph a mesh of tetrahedra."""
    import numpy as np

    from quasiharmonic.apps.tetrahedra.certificate import certify_arrays
    from quasiharmonic.apps.tetrahedra.elements import inspect_faces
    from quasiharmonic.apps.tetrahedra.result import TetrahedraResult
    from quasiharmonic.io.fem.files import read_volume, write_fem
    from quasiharmonic.util.arrays import count_of

    if options.energy is not None:
        raise ValueError("--energy is for planar meshes: omit it for tetrahedra")
    if options.slide and options.slide_plane is not None:
        raise ValueError("--slide includes all planes: omit it, or --slide-plane")
    slide = options.slide_plane or options.slide
    rest = _rest(options.rest, mesh, read_volume)
    moved = _targets(
        options, mesh, lambda: np.unique(inspect_faces(mesh.F, len(mesh.points)).boundary), slide=bool(slide)
    )
    given = {"energy": None if options.no_polish else "symmetric-dirichlet", "slide": slide, "rest": rest}
    morphed, notes, complete = _morph(options, mesh, moved, given)
    assert isinstance(morphed, TetrahedraResult)
    write_fem(options.output, mesh, morphed.points)

    def describe() -> pipeline.Account:
        certificate = certify_arrays(morphed.T, read_volume(options.output).points)
        reversed_rows = int((morphed.T != mesh.F).any(axis=1).sum())
        facts = {
            **morphed.to_dict(),
            "certificate": certificate.to_dict(),
            "injective": certificate.injective,
            "inverted": certificate.inverted.tolist(),
            "moved": len(moved[0]),
            "sliding": len(morphed.sliding),
            "reversed": reversed_rows,
            **pipeline.name_files(options),
        }
        lines = [f"wrote {options.output}: {certificate.summary()}"]
        if not certificate.injective:
            lines += morphed.summary().splitlines()[:-1]
        if reversed_rows:
            lines.append(_describe_reversed(count_of("tetrahedron", "tetrahedra", reversed_rows)))
        if slide:
            lines.append(f"{count_of('boundary vertex', 'boundary vertices', len(morphed.sliding))} could slide")
        lines += [morphed.describe_quality(), *notes]
        return pipeline.Account(facts, lines, complete and bool(certificate.injective))

    return pipeline.finish(options, describe, options.output)


def _rest(path: Path | None, mesh: FemMesh, read: Callable[[Path], FemMesh]) -> FloatArray | None:
    """Return the positions of the same nodes in another file, if one is given."""
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError

    if path is None:
        return None
    first = read(path)
    if first.points.shape != mesh.points.shape or not np.array_equal(first.F, mesh.F):
        raise MeshFileError(path, f"must have the same nodes and elements, in the same order, as {mesh.source}")
    return first.points


def _targets(
    options: argparse.Namespace, mesh: FemMesh, find_boundary: Callable[[], IntArray], *, slide: bool
) -> Moved:
    """Return the vertices that move, and their positions; with ``slide`` without those that a field leaves in place."""
    if options.motions:
        return move_groups(mesh, list_motions(options.motions, mesh.points.shape[1]))
    if options.field is None:
        moved, positions = _positions(options.positions, *mesh.points.shape)
    else:
        moved = find_boundary()
        positions = mesh.points[moved] + mesh.point_field(options.field, moved)
        goes = (positions != mesh.points[moved]).any(axis=1) | (not slide)
        moved, positions = moved[goes], positions[goes]
    return moved, lambda share: (1 - share) * mesh.points[moved] + share * positions


def _morph(
    options: argparse.Namespace, mesh: FemMesh, moved: Moved, given: dict[str, Any]
) -> tuple[MorphResult | TetrahedraResult, list[str], bool]:
    """Morph in as many steps as requested, with progress on the terminal, and write the series of the steps.

    The result compares the last mesh with the first one. The steps end where one of them fails. Also return
    sentences about the series and an interrupt, and whether all steps are done.
    """
    from dataclasses import replace

    from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
    from quasiharmonic.apps.mesh_motion.morphing import morph
    from quasiharmonic.io.fem.vtu import list_series, write_series

    (nodes, place), steps = moved, options.steps or 1
    if steps > 1 and given["rest"] is None:
        given = given | {"rest": mesh.points}
    results: list[MorphResult | TetrahedraResult] = []
    with pipeline.show_work(options.input) as show:
        for k in range(1, steps + 1):
            before = results[-1].points if results else mesh.points
            one = morph(
                before, mesh.F, nodes, place(k / steps), max_iterations=options.max_iterations, callback=show, **given
            )
            results.append(one)
            if not one.success:
                break
    first, last, notes = results[0], results[-1], []
    if options.steps is not None:
        elements = last.F if isinstance(last, MorphResult) else last.T
        frames = [(mesh.points, first.quality_before), *((one.points, one.quality_after) for one in results)]
        paths = list_series(options.output, steps)
        write_series(paths, elements, frames)
        notes.append(f"wrote {paths[0]}: {len(results)} of {steps} steps")
    if last.status.name == "INTERRUPTED" and not last.inverted.size:
        notes.append(last.message)
    complete = len(results) == steps
    return replace(last, points_before=mesh.points, quality_before=first.quality_before), notes, complete


def _sentences(morphed: MorphResult, inverted: int, drift: float | None, output: Path) -> list[str]:
    from quasiharmonic.apps.mesh_motion.morph_result import describe_overlap

    what = "triangle" if morphed.F.shape[1] != 4 else "quadrilateral"
    verdict = f"{inverted} of {len(morphed.F)} {what}s are not positive" if inverted else f"every {what} is positive"
    lines = [f"wrote {output}: {verdict}"]
    if inverted:
        lines += [morphed.result.status.value] if morphed.valid else morphed.summary().splitlines()[:-1]
    else:
        lines += describe_overlap(morphed.F, morphed.points)[1]
    lines.append(morphed.describe_quality())
    if drift is not None:
        lines.append(
            f"maximum drift {drift:.3g}, relative to one step from the rest mesh"
            if isfinite(drift)
            else "one step from the rest mesh finds no valid mesh, so the drift is unknown"
        )
    return lines


def _describe_reversed(elements: str) -> str:
    return (
        f"The file lists {elements} in the opposite order of vertices. They are verified in the order that is positive "
        "at rest, but `qhm check` and `qhm measure` report them as inverted."
    )


def _positions(path: Path, n: int, axes: int) -> tuple[IntArray, FloatArray]:
    """Read lines of a vertex and its target position."""
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.untrusted import read_rows

    positions: dict[int, list[float]] = {}
    for line, (vertex, *place) in read_rows(path, 1 + axes, (b"x", b"y", b"z")[:axes]):
        if not (0 <= vertex < n and vertex.is_integer()):
            raise MeshFileError(
                path,
                f"{vertex:g} is not a vertex from 0 to {n - 1}",
                line,
                f"write lines 'vertex,x,y{',z' * (axes - 2)}'",
            )
        if int(vertex) in positions:
            raise MeshFileError(path, f"lists vertex {int(vertex)} a second time", line)
        positions[int(vertex)] = place
    if not positions:
        raise MeshFileError(path, "moves no vertex")
    return np.array(list(positions), dtype=np.int64), np.array(list(positions.values()))
