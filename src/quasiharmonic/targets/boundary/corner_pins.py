"""Boundary vertices with chosen target positions: chosen by the user, or by matching corners of loop and contour.

A user specifies corners by vertices, by positions, or as ``auto``.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.curves.arcs import nearest_on_segments
from quasiharmonic.geometry.exact.loops import join_items
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.io.untrusted import integer
from quasiharmonic.targets.boundary.correspondence import arc_parameters, points_at
from quasiharmonic.targets.boundary.turning import BoundaryLoop, mean_turns
from quasiharmonic.targets.outlines.contours import corners as corners_of
from quasiharmonic.targets.outlines.contours import turns
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_range,
    count_of,
    describe,
    index_array,
    pad_to_space,
    reject,
    scale_to_unit,
    to_complex,
    triangle_array,
    vertex_array,
)

Corners = Sequence[int] | Mapping[int, int | ArrayLike]

#: Forms of corners on the command line.
FORMS = "V, V:K and V:X:Y, where near:x,y,z may stand for the vertex V"
_NEAR = "near:"

Place: TypeAlias = tuple[float, float, float]
Goal: TypeAlias = int | tuple[float, float]


class Pins:
    """Boundary vertices with target positions chosen by the user, as ``corners`` in `boundary_to`.

    The ``contours`` have unit scale, with the binary ``exponent`` of the unit, and start at their first corners.
    ``backwards`` tells which are reversed relative to the user's. ``n`` is the number of vertices of the surface.
    ``contour_of`` maps the loops for which the user gave points to their contours.
    """

    # Maximum distance from the outline for a point to count as on it, as a share of the outline's larger side.
    _ON_OUTLINE = 1e-6
    # Maximum number of corners that a message lists.
    _MAX_LISTED = 12

    def __init__(
        self,
        corners: Corners | None,
        loops: list[IntArray],
        contours: list[FloatArray],
        backwards: list[bool],
        corner_angle: float,
        exponent: int,
        n: int,
    ) -> None:
        self.loops, self.contours, self.exponent = loops, contours, exponent
        self.sharp = [corners_of(c, corner_angle) for c in contours]
        # An outline without corners uses its first point as its only corner.
        self.sharp = [marks if marks.size else np.zeros(1, dtype=np.int64) for marks in self.sharp]
        # In the user's order, starting with the first.
        turned = zip(self.sharp, backwards, strict=True)
        self.sharp = [np.roll(marks[::-1], 1) if back else marks for marks, back in turned]
        self.contour_of: dict[int, int] = {}
        # For every loop, a dict from position in the loop to target: a corner's number, or a parameter along the
        # contour.
        self.wanted: dict[int, dict[int, int | float]] = {}
        self.all_corners = corners is not None and not isinstance(corners, Mapping)
        if corners is None:
            return
        if not isinstance(corners, Iterable):
            raise ValueError(f'corners are boundary vertices or "auto", not {describe(corners)}')
        pairs = list(corners.items()) if isinstance(corners, Mapping) else [(v, k) for k, v in enumerate(corners)]
        self._check_vertices([vertex for vertex, _ in pairs], n)
        where = {int(v): (i, k) for i, loop in enumerate(loops) for k, v in enumerate(loop.tolist())}
        for vertex, goal in pairs:
            loop, position = where[int(vertex)]
            if isinstance(goal, int | np.integer):
                self.wanted.setdefault(loop, {})[position] = int(goal)
                continue
            contour, along = self._find_on_outline(np.asarray(goal, dtype=np.float64), int(vertex))
            self.wanted.setdefault(loop, {})[position] = along
            if self.contour_of.setdefault(loop, contour) != contour:
                raise ValueError(
                    f"vertex {vertex} goes to a different contour than other vertices of its boundary loop"
                )
        if self.all_corners and len(self.wanted) > 1:
            raise ValueError(
                f"corners in order must lie on one boundary loop, but {len(self.wanted)} loops have some: "
                "say which corner each vertex goes to"
            )
        if len(set(self.contour_of.values())) < len(self.contour_of):
            raise ValueError(
                "two boundary loops have vertices that go to the same contour of the outline: give each loop its own "
                "contour"
            )

    def _check_vertices(self, chosen: list[Any], n: int) -> None:
        vertices = index_array("corners", chosen)
        if vertices.ndim != 1 or not vertices.size:
            raise ValueError("corners must name boundary vertices by their integer indices")
        check_range("corners", vertices, n)
        alone, times = np.unique(vertices, return_counts=True)
        reject(alone[times > 1], "vertex", "vertices", "corners name {} more than once")
        inner = np.setdiff1d(alone, np.concatenate(self.loops))
        reject(inner, "vertex", "vertices", "{} in corners, but not on the boundary")

    def along(self, loop: int, contour: int) -> list[tuple[int, float]]:
        """Return (position in the loop, parameter along its contour) for each pin, in order around the contour."""
        wanted = self.wanted.get(loop, {})
        marks, t = self.sharp[contour], arc_parameters(self.contours[contour])
        if self.all_corners and wanted and len(wanted) != len(marks):
            raise ValueError(
                f"{count_of('corner vertex', 'corner vertices', len(wanted))} for a contour with "
                f"{count_of('corner', 'corners', len(marks))} ({self._list_corners(contour)}): name one for each, or "
                "say which corner each goes to"
            )
        names = self.loops[loop]
        found = []
        for position, goal in wanted.items():
            if isinstance(goal, int):
                if not 0 <= goal < len(marks):
                    last = len(marks) - 1
                    raise ValueError(
                        f"vertex {names[position]} goes to corner {goal}, but the contour has corners 0 to {last}: "
                        f"{self._list_corners(contour)}"
                    )
                goal = float(t[marks[goal]])
            found.append((goal, position))
        found.sort()
        places, positions = [goal for goal, _ in found], np.array([position for _, position in found], dtype=np.int64)
        for one, other in itertools.pairwise(found):
            if one[0] == other[0]:
                raise ValueError(
                    f"vertices {names[one[1]]} and {names[other[1]]} have the same target position on the outline: "
                    f"move one of them"
                )
        if positions.size and (np.diff((positions - positions[0]) % len(names)) < 0).any():
            there = positions[np.argsort((positions - positions[0]) % len(names))]
            against = (np.diff((positions[::-1] - positions[-1]) % len(names)) > 0).all()
            remedy = ": reverse their order" if against else ""
            raise ValueError(
                f"corner vertices {', '.join(map(str, names[positions]))} follow each other in this order around the "
                f"outline, but in the order {', '.join(map(str, names[there]))} along the boundary, which has the "
                f"surface to its left{remedy}"
            )
        return list(zip(positions.tolist(), places, strict=True))

    def _list_corners(self, contour: int) -> str:
        """List the corners of a contour with their numbers, for messages."""
        points = np.ldexp(self.contours[contour][self.sharp[contour]], self.exponent).tolist()
        return join_items([f"{k} at ({x:g}, {y:g})" for k, (x, y) in enumerate(points)], self._MAX_LISTED)

    def _find_on_outline(self, point: FloatArray, vertex: int) -> tuple[int, float]:
        """Return the contour on which a point lies and the parameter along it."""
        if point.shape != (2,) or not np.isfinite(point).all():
            raise ValueError(f"vertex {vertex} goes to a corner's number or a point (x, y), not to {point.tolist()}")
        # Clip, so that a point far from a tiny outline does not overflow.
        with np.errstate(over="ignore"):
            near = np.clip(np.ldexp(point, -self.exponent), -1e9, 1e9)
        least = self._ON_OUTLINE * float(np.ptp(self.contours[0], axis=0).max())
        best = (np.inf, 0, 0.0)
        for c, contour in enumerate(self.contours):
            t = np.append(arc_parameters(contour), 1.0)
            from_points = np.linalg.norm(contour - near, axis=1)
            k = int(np.argmin(from_points))
            if from_points[k] <= least:
                # Snap exactly to a contour point within the tolerance.
                return c, float(t[k])
            share, away = nearest_on_segments(near, contour, np.roll(contour, -1, axis=0))
            k = int(np.argmin(away))
            best = min(best, (float(away[k]), c, float(t[k] + share[k] * (t[k + 1] - t[k])) % 1.0))
        off, c, along = best
        if off > least:
            x, y = np.ldexp(points_at(self.contours[c], np.array([along]))[0], self.exponent)
            raise ValueError(
                f"vertex {vertex} goes to ({point[0]:g}, {point[1]:g}), {np.ldexp(off, self.exponent):.3g} off the "
                f"outline at ({x:g}, {y:g})"
            )
        return c, along


def pins_by_angle(
    loop: BoundaryLoop, flat: FloatArray, contour: FloatArray, corner_angle: float
) -> list[tuple[int, float]]:
    """Find as many corners of a boundary loop as a contour has, and assign them to the contour's corners.

    The corners keep their cyclic order, so only the first one must be chosen. Turning angles and the lengths between
    corners determine it: convex corners go to convex ones, long sides to long ones. If several choices are about
    equally good, as for a square, the one with the least rotation of ``flat`` (l, 2), the projected loop, is taken. The
    result has positions in the loop and parameters from 0 to 1 along the contour, in order around. ValueError when the
    loop has fewer vertices than the contour has corners.
    """
    # Maximum loss of similarity, relative to the best value (2 at most), that is accepted for an upright map.
    similar = 0.1
    sharp = corners_of(contour, corner_angle)
    if not sharp.size:
        return []
    positions, turning = loop.corners(len(sharp))
    sides = np.linalg.norm(np.roll(contour, -1, axis=0) - contour, axis=1)
    ends = arc_parameters(contour)[sharp]
    lengths = np.cumsum(loop.lengths / loop.lengths.max())
    runs = lengths[positions - 1] / lengths[-1]
    alike = _likeness(turning + 0j, mean_turns(sides, turns(contour), sharp) + 0j)
    alike += _likeness(_measure_gaps(runs) + 0j, _measure_gaps(ends) + 0j)
    seen, goal = to_complex(flat[positions]), to_complex(contour[sharp])
    upright = _likeness(seen - seen.mean(), goal - goal.mean())
    first = int(np.argmax(np.where(alike >= alike.max() - similar, upright, -np.inf)))
    return list(zip(np.roll(positions, -first).tolist(), ends.tolist(), strict=True))


def _measure_gaps(along: FloatArray) -> FloatArray:
    """Distances from each of some parameters on a closed curve of length 1 to the next."""
    return np.asarray((np.roll(along, -1) - along) % 1.0)


def _likeness(one: np.ndarray, other: np.ndarray) -> FloatArray:
    """Correlation of two cyclic complex sequences, for each cyclic shift of the first; at most 1."""
    size = np.linalg.norm(one) * np.linalg.norm(other)
    return np.array([np.vdot(other, np.roll(one, -k)).real for k in range(len(one))]) / (size or 1.0)


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
        lines = Path(text).read_text(encoding="utf-8-sig", errors="replace").splitlines()
        words = [re.sub(r"\s*,\s*", ",", line.split("#")[0]).replace(":", " ").split() for line in lines]
        entries = [_parse_entry(":".join(line)) for line in words if line]
    else:
        entries = [_parse_entry(part) for part in _split_entries(text)]
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
        raise ValueError("the surface is closed: it has no boundary vertices; cut it open first (cut_open; --cut)")
    border = np.sort(np.concatenate(loops))
    both = scale_to_unit(np.concatenate([pad_to_space(points[border]), pad_to_space(wanted)]))
    here, there = both[: len(border)], both[len(border) :]
    return np.array([border[np.argmin(((here - place) ** 2).sum(axis=1))] for place in there], dtype=np.int64)


def _split_entries(text: str) -> list[str]:
    """Split a list of entries at commas; a position contains two commas of its own."""
    parts, entries = [part.strip() for part in text.split(",")], []
    while parts:
        size = 3 if parts[0].startswith(_NEAR) else 1
        entries.append(",".join(parts[:size]))
        del parts[:size]
    return entries


def _parse_entry(text: str) -> tuple[int | Place, Goal | None]:
    """Parse a vertex or a position, with its target if given."""
    vertex, *goal = text.removeprefix(_NEAR).split(":")
    try:
        who = _parse_place(vertex) if text.startswith(_NEAR) else integer(vertex.strip().encode())
        if not goal:
            return who, None
        if len(goal) == 1:
            return who, integer(goal[0].strip().encode())
        x, y = map(float, goal)
        return who, (x, y)
    except ValueError:
        raise ValueError(f"{text[:40]!r} is not one of {FORMS}") from None


def _parse_place(text: str) -> Place:
    x, y, z = map(float, text.split(","))
    if not np.isfinite((x, y, z)).all():
        raise ValueError("no place")
    return x, y, z
