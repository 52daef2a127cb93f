"""Options that say where the boundary goes, and the problem they make of a mesh."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.curves import Rails
    from quasiharmonic.io import MeshData
    from quasiharmonic.mesh.reference import Reference
    from quasiharmonic.mesh.refinement import Refined
    from quasiharmonic.problem import Problem

# That of quasiharmonic.targets.specification, which is not imported to say it.
FORMS = "disk, ellipse:2x1, rect:2x1, polygon:6, star:5, ring:0.5, letter:G, word:QH, or a file .svg, .txt or .csv"


@dataclass
class Posed:
    """What became of the input: a mesh, changed if need be, and a problem.

    Attributes
    ----------
    mesh : MeshData
    problem : Problem
        Its boundary on the curves it is to slide along, if it is to.
    facts : dict
        What was done, for the report.
    notes : list of str
        The same in sentences.
    slide : bool or Rails
        Whether the boundary slides, and along what.
    """

    mesh: MeshData
    problem: Problem
    facts: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    slide: bool | Rails = False


def add_options(parser: argparse.ArgumentParser) -> None:
    """``--fixed``, ``--to`` and what belongs to it."""
    group = parser.add_argument_group(
        "where the boundary goes", "By default to where the texture coordinates (vt) of the input have it."
    )
    where = group.add_mutually_exclusive_group()
    where.add_argument(
        "--fixed", type=Path, metavar="FILE", help="fixed vertices, 0-based, one a line (default: the boundary)"
    )
    where.add_argument("--to", metavar="OUTLINE", help=FORMS)
    group.add_argument("--font", metavar="FONT", help="for letters and words: a font file or the name of a font")
    group.add_argument(
        "--corners",
        metavar="V,V,…",
        help="boundary vertices, 0-based, that go to the outline's corners in the order it has them in; or V:K for its "
        "corner K (from 0), V:X:Y for its point (X, Y); or a file of these, one a line",
    )
    group.add_argument(
        "--corner-angle",
        type=_degrees,
        metavar="DEG",
        help="how far an outline turns at a corner; with 0 all its points are corners, and its sides are matched edge "
        "by edge (default: 20)",
    )
    group.add_argument(
        "--cut", action="store_true", help="cut a closed surface, or one with handles, open first (copies vertices)"
    )
    group.add_argument(
        "--refine", action="store_true", help="split edges that leave the target no room (adds vertices at the end)"
    )


def files(options: argparse.Namespace) -> tuple[Path | None, ...]:
    """The files that the options name, if that is what they name; no output may replace them."""
    names = options.to, options.font, options.corners
    return tuple(Path(name) if name is not None and os.path.isfile(name) else None for name in names)


def pose(options: argparse.Namespace, mesh: MeshData, fixed: NDArray[np.int64] | None) -> Posed:
    """Make the problem that the options ask for.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        When options contradict each other, the mesh or the outline is wrong, or they do not fit together.
    """
    from quasiharmonic import io
    from quasiharmonic.cli import report
    from quasiharmonic.problem import Problem

    if options.to is None:
        for name in ("font", "corners", "corner_angle", "cut"):
            value = getattr(options, name)
            if value is not None and value is not False:
                option = name.replace("_", "-")
                raise ValueError(f"--{option} says how the boundary goes to an outline: name one by --to")
        if mesh.FT is None and fixed is None:
            raise ValueError(
                f"{mesh.source}: no face refers to texture coordinates (vt), which would say where the boundary goes: "
                "write some, or name an outline, as --to disk"
            )
        with report.about(mesh.source):
            posed = Posed(mesh, Problem(*io.problem_arrays(mesh, fixed), reference=options.reference))
    else:
        from quasiharmonic.targets import outline

        try:
            contours = outline(options.to, font=options.font)
        except ValueError as error:
            text = str(error)
            raise ValueError(text if options.to in text else f"--to {options.to}: {text}") from error
        posed = _onto_outline(options, mesh, contours)
        if not options.refine:
            with report.about(mesh.source):
                _check_room(posed.problem, options.to)
    if options.refine:
        _refine(posed, options.reference)
    if options.slide:
        with report.about(mesh.source):
            _slide(options, posed)
    return posed


def _onto_outline(options: argparse.Namespace, mesh: MeshData, contours: list[NDArray[np.float64]]) -> Posed:
    """Lay the boundary along an outline."""
    from quasiharmonic.arrays import counted
    from quasiharmonic.cli import report
    from quasiharmonic.mesh.topology import boundary_loops
    from quasiharmonic.problem import Problem
    from quasiharmonic.targets import boundary_to, filled

    facts: dict[str, Any] = {"to": options.to}
    notes = []
    if options.cut:
        from quasiharmonic.apply.cutting import cut_open

        with report.about(mesh.source):
            opened = cut_open(mesh.V, mesh.F)
        facts["copied_vertices"] = copies = len(opened.V) - len(mesh.V)
        which = counted("vertex along the cut has", "vertices along the cut have", copies)
        notes.append(f"cut open: {which} a copy at the end of the list")
        extra = None if mesh.extra is None else mesh.extra[opened.origin]
        mesh = replace(mesh, V=opened.V, F=opened.F, extra=extra)
    whole = filled(contours)
    holes = len(contours) - len(whole)
    try:
        loops = len(boundary_loops(mesh.F, len(mesh.V)))
    except ValueError:
        # What has no loops is no surface; below it is said why.
        loops = 0
    if holes and loops == 1:
        facts["filled_holes"] = holes
        which = "the hole" if holes == 1 else f"the {holes} holes"
        notes.append(f"the surface has no hole, so {which} of {options.to} {'is' if holes == 1 else 'are'} filled")
        contours = whole
    corners = None if options.corners is None else read_corners(options.corners)
    angle = 20.0 if options.corner_angle is None else options.corner_angle
    with report.about(f"{mesh.source} --to {options.to}"):
        places = boundary_to(mesh.V, mesh.F, contours, corners=corners, corner_angle=angle)
    with report.about(mesh.source):
        return Posed(mesh, Problem(mesh.V, mesh.F, *places, reference=options.reference), facts, notes)


def _slide(options: argparse.Namespace, posed: Posed) -> None:
    """Put the boundary onto the outline's curves; what ``--corners`` sends somewhere stays there."""
    from quasiharmonic.cli import sliding
    from quasiharmonic.energy.sliding import moved_onto

    posed.slide = True
    if options.to is not None:
        posed.slide = sliding.along(
            options.to,
            font=options.font,
            held=[] if options.corners is None else list(read_corners(options.corners)),
            corner_angle=20.0 if options.corner_angle is None else options.corner_angle,
            pieces=options.pieces,
        )
    posed.problem = moved_onto(posed.slide, posed.problem)
    posed.facts["slide"] = True


def _check_room(problem: Problem, to: str) -> None:
    """Refuse at once what cannot end well, before a search that may take long."""
    from quasiharmonic.arrays import named_edges
    from quasiharmonic.targets import flattened_edges

    flat = flattened_edges(problem.F, problem.fixed, problem.target)
    if len(flat):
        raise ValueError(
            f"the inner {named_edges(flat)} {'joins' if len(flat) == 1 else 'join'} boundary vertices between which "
            f"{to} does not bend outwards, so that what is cut off has no room: split with --refine, or send a vertex "
            "in between to a corner with --corners"
        )


def _refine(posed: Posed, reference: Reference | None) -> None:
    """Split edges that stand in the way of a map, until none is known."""
    from quasiharmonic.apply.refining import refine_problem
    from quasiharmonic.mesh.refinement import refine
    from quasiharmonic.targets import flattened_edges

    before = posed.problem
    # A chord along a straight side of the outline may be a rounding error off it; a diagnosis, which is exact, then
    # does not name it.
    flat = flattened_edges(before.F, before.fixed, before.target)
    _take(posed, refine(before.V, before.F, flat), reference)
    _take(posed, refine_problem(posed.problem).refined, reference)
    posed.facts["added_vertices"] = added = posed.problem.n - before.n
    if added:
        posed.notes.append(f"split {added} edge{'' if added == 1 else 's'}: new vertices are at the end of the list")


def _take(posed: Posed, refined: Refined, reference: Reference | None) -> None:
    """Go over to a refined mesh, with all that stands in the file."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.problem import Problem

    if not len(refined.parents):
        return
    # The map is still to come, and takes the place of these zeros.
    posed.mesh, _ = io.refined_mesh(posed.mesh, refined, np.zeros((posed.problem.n, 2)))
    fixed, target = posed.problem.fixed, posed.problem.target
    posed.problem = Problem(posed.mesh.V, posed.mesh.F, fixed, target, reference=reference)


def read_corners(text: str) -> list[int] | dict[int, int | tuple[float, float]]:
    """Read what ``--corners`` says, or the file that it names.

    Parameters
    ----------
    text : str
        ``V,V,…``, or ``V:K`` and ``V:X:Y`` in the place of ``V``; or a text file with one of these on each line,
        blanks in the place of colons if need be, ``#`` before comments.

    Raises
    ------
    ValueError
        When that is not what stands there, or a vertex stands there twice.
    """
    if os.path.isfile(text):
        lines = Path(text).read_text(encoding="utf-8", errors="replace").splitlines()
        entries = [":".join(line.split("#")[0].replace(":", " ").split()) for line in lines]
        entries = [entry for entry in entries if entry]
    else:
        entries = text.split(",")
    chosen: dict[int, int | tuple[float, float]] = {}
    vertices = []
    for entry in entries:
        vertex, *goal = entry.split(":")
        try:
            vertices.append(int(vertex))
            if len(goal) == 1:
                chosen[vertices[-1]] = int(goal[0])
            elif goal:
                x, y = map(float, goal)
                chosen[vertices[-1]] = x, y
        except ValueError:
            raise ValueError(f"--corners {text}: {entry!r} is none of V, V:K and V:X:Y") from None
    if len(set(vertices)) < len(vertices):
        twice = next(v for v in vertices if vertices.count(v) > 1)
        raise ValueError(f"--corners {text}: vertex {twice} is named more than once")
    if chosen and len(chosen) < len(vertices):
        lone = next(v for v in vertices if v not in chosen)
        raise ValueError(f"--corners {text}: where does vertex {lone} go? Others have a corner or a point")
    return chosen or vertices


def _degrees(text: str) -> float:
    """For argparse."""
    angle = float(text)
    if not 0 <= angle <= 180:
        raise argparse.ArgumentTypeError(f"{text} degrees: an angle from 0 to 180 is needed")
    return angle
