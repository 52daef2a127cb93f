"""Finite-element meshes, in the plane and in space, as inputs of commands, and motions of their groups of nodes.

The motions are the options ``--group``, then ``--translate``, ``--rotate`` and ``--scale`` in any order.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from math import cos, isfinite, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli import pipeline, report
from quasiharmonic.ui.cli.arguments import Option, convert

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.io.fem.files import FemMesh
    from quasiharmonic.util.arrays import FloatArray, IntArray


def check(options: argparse.Namespace) -> int:
    """Report what the mesh is and which elements are inverted or overlap; return the exit status of ``qhm check``."""
    from quasiharmonic.apps.mesh_motion.morph_result import describe_overlap
    from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
    from quasiharmonic.geometry.mesh.elements import covering_triangles, name_elements
    from quasiharmonic.io.fem.files import read_fem, read_volume
    from quasiharmonic.problem.inspection import inspect_mesh
    from quasiharmonic.util.arrays import count_of

    _reject(options, "any_triangulation", "fixed", "weld", precision="--as")
    volume = read_volume(options.input)
    if len(volume.F):
        return _check_volume(options, volume)
    mesh = read_fem(options.input)
    inverted = inverted_elements(mesh.F, mesh.points)
    with report.name_source(options.input):
        found = inspect_mesh(mesh.points, covering_triangles(mesh.F)[0])
    elements = count_of("element", "elements", len(mesh.F))
    verdict = f"inverted: {name_elements(mesh.F, inverted)}" if inverted.size else f"None of {elements} is inverted."
    overlapping, overlap = (inverted[:0], []) if inverted.size else describe_overlap(mesh.F, mesh.points)
    facts = {
        "input": str(options.input),
        "mesh": found.to_dict(),
        "elements": len(mesh.F),
        "injective": not inverted.size,
        "inverted": inverted.tolist(),
        "overlapping": overlapping.tolist(),
    }
    first = f"{options.input}: {elements}, split into triangles: {found.summary()}"
    return pipeline.conclude(options, pipeline.Account(facts, [first, verdict, *overlap], not inverted.size))


def _check_volume(options: argparse.Namespace, mesh: FemMesh) -> int:
    """Certify tetrahedra as they are in the file; report hexahedra with a corner that is not positive."""
    from quasiharmonic.apps.tetrahedra.certificate import certify_arrays
    from quasiharmonic.apps.tetrahedra.elements import find_bad_corners
    from quasiharmonic.geometry.mesh.elements import split_solids
    from quasiharmonic.util.arrays import count_of, names_of

    T, H = split_solids(mesh.F)
    facts: dict[str, Any] = {"input": str(options.input), "elements": len(mesh.F)}
    lines, good = [], True
    if len(T):
        # Faces to hexahedra would count as boundary, so with hexahedra the boundary is not checked.
        certificate = certify_arrays(T, mesh.points, boundary=not len(H))
        good = certificate.positive if len(H) else bool(certificate.injective)
        facts |= certificate.to_dict()
        lines.append(certificate.summary())
    if len(H):
        bad = find_bad_corners(H, mesh.points)
        good = good and not bad.size
        facts |= {"hexahedra": len(H), "corners_not_positive": bad.tolist(), "injective": None if good else False}
        hexahedra = count_of("hexahedron", "hexahedra", len(H))
        lines.append(
            f"Of {hexahedra}, these have a corner that is not positive: {names_of('hexahedron', 'hexahedra', bad)}."
            if bad.size
            else f"All corners of {hexahedra} are positive. This does not certify them: a hexahedron with positive "
            "corners can be inverted inside."
        )
    return pipeline.conclude(options, pipeline.Account(facts, [f"{options.input}: {' '.join(lines)}"], good))


def measure(options: argparse.Namespace) -> int:
    """Report the quality of the elements; return the exit status of ``qhm measure``."""
    _reject(options, "export", "distances")
    mesh, quality = _read_quality(options.input)
    facts: dict[str, Any] = {
        "input": str(options.input),
        "elements": len(mesh.F),
        "quality": {"minimum": float(quality.min()), "mean": float(quality.mean()), "worst": int(quality.argmin())},
    }
    text = (
        f"quality of {len(mesh.F)} elements (1: regular, 0: no area or volume, negative: inverted): "
        f"mean {quality.mean():.4g}, minimum {quality.min():.4g} at element {quality.argmin()}"
    )
    return pipeline.conclude(options, pipeline.Account(facts, [text]))


def plot(options: argparse.Namespace) -> int:
    """Draw the elements, or a cut through tetrahedra, coloured by quality; return the exit status of ``qhm plot``."""
    import numpy as np

    from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
    from quasiharmonic.ui.plot.canvas import save_picture
    from quasiharmonic.ui.plot.measures import cut_tetrahedra, elements_figure, outline_elements

    if options.kind not in (None, "map"):
        raise ValueError(f"--kind {options.kind} needs a surface with a map: omit it for {options.input.suffix} files")
    _reject(options, "texture", "measure")
    mesh, quality = _read_quality(options.input)
    if mesh.points.shape[1] == 3:
        drawn = cut_tetrahedra(mesh.F, mesh.points, int(quality.argmin()))
        inverted = np.flatnonzero(quality <= 0)
    else:
        drawn, inverted = outline_elements(mesh.F, mesh.points), inverted_elements(mesh.F, mesh.points)
    save_picture(options.output, elements_figure([drawn], [quality], inverted))
    return report.tell_written(options.output)


def read_tetrahedra(path: Path) -> FemMesh | None:
    """Read a mesh of tetrahedra; None if the file has no elements with volume.

    MeshFileError if it has hexahedra, or a corner is not finite.
    """
    import numpy as np

    from quasiharmonic.geometry.mesh.elements import split_solids
    from quasiharmonic.io.errors import MeshFileError
    from quasiharmonic.io.fem.files import read_volume
    from quasiharmonic.util.arrays import names_of

    mesh = read_volume(path)
    if len(split_solids(mesh.F)[1]):
        raise MeshFileError(path, "has hexahedra", remedy="split them into tetrahedra")
    lost = np.setdiff1d(mesh.F, np.flatnonzero(np.isfinite(mesh.points).all(axis=1)))
    if lost.size:
        raise MeshFileError(path, f"not finite at {names_of('point', 'points', lost)} (0-based)")
    return mesh if len(mesh.F) else None


def _read_quality(path: Path) -> tuple[FemMesh, NDArray[np.float64]]:
    """Read a mesh, of tetrahedra or planar, and return it with the quality (f,) of its elements."""
    from quasiharmonic.apps.mesh_motion.quality import element_quality
    from quasiharmonic.apps.tetrahedra.result import tetrahedron_quality
    from quasiharmonic.io.fem.files import read_fem

    solid = read_tetrahedra(path)
    if solid is not None:
        return solid, tetrahedron_quality(solid.F, solid.points)
    mesh = read_fem(path)
    return mesh, element_quality(mesh.F, mesh.points)


def _reject(options: argparse.Namespace, *names: str, **written: str) -> None:
    """Raise ValueError for options that have no meaning for finite-element meshes; some are ``written`` differently."""
    for name, option in {**{name: "--" + name.replace("_", "-") for name in names}, **written}.items():
        value = getattr(options, name)
        if value is not None and value is not False:
            raise ValueError(f"{option} needs a surface with a map: omit it for {options.input.suffix} files")


class InOrder(argparse.Action):
    """Adds the name of an option and its value to one list, in the order of the command line."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        """Add the option."""
        known = getattr(namespace, self.dest) or []
        setattr(namespace, self.dest, [*known, (self.option_strings[0].removeprefix("--"), values)])


def in_order(kind: Callable[[str], Any], metavar: str, words: str) -> Option:
    """Return an option of the list ``motions``."""
    return {"type": kind, "metavar": metavar, "help": words, "action": InOrder, "dest": "motions"}


def vector(text: str) -> tuple[float, ...]:
    """Convert two or three numbers separated by commas; for argparse."""
    return convert(
        text,
        lambda text: tuple(map(float, text.split(","))),
        lambda numbers: len(numbers) in (2, 3) and all(map(isfinite, numbers)),
        "a vector X,Y or X,Y,Z",
    )


def angle(text: str) -> float:
    """Convert a finite number; for argparse."""
    return convert(text, float, isfinite, "an angle in degrees")


def factor(text: str) -> float:
    """Convert a positive number; for argparse."""
    return convert(text, float, lambda value: 0 < value < float("inf"), "a positive number")


#: The options that follow ``--group``.
MOTIONS: dict[str, Option] = {
    "translate": in_order(vector, "X,Y[,Z]", "translate the last --group"),
    "rotate": in_order(angle, "DEG", "rotate the last --group counterclockwise"),
    "axis": in_order(vector, "X,Y,Z", "for --rotate in space: axis of the last --group (default: 0,0,1)"),
    "scale": in_order(factor, "S", "scale the last --group"),
    "centre": in_order(
        vector,
        "X,Y[,Z]",
        "point about which the last --group is rotated and scaled (default: the mean of its nodes after its earlier "
        "motions)",
    ),
}


@dataclass
class GroupMotion:
    """Steps of the motion of a group, in their order."""

    name: str
    steps: list[tuple[str, Any]] = field(default_factory=list)
    axis: tuple[float, ...] | None = None
    centre: tuple[float, ...] | None = None


def list_motions(given: list[tuple[str, Any]], axes: int) -> list[GroupMotion]:
    """Return the motions that the options define; ValueError if they contradict each other or the dimension."""
    motions: list[GroupMotion] = []
    for option, value in given:
        if option == "group":
            motions.append(GroupMotion(value))
            continue
        if not motions:
            raise ValueError(f"--{option} needs a group: put --group NAME before it")
        last = motions[-1]
        if option == "axis" and axes == 2:
            raise ValueError("--axis is for meshes in space: omit it")
        if isinstance(value, tuple) and (len(value) != axes or (option == "axis" and not any(value))):
            raise ValueError(f"--{option} must have {axes} numbers{', not all zero' * (option == 'axis')}")
        if option in ("axis", "centre"):
            if getattr(last, option) is not None:
                raise ValueError(f"--{option} is given twice for one --group: repeat --group {last.name}")
            setattr(last, option, value)
        else:
            last.steps.append((option, value))
    for one in motions:
        for option, of in (("axis", ("rotate",)), ("centre", ("rotate", "scale"))):
            if getattr(one, option) is not None and not any(step in of for step, _ in one.steps):
                needed = " or ".join(f"--{step}" for step in of)
                raise ValueError(
                    f"--{option} of --group {one.name} has no effect without {needed}: add it, or omit this"
                )
    return motions


def move_groups(mesh: FemMesh, motions: list[GroupMotion]) -> tuple[IntArray, Callable[[float], FloatArray]]:
    """Return the nodes (k,) of all groups, and a function from the share of the motion to their positions (k, d).

    Motions of the same group are applied one after another. MeshFileError if no element uses a node of a group;
    ValueError if groups with a common node move it to different positions.
    """
    import numpy as np

    from quasiharmonic.io.errors import MeshFileError

    used = np.unique(mesh.F)
    groups = {motion.name: np.intersect1d(mesh.find_set(motion.name), used) for motion in motions}
    for name, own in groups.items():
        if not own.size:
            raise MeshFileError(mesh.source, f"no element uses a node of the group {name!r}", remedy="omit it")
    nodes = np.unique(np.concatenate(list(groups.values())))

    def place(share: float) -> FloatArray:
        there, unknown = mesh.points[nodes], np.ones(len(nodes), dtype=bool)
        for name, own in groups.items():
            positions = mesh.points[own]
            for motion in motions:
                if motion.name == name:
                    positions = _move(positions, motion, share)
            rows = np.searchsorted(nodes, own)
            size = np.abs(positions).max(initial=0.0)
            clash = ~unknown[rows] & (np.abs(there[rows] - positions) > 1e-9 * size).any(axis=1)
            if clash.any():
                raise ValueError(
                    f"vertex {own[clash][0]} is in the group {name!r} and in another one that moves differently: give "
                    "both the same motion, or groups without common vertices"
                )
            there[rows] = np.where(unknown[rows, None], positions, there[rows])
            unknown[rows] = False
        return there

    return nodes, place


def _move(points: FloatArray, motion: GroupMotion, share: float) -> FloatArray:
    """Return points (k, d) after a share of a motion."""
    import numpy as np

    for option, value in motion.steps:
        if option == "translate":
            points = points + share * np.array(value)
            continue
        centre = points.mean(axis=0) if motion.centre is None else np.array(motion.centre)
        matrix = value**share * np.eye(points.shape[1]) if option == "scale" else _rotation(motion, value * share)
        points = centre + (points - centre) @ matrix[: points.shape[1], : points.shape[1]].T
    return points


def _rotation(motion: GroupMotion, degrees: float) -> FloatArray:
    """Return the matrix (3, 3) of a rotation about the motion's axis, by default z."""
    import numpy as np

    axis = np.array(motion.axis or (0.0, 0.0, 1.0))
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = radians(degrees)
    # Rodrigues' formula.
    return np.asarray(np.eye(3) + sin(turn) * cross + (1 - cos(turn)) * cross @ cross)
