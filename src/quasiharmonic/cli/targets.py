"""Options that say where the boundary goes, and the problem they make of a mesh."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.io import MeshData
    from quasiharmonic.mesh.reference import Reference
    from quasiharmonic.problem import Problem

# That of quasiharmonic.targets.specification, which is not imported to say it.
FORMS = "disk, ellipse:2x1, rect:2x1, polygon:6, star:5, ring:0.5, letter:G, word:QH, or a file .svg, .txt or .csv"
# Rounds of splitting edges: what is split may give way to another obstruction.
_ROUNDS = 5


@dataclass
class Posed:
    """What became of the input: a mesh, changed if need be, and a problem.

    Attributes
    ----------
    mesh : MeshData
    problem : Problem
    facts : dict
        What was done, for the report.
    notes : list of str
        The same in sentences.
    """

    mesh: MeshData
    problem: Problem
    facts: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


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
        type=_corners,
        metavar="V,V,…",
        help="boundary vertices, 0-based, that go to the outline's corners in order; or V:K for its corner K (from 0), "
        "V:X:Y for its point (X, Y)",
    )
    group.add_argument(
        "--cut", action="store_true", help="cut a closed surface, or one with handles, open first (copies vertices)"
    )
    group.add_argument(
        "--refine", action="store_true", help="split edges that leave the target no room (adds vertices at the end)"
    )


def files(options: argparse.Namespace) -> tuple[Path | None, ...]:
    """The files that the options name, if that is what they name; no output may replace them."""
    return tuple(
        None if name is None or not Path(name).is_file() else Path(name) for name in (options.to, options.font)
    )


def pose(options: argparse.Namespace, mesh: MeshData, fixed: NDArray[np.int64] | None) -> Posed:
    """Make the problem that the options ask for.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        When options contradict each other, the mesh or the outline is wrong, or they do not fit together.
    """
    from quasiharmonic import io
    from quasiharmonic.problem import Problem

    from . import report

    if options.to is None:
        for name in ("font", "corners", "cut"):
            if getattr(options, name):
                raise ValueError(f"--{name} says how the boundary goes to an outline: name one by --to")
        with report.about(Path(mesh.source)):
            posed = Posed(mesh, Problem(*io.problem_arrays(mesh, fixed), reference=options.reference))
    else:
        from quasiharmonic.targets import outline

        contours = outline(options.to, font=options.font)
        with report.about(Path(mesh.source)):
            posed = _onto_outline(options, mesh, contours)
            if not options.refine:
                _check_room(posed.problem, options.to)
    if options.refine:
        _refine(posed, options.reference)
    return posed


def _onto_outline(options: argparse.Namespace, mesh: MeshData, contours: list[NDArray[np.float64]]) -> Posed:
    """Lay the boundary along an outline."""
    from quasiharmonic import io
    from quasiharmonic.mesh.topology import boundary_loops
    from quasiharmonic.problem import Problem
    from quasiharmonic.targets import boundary_to, filled

    facts: dict[str, Any] = {"to": options.to}
    notes = []
    if options.cut:
        from quasiharmonic.cutting import cut_open

        opened = cut_open(mesh.V, mesh.F)
        facts["copied_vertices"] = copies = len(opened.V) - len(mesh.V)
        notes.append(f"cut open: {copies} vertices along the cut have a copy at the end of the list")
        mesh = io.MeshData(opened.V, opened.F, source=mesh.source)
    whole = filled(contours)
    holes = len(contours) - len(whole)
    if holes and len(boundary_loops(mesh.F, len(mesh.V))) == 1:
        facts["filled_holes"] = holes
        which = "the hole" if holes == 1 else f"the {holes} holes"
        notes.append(f"the surface has no hole, so {which} of {options.to} {'is' if holes == 1 else 'are'} filled")
        contours = whole
    places = boundary_to(mesh.V, mesh.F, contours, corners=options.corners)
    return Posed(mesh, Problem(mesh.V, mesh.F, *places, reference=options.reference), facts, notes)


def _check_room(problem: Problem, to: str) -> None:
    """Refuse at once what cannot end well, before a search that may take long."""
    from quasiharmonic.mesh.topology import named_edges
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
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.diagnosis import diagnose
    from quasiharmonic.problem import Problem
    from quasiharmonic.refinement import refine
    from quasiharmonic.targets import flattened_edges

    count = posed.problem.n
    for _ in range(_ROUNDS):
        problem = posed.problem
        flat = flattened_edges(problem.F, problem.fixed, problem.target)
        split = np.unique(np.concatenate([flat, diagnose(problem).split]), axis=0)
        if not len(split):
            break
        refined = refine(problem.V, problem.F, split)
        posed.problem = Problem(refined.V, refined.F, problem.fixed, problem.target, reference=reference)
        posed.mesh = io.MeshData(refined.V, refined.F, source=posed.mesh.source)
    posed.facts["added_vertices"] = added = posed.problem.n - count
    if added:
        posed.notes.append(f"split {added} edge{'' if added == 1 else 's'}: new vertices are at the end of the list")


def _corners(text: str) -> list[int] | dict[int, int | tuple[float, float]]:
    """Read ``--corners``; for argparse."""
    parts = [part.split(":") for part in text.split(",")]
    try:
        if all(len(part) == 1 for part in parts):
            return [int(part[0]) for part in parts]
        chosen: dict[int, int | tuple[float, float]] = {}
        for vertex, *goal in parts:
            if int(vertex) in chosen:
                raise argparse.ArgumentTypeError(f"vertex {vertex} is named more than once")
            chosen[int(vertex)] = int(goal[0]) if len(goal) == 1 else (float(goal[0]), float(goal[1]))
            if len(goal) > 2:
                raise ValueError
    except (ValueError, IndexError):
        raise argparse.ArgumentTypeError(
            f"{text!r}: vertices V are needed with commas between, or V:K or V:X:Y for each"
        ) from None
    return chosen
