"""Corners of a boundary as a user specifies them (vertices, positions, or ``auto``), and the vertices they refer to."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.io.lowlevel.textual import integer
from quasiharmonic.targets.boundary.corner_pins import Corners
from quasiharmonic.util.arrays import IntArray, pad_to_space, scale_to_unit, triangle_array, vertex_array

FORMS = "V, V:K and V:X:Y, where near:x,y,z may stand for the vertex V"
_NEAR = "near:"

Place: TypeAlias = tuple[float, float, float]
Goal: TypeAlias = int | tuple[float, float]


@dataclass(frozen=True)
class CornerSpec:
    """User-specified corners, independent of the surface."""

    # Each entry has a vertex and its target. The vertex may be given by a position in space, which stands for the
    # nearest boundary vertex. The target is a corner's number or a point of the outline. If the vertices go to the
    # outline's corners in order, all targets are None.
    entries: tuple[tuple[int | Place, Goal | None], ...] | Literal["auto"]

    def within(self, vertices: IntArray) -> CornerSpec | None:
        """Return the corners of one island, with vertices in the island's numbering; None if no corner is left.

        ``vertices`` (m,) is the mesh vertex of each island vertex, ascending. If a mesh vertex occurs twice, the first
        is used.
        """
        if isinstance(self.entries, str) or np.array_equal(vertices, np.arange(len(vertices))):
            return self
        own = [
            (int(np.searchsorted(vertices, who)) if isinstance(who, int) else who, goal)
            for who, goal in self.entries
            if not isinstance(who, int) or who in vertices
        ]
        return CornerSpec(tuple(own)) if own else None

    def on(self, V: ArrayLike, F: ArrayLike) -> Corners | Literal["auto"]:
        """Return the corners for a surface, as `boundary_to` accepts them; ValueError when a vertex occurs twice."""
        if isinstance(self.entries, str):
            return "auto"
        positions = [who for who, _ in self.entries if isinstance(who, tuple)]
        found = iter(nearest_on_boundary(V, F, positions).tolist() if positions else [])
        named: dict[int, str] = {}
        for who, _ in self.entries:
            vertex = next(found) if isinstance(who, tuple) else who
            word = f"{_NEAR}{','.join(f'{x:g}' for x in who)}" if isinstance(who, tuple) else f"vertex {who}"
            if vertex in named and {word, named[vertex]} == {f"vertex {vertex}"}:
                raise ValueError(f"{word} is named more than once")
            if vertex in named:
                raise ValueError(f"{named[vertex]} and {word} are the same boundary vertex, {vertex}")
            named[vertex] = word
        goals = {v: goal for v, (_, goal) in zip(named, self.entries, strict=True) if goal is not None}
        return goals or list(named)


def read_corners(text: str) -> CornerSpec:
    """Parse corners from a string, or from the text file that it names.

    Parameters
    ----------
    text : str
        ``auto``, or ``V,V,…`` with vertices counted from 0, for the outline's corners in order. ``near:x,y,z`` may
        replace ``V`` and means the boundary vertex nearest to a position. ``V:K`` or ``V:X:Y`` gives the corner ``K``
        or the point ``(X, Y)`` of the outline. Or the name of a text file with one entry per line; blanks may replace
        colons, and ``#`` begins a comment.

    Returns
    -------
    CornerSpec

    Raises
    ------
    ValueError
        When the text cannot be parsed, or only some entries have a target.

    Examples
    --------
    >>> read_corners("near:0,0.5,0:2,17:3").entries
    (((0.0, 0.5, 0.0), 2), (17, 3))
    """
    if text == "auto":
        return CornerSpec("auto")
    if os.path.isfile(text):
        lines = Path(text).read_text(encoding="utf-8", errors="replace").splitlines()
        words = [re.sub(r"\s*,\s*", ",", line.split("#")[0]).replace(":", " ").split() for line in lines]
        entries = [_entry(":".join(line)) for line in words if line]
    else:
        entries = [_entry(part) for part in _split(text)]
    if not entries:
        raise ValueError(f"the file names no corners: each line needs one of {FORMS}")
    lone = [who for who, goal in entries if goal is None]
    if lone and len(lone) < len(entries):
        who = f"vertex {lone[0]}" if isinstance(lone[0], int) else f"the vertex near {lone[0]}"
        raise ValueError(f"{who} has no corner or point, but other vertices have one: give one for each")
    return CornerSpec(tuple(entries))


@accepts_mesh
def nearest_on_boundary(V: ArrayLike, F: ArrayLike, places: ArrayLike) -> IntArray:
    """Find the boundary vertex nearest to each given position.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    places : (k, 3) or (k, 2) array
        Positions. A missing third coordinate is 0, here and in ``V``.

    Returns
    -------
    (k,) int64
        The smallest index if several vertices are equally near, such as copies along a cut.

    Raises
    ------
    ValueError
        When arrays are malformed, or the surface is closed.
    """
    points, wanted = vertex_array(V), vertex_array(places, "places")
    loops = boundary_loops(triangle_array(F, len(points)), len(points))
    if not loops:
        raise ValueError("the surface is closed: it has no boundary vertices")
    border = np.sort(np.concatenate(loops))
    both = scale_to_unit(np.concatenate([pad_to_space(points[border]), pad_to_space(wanted)]))
    here, there = both[: len(border)], both[len(border) :]
    return np.array([border[np.argmin(((here - place) ** 2).sum(axis=1))] for place in there], dtype=np.int64)


def _split(text: str) -> list[str]:
    """Split a list of entries at commas; a position contains two commas of its own."""
    parts, entries = [part.strip() for part in text.split(",")], []
    while parts:
        size = 3 if parts[0].startswith(_NEAR) else 1
        entries.append(",".join(parts[:size]))
        del parts[:size]
    return entries


def _entry(text: str) -> tuple[int | Place, Goal | None]:
    """Parse a vertex or a position, with its target if given."""
    vertex, *goal = text.removeprefix(_NEAR).split(":")
    try:
        who = _place(vertex) if text.startswith(_NEAR) else integer(vertex.strip().encode())
        if not goal:
            return who, None
        if len(goal) == 1:
            return who, integer(goal[0].strip().encode())
        x, y = map(float, goal)
        return who, (x, y)
    except ValueError:
        raise ValueError(f"{text[:40]!r} is not one of {FORMS}") from None


def _place(text: str) -> Place:
    x, y, z = map(float, text.split(","))
    if not np.isfinite((x, y, z)).all():
        raise ValueError("no place")
    return x, y, z
