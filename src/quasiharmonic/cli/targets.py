"""Options that say where the boundary goes, and the problem they make of a mesh."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apply.fitting import Fitted
    from quasiharmonic.curves import Rails
    from quasiharmonic.io import MeshData
    from quasiharmonic.problem import Problem
    from quasiharmonic.targets.asked_corners import AskedCorners

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
        help="boundary vertices, 0-based, that go to the outline's corners in the order it has them in (qhm check "
        "--boundary numbers them), near:x,y,z for the one nearest to a place; or V:K for its corner K (from 0), V:X:Y "
        "for its point (X, Y); or a file of these, one a line; or auto, by angle",
    )
    group.add_argument(
        "--corner-angle",
        type=_degrees,
        metavar="DEG",
        help="how far an outline turns at a corner; with 0 all its points are corners, and its sides are matched edge "
        "by edge (default: 20)",
    )
    group.add_argument("--cut", action="store_true", help="cut a surface that is no disk open first (copies vertices)")
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
    from quasiharmonic.apply.fitting import Fitted, with_room
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
            fitted = Fitted(mesh, Problem(*io.problem_arrays(mesh, fixed), reference=options.reference))
        posed = Posed(mesh, fitted.problem)
    else:
        posed, fitted = _onto_outline(options, mesh)
        if not options.refine:
            with report.about(mesh.source):
                _check_room(posed.problem, options.to)
    if options.refine:
        roomy = with_room(fitted)
        posed.mesh, posed.problem = roomy.mesh, roomy.problem
        posed.facts["added_vertices"] = roomy.added
        if roomy.added:
            edges = "edge" if roomy.added == 1 else "edges"
            posed.notes.append(f"split {roomy.added} {edges}: new vertices are at the end of the list")
    if options.slide:
        with report.about(mesh.source):
            _slide(options, posed, fitted.held)
    return posed


def _onto_outline(options: argparse.Namespace, mesh: MeshData) -> tuple[Posed, Fitted]:
    """Lay the boundary along an outline."""
    from quasiharmonic.apply.fitting import laid_along, opened
    from quasiharmonic.arrays import counted
    from quasiharmonic.cli import report
    from quasiharmonic.targets import outline

    try:
        contours = outline(options.to, font=options.font)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if options.to in text else f"--to {options.to}: {text}") from error
    facts: dict[str, Any] = {"to": options.to}
    notes = []
    if options.cut:
        with report.about(mesh.source):
            mesh, copies = opened(mesh)
        facts["copied_vertices"] = copies
        which = counted("vertex along the cut has", "vertices along the cut have", copies)
        notes.append(f"cut open: {which} a copy at the end of the list" if copies else "a disk already: nothing to cut")
    corners = None if options.corners is None else read_corners(options.corners)
    angle = 20.0 if options.corner_angle is None else options.corner_angle
    with report.about(f"{mesh.source} --to {options.to}"):
        fitted = laid_along(mesh, contours, corners=corners, corner_angle=angle, reference=options.reference)
    if fitted.filled:
        facts["filled_holes"] = holes = fitted.filled
        which = "the hole" if holes == 1 else f"the {holes} holes"
        notes.append(f"the surface has no hole, so {which} of {options.to} {'is' if holes == 1 else 'are'} filled")
    return Posed(mesh, fitted.problem, facts, notes), fitted


def _slide(options: argparse.Namespace, posed: Posed, held: list[int]) -> None:
    """Put the boundary onto the outline's curves; what ``--corners`` sends somewhere stays there."""
    from quasiharmonic.curves import Rails
    from quasiharmonic.energy.sliding import moved_onto
    from quasiharmonic.targets import outline_curves

    posed.slide = True
    if options.to is not None:
        posed.slide = Rails(
            outline_curves(options.to, font=options.font),
            held=held,
            corner_angle=20.0 if options.corner_angle is None else options.corner_angle,
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


def read_corners(text: str) -> AskedCorners:
    """Read what ``--corners`` says, or the file that it names.

    Raises
    ------
    ValueError
        When that is not what stands there.
    """
    from quasiharmonic.targets import asked_corners

    try:
        return asked_corners.read_corners(text)
    except ValueError as error:
        raise ValueError(f"--corners {text}: {error}") from None


def _degrees(text: str) -> float:
    """For argparse."""
    angle = float(text)
    if not 0 <= angle <= 180:
        raise argparse.ArgumentTypeError(f"{text} degrees: an angle from 0 to 180 is needed")
    return angle
