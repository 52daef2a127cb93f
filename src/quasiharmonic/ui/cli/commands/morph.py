"""``qhm morph``: move the boundary of a mesh, planar or of tetrahedra, and keep its interior valid."""

from __future__ import annotations

import argparse
import re
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
    from quasiharmonic.io.fem.files import FemMesh
    from quasiharmonic.ui.cli.arguments import Commands
    from quasiharmonic.util.arrays import FloatArray, IntArray

# Name of the quality measure by the number of nodes per element.
_QUALITY = {
    3: "mean-ratio quality",
    4: "quality at the worst corner",
    6: "mean-ratio quality times evenness of the Jacobian",
}


def add_parser(commands: Commands) -> None:
    """Declare the command."""
    from quasiharmonic.io.registry import format_names
    from quasiharmonic.ui.cli import arguments

    parser = commands.add_parser(
        "morph",
        description="Move some nodes of a mesh and place the others such that no element is inverted: planar triangles "
        "of three or six nodes, quadrilaterals of four, or tetrahedra of four. Boundary nodes without a displacement "
        "stay fixed; mid-side nodes move with their sides. Only positions change in the file; data, time steps and "
        "physical groups stay unchanged.",
        epilog="Exit status: 0 no element of the written mesh is inverted, verified exactly, and tetrahedra cover no "
        "point twice; 1 otherwise; 2 wrong input or call, nothing written; 3 written, but the report failed.",
        examples=(
            "qhm morph mesh.msh --positions boundary.csv -o moved.msh",
            "qhm morph mesh.vtu --field displacement --slide -o moved.vtu",
        ),
    )
    parser.add_argument(
        "input", type=Path, metavar="MESH", help=f"{format_names('read_elements')} file, text or binary"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="MESH", help="mesh to write, in the same format"
    )
    given = parser.add_mutually_exclusive_group(required=True)
    given.add_argument(
        "--positions",
        type=Path,
        metavar="CSV",
        help="file of target positions: lines 'vertex,x,y', or 'vertex,x,y,z' for tetrahedra, counting from 0",
    )
    given.add_argument(
        "--field",
        metavar="NAME",
        help="point data of the mesh with the displacements of boundary vertices; the last time step counts",
    )
    parser.add_argument(
        "--energy",
        choices=arguments.ENERGIES,
        help="energy to lower (default: symmetric-dirichlet)",
    )
    parser.add_argument("--no-polish", action="store_true", help="keep the first valid mesh")
    parser.add_argument("--max-iterations", type=arguments.count, default=2000, metavar="N", help="(default: 2000)")
    parser.add_argument(
        "--slide",
        action="store_true",
        help="let boundary vertices without a displacement slide along the boundary, its corners stay fixed; in space "
        "along all flat parts of the boundary",
    )
    # Before Python 3.14, argparse takes -1e-9 for an option.
    parser._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
    parser.add_argument(
        "--slide-plane",
        type=float,
        nargs=4,
        action="append",
        metavar=("A", "B", "C", "D"),
        help="for tetrahedra: let boundary vertices without a displacement slide on the plane A x + B y + C z = D; "
        "repeat for several planes",
    )
    parser.add_argument(
        "--rest",
        type=Path,
        metavar="MESH",
        help="reference mesh of distortion, such as the first of several steps (default: the input). For planar meshes "
        "the report gives the distance of the written mesh from the result of a single step from there",
    )
    arguments.add_linear_solver(parser)
    arguments.add_report(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Read, morph, write, read back, certify, report."""
    from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
    from quasiharmonic.apps.mesh_motion.morphing import morph
    from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
    from quasiharmonic.geometry.mesh.elements import rim
    from quasiharmonic.io.fem.files import check_fem_output, read_fem, read_volume, write_fem
    from quasiharmonic.ui.cli import progress_line, report

    if options.no_polish and options.energy is not None:
        raise ValueError("--energy needs polishing: omit --no-polish")
    report.check_moved(options.output, options.json, inputs=(options.input, options.positions, options.rest))
    check_fem_output(options.output, options.input)
    volume = read_volume(options.input)
    if len(volume.F):
        return _run_volume(options, volume)
    if options.slide_plane is not None:
        raise ValueError("--slide-plane is for tetrahedra: use --slide for planar meshes")
    mesh = read_fem(options.input)
    rest = None if options.rest is None else _rest(options.rest, read_fem(options.rest), mesh)
    if options.field is not None:
        moved = rim(mesh.F)
        positions = mesh.points[moved] + mesh.point_field(options.field, moved)
        if options.slide:
            moved, positions = _drop_idle(mesh.points, moved, positions)
    else:
        moved, positions = _positions(options.positions, len(mesh.points), 2)
    with report.about(options.input), progress_line.line() as show:
        morphed = morph(
            mesh.points,
            mesh.F,
            moved,
            positions,
            energy=None if options.no_polish else options.energy or "symmetric-dirichlet",
            max_iterations=options.max_iterations,
            linear_solver=options.linear_solver,
            callback=show,
            slide=options.slide,
            rest=rest,
        )
    assert isinstance(morphed, MorphResult)
    write_fem(options.output, mesh, morphed.points)
    with report.after_writing(options.output):
        # Certify the file as read back, because a format may store fewer digits.
        inverted = inverted_elements(morphed.F, read_fem(options.output).points)
        drift = None if rest is None else morphed.drift()
        facts = {
            **morphed.to_dict(),
            "injective": not inverted.size,
            "inverted": inverted.tolist(),
            "drift": drift if drift is None or isfinite(drift) else None,
            "input": str(options.input),
            "output": str(options.output),
            "moved": len(moved),
        }
        report.emit(facts, options.json, _sentences(morphed, len(inverted), drift, options.output))
    return 0 if not inverted.size else 1


def _run_volume(options: argparse.Namespace, mesh: FemMesh) -> int:
    """`run` for a mesh of tetrahedra."""
    import numpy as np

    from quasiharmonic.apps.mesh_motion.morphing import morph
    from quasiharmonic.apps.tetrahedra.certificate import certify_arrays
    from quasiharmonic.apps.tetrahedra.result import TetrahedraResult
    from quasiharmonic.apps.tetrahedra.topology import inspect_faces
    from quasiharmonic.geometry.mesh.elements import split_solids
    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.fem.files import read_volume, write_fem
    from quasiharmonic.ui.cli import progress_line, report
    from quasiharmonic.util.arrays import count_of

    T, H = split_solids(mesh.F)
    if len(H):
        raise MeshFileError(options.input, "has hexahedra", remedy="split them into tetrahedra")
    if options.energy is not None:
        raise ValueError("--energy is for planar meshes: omit it for tetrahedra")
    if options.slide and options.slide_plane is not None:
        raise ValueError("--slide includes all planes: omit it, or --slide-plane")
    slide = options.slide_plane or options.slide
    rest = None
    if options.rest is not None:
        rest = _rest(options.rest, read_volume(options.rest), mesh)
    if options.field is not None:
        moved = np.unique(inspect_faces(T, len(mesh.points)).boundary)
        positions = mesh.points[moved] + mesh.point_field(options.field, moved)
        if slide:
            moved, positions = _drop_idle(mesh.points, moved, positions)
    else:
        moved, positions = _positions(options.positions, len(mesh.points), 3)
    with report.about(options.input), progress_line.line() as show:
        morphed = morph(
            mesh.points,
            T,
            moved,
            positions,
            energy=None if options.no_polish else "symmetric-dirichlet",
            max_iterations=options.max_iterations,
            callback=show,
            slide=slide,
            rest=rest,
        )
    assert isinstance(morphed, TetrahedraResult)
    write_fem(options.output, mesh, morphed.points)
    with report.after_writing(options.output):
        certificate = certify_arrays(morphed.T, read_volume(options.output).points)
        reversed_rows = int((morphed.T != T).any(axis=1).sum())
        facts = {
            **morphed.to_dict(),
            "certificate": certificate.to_dict(),
            "injective": certificate.injective,
            "inverted": certificate.inverted.tolist(),
            "input": str(options.input),
            "output": str(options.output),
            "moved": len(moved),
            "sliding": len(morphed.sliding),
            "reversed": reversed_rows,
        }
        lines = [f"wrote {options.output}: {certificate.summary()}"]
        if not certificate.injective:
            lines.append(morphed.summary())
        if reversed_rows:
            lines.append(
                f"The file lists {count_of('tetrahedron', 'tetrahedra', reversed_rows)} in the opposite order of "
                "vertices. They are verified in the order that is positive at rest, but `qhm check` reports them as "
                "inverted."
            )
        if slide:
            lines.append(f"{count_of('boundary vertex', 'boundary vertices', len(morphed.sliding))} could slide")
        for name, quality in (("before", morphed.quality_before), ("after", morphed.quality_after)):
            worst = f"worst {quality.min():.3g} (tetrahedron {int(quality.argmin())})"
            lines.append(f"mean-ratio quality {name}: {worst}, mean {quality.mean():.3g}")
        report.emit(facts, options.json, "\n".join(lines))
    return 0 if certificate.injective else 1


def _drop_idle(points: FloatArray, moved: IntArray, positions: FloatArray) -> tuple[IntArray, FloatArray]:
    """Drop the vertices that stay where they are."""
    goes = (positions != points[moved]).any(axis=1)
    return moved[goes], positions[goes]


def _rest(path: Path, first: FemMesh, mesh: FemMesh) -> FloatArray:
    """Return the positions of the same nodes in another file."""
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError

    if first.points.shape != mesh.points.shape or not np.array_equal(first.F, mesh.F):
        raise MeshFileError(path, f"must have the same nodes and elements, in the same order, as {mesh.source}")
    return first.points


def _sentences(morphed: MorphResult, inverted: int, drift: float | None, output: Path) -> str:
    before, after = morphed.quality_before, morphed.quality_after
    what = "triangle" if morphed.F.shape[1] != 4 else "quadrilateral"
    verdict = f"{inverted} of {len(after)} {what}s are not positive" if inverted else f"every {what} is positive"
    lines = [f"wrote {output}: {verdict}"]
    if inverted:
        lines.append(morphed.result.status.value if morphed.valid else morphed.summary())
    elif not morphed.result.certificate.bijective:
        lines.append(f"but the mesh overlaps itself. {morphed.result.certificate.summary()}")
    for name, quality in (("before", before), ("after", after)):
        worst = f"worst {quality.min():.3g} ({what} {int(quality.argmin())})"
        lines.append(f"{_QUALITY[morphed.F.shape[1]]} {name}: {worst}, mean {quality.mean():.3g}")
    if drift is not None:
        lines.append(
            f"maximum drift {drift:.3g}, relative to one step from the rest mesh"
            if isfinite(drift)
            else "one step from the rest mesh finds no valid mesh, so the drift is unknown"
        )
    return "\n".join(lines)


def _positions(path: Path, n: int, axes: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Read lines of a vertex and its target position."""
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.lowlevel.textual import read_rows

    positions: dict[int, list[float]] = {}
    for line, (vertex, *place) in read_rows(path, 1 + axes):
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
