"""Options for the target of the boundary, and the problem that they define."""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from quasiharmonic.ui.cli import seams

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.repair.fitting import Fitted
    from quasiharmonic.geometry.curves import BoundaryCurves
    from quasiharmonic.geometry.mesh.seams import Island
    from quasiharmonic.io import MeshData
    from quasiharmonic.problem import Problem
    from quasiharmonic.targets.boundary.corner_spec import AskedCorners

# A copy of the text in quasiharmonic.targets.specification, so that the parser need not import that module.
FORMS = "disk, ellipse:2x1, rect:2x1, polygon:6, star:5, ring:0.5, letter:G, word:QH, or a file .svg, .txt or .csv"


@dataclass
class Posed:
    """Problem of an island as defined by the options.

    Attributes
    ----------
    fitted : Fitted
        If the boundary slides, its target positions lie on the curves.
    facts : dict of str to int
        Entries for the JSON report; those of several islands are added.
    notes : list of str
        Sentences for the text report.
    slide : bool or BoundaryCurves
        Whether the boundary slides, and along which curves.
    """

    fitted: Fitted
    facts: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    slide: bool | BoundaryCurves = False


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--fixed``, ``--to`` and the related options."""
    group = parser.add_argument_group(
        "targets of the boundary", "By default the targets are the texture coordinates (vt) of the input."
    )
    where = group.add_mutually_exclusive_group()
    where.add_argument(
        "--fixed",
        type=Path,
        metavar="FILE",
        help="file of fixed vertices, 0-based, one per line (default: the boundary)",
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
    seams.add_options(group)
    group.add_argument(
        "--refine",
        action="store_true",
        help="if no map exists, split as few inner edges as necessary (adds vertices at the end)",
    )


def files(options: argparse.Namespace) -> tuple[Path | None, ...]:
    """Return the paths of the options that name existing files; outputs must not replace them."""
    names = options.to, options.font, options.corners
    return tuple(Path(name) if name is not None and os.path.isfile(name) else None for name in names)


def check_options(options: argparse.Namespace, mesh: MeshData, fixed: NDArray[np.int64] | None) -> None:
    """Raise ValueError if options contradict each other, or the mesh defines no target for its boundary."""
    seams.check_options(options)
    if options.to is not None:
        return
    for name in ("font", "corners", "corner_angle", "cut"):
        value = getattr(options, name)
        if value is not None and value is not False:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} applies only to an outline: give one by --to")
    if options.seams != "file":
        raise ValueError("without --to the targets and the seams are those of the input's vt: add --to")
    if mesh.FT is None and fixed is None:
        raise ValueError(
            f"{mesh.source}: no face refers to texture coordinates (vt), so the boundary has no targets: "
            "add them, or give an outline, as in --to disk"
        )
    if mesh.FT is None:
        raise ValueError(
            f"{mesh.source}: no face refers to texture coordinates (vt), so the fixed vertices have no targets: "
            "export it with uv coordinates (in OBJ: vt lines and faces like 1/1 2/2 3/3)"
        )


def pose(options: argparse.Namespace, island: Island, fixed: NDArray[np.int64] | None, beside: int) -> Posed:
    """Return the problem of an island as defined by the options.

    Parameters
    ----------
    options : Namespace
    island : Island
    fixed : (k,) int64 or None
        The mesh's vertices that are fixed at their texture coordinates; the boundaries if None.
    beside : int
        Index of the island's own copy of the outline, from the left.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        If options contradict each other, the mesh or the outline is wrong, or they do not fit together.
    """
    from quasiharmonic.apps.repair.fitting import held_in_place
    from quasiharmonic.ui.cli import report

    if options.to is None:
        posed = Posed(held_in_place(island, fixed, reference=options.reference))
    else:
        posed = _onto_outline(options, island, beside)
    if options.to is not None and not options.refine:
        with report.about(options.input):
            _check_room(posed.fitted.problem, options.to)
    if options.slide:
        _slide(options, posed)
    return posed


def _onto_outline(options: argparse.Namespace, island: Island, beside: int) -> Posed:
    """Map the boundary to an outline."""
    from quasiharmonic.apps.repair.fitting import laid_along
    from quasiharmonic.targets import outline
    from quasiharmonic.ui.cli import report

    try:
        contours = outline(options.to, font=options.font)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if options.to in text else f"--to {options.to}: {text}") from error
    corners = None if options.corners is None else read_corners(options.corners).within(island.vertices)
    angle = 20.0 if options.corner_angle is None else options.corner_angle
    with report.about(f"{options.input} --to {options.to}"):
        fitted = laid_along(
            island.V,
            island.F,
            contours,
            corners=corners,
            corner_angle=angle,
            reference=options.reference,
            beside=beside,
        )
    posed = Posed(fitted)
    if options.corners == "auto" and fitted.held:
        found = ",".join(map(str, island.vertices[fitted.held].tolist()))
        posed.notes.append(f"corners by angle, in the outline's order: --corners {found}")
    if fitted.filled:
        posed.facts["filled_holes"] = holes = fitted.filled
        which = "the hole" if holes == 1 else f"the {holes} holes"
        posed.notes.append(
            f"the surface has no hole, so {which} of {options.to} {'is' if holes == 1 else 'are'} filled"
        )
    return posed


def _slide(options: argparse.Namespace, posed: Posed) -> None:
    """Move the boundary onto the outline's curves; vertices from ``--corners`` stay fixed."""
    from dataclasses import replace

    from quasiharmonic.energies.newton.sliding import moved_onto
    from quasiharmonic.ui.cli import sliding

    posed.slide = True
    if options.to is not None:
        posed.slide = sliding.along(
            options.to,
            font=options.font,
            held=posed.fitted.held,
            corner_angle=20.0 if options.corner_angle is None else options.corner_angle,
            pieces=options.pieces,
        )
    posed.fitted = replace(posed.fitted, problem=moved_onto(posed.slide, posed.fitted.problem))
    posed.facts["slide"] = True


def _check_room(problem: Problem, to: str) -> None:
    """Raise ValueError for edges that the target flattens, before a search that may take long."""
    from quasiharmonic.targets import flattened_edges
    from quasiharmonic.util.arrays import named_edges

    flat = flattened_edges(problem.F, problem.fixed, problem.target)
    if len(flat):
        raise ValueError(
            f"the inner {named_edges(flat)} {'joins' if len(flat) == 1 else 'join'} boundary vertices between which "
            f"{to} does not bend outwards, so the triangles it cuts off degenerate: use --refine, or assign a vertex "
            "in between to a corner with --corners"
        )


def read_corners(text: str) -> AskedCorners:
    """Read the value of ``--corners``, or the file that it names.

    Raises
    ------
    ValueError
        If the value or the file is malformed.
    """
    from quasiharmonic.targets.boundary import corner_spec as asked_corners

    try:
        return asked_corners.read_corners(text)
    except ValueError as error:
        raise ValueError(f"--corners {text}: {error}") from None


def _degrees(text: str) -> float:
    """Convert text to an angle in degrees, 0 to 180; for argparse."""
    angle = float(text)
    if not 0 <= angle <= 180:
        raise argparse.ArgumentTypeError(f"{text} degrees: an angle from 0 to 180 is needed")
    return angle
