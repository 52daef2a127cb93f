"""Motions of named groups of nodes: ``--group``, then ``--translate``, ``--rotate`` and ``--scale`` in any order."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from math import cos, isfinite, radians, sin
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli.arguments import Option, convert

if TYPE_CHECKING:
    from collections.abc import Callable

    from quasiharmonic.io.fem.files import FemMesh
    from quasiharmonic.util.arrays import FloatArray, IntArray


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
        "point about which the last --group is rotated and scaled (default: the mean of its nodes, where they are by "
        "then)",
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
    return motions


def move_groups(mesh: FemMesh, motions: list[GroupMotion]) -> tuple[IntArray, Callable[[float], FloatArray]]:
    """Return the nodes (k,) of all groups, and a function from the share of the motion to their positions (k, d).

    Motions of the same group are applied one after another. ValueError if groups with a common node move it to
    different positions.
    """
    import numpy as np

    used = np.unique(mesh.F)
    groups = {motion.name: np.intersect1d(mesh.find_set(motion.name), used) for motion in motions}
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
