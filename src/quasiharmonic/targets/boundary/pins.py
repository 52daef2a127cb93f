"""Boundary vertices whose target positions on an outline the user chooses."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.targets.boundary.correspondence import arc, at
from quasiharmonic.targets.outlines.contours import corners as corners_of
from quasiharmonic.util.arrays import FloatArray, IntArray, check_range, index_array, kind_of, named

Corners = Sequence[int] | Mapping[int, int | ArrayLike]
# Maximum distance from the outline for a point to count as on it, as a share of the outline's larger side.
_ON = 1e-6
_MOST_LISTED = 12


class Pins:
    """Boundary vertices with target positions chosen by the user.

    Parameters
    ----------
    corners
        As in `boundary_to`.
    loops : list of (l,) int64
    contours : list of (k, 2) float64
        Contours in unit scale, each starting at its first corner.
    backwards : list of bool
        Whether each contour is reversed relative to the one that the user gave.
    corner_angle : float
        Degrees.
    exponent : int
        Binary exponent of the contours' unit.
    n : int
        Number of vertices of the surface.

    Attributes
    ----------
    contour_of : dict of int to int
        Contours of the loops for which the user gave points.
    """

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
            raise ValueError(f'corners are boundary vertices or "auto", not {kind_of(corners)}')
        pairs = list(corners.items()) if isinstance(corners, Mapping) else [(v, k) for k, v in enumerate(corners)]
        self._check_vertices([vertex for vertex, _ in pairs], n)
        where = {int(v): (i, k) for i, loop in enumerate(loops) for k, v in enumerate(loop.tolist())}
        for vertex, goal in pairs:
            loop, position = where[int(vertex)]
            if isinstance(goal, int | np.integer):
                self.wanted.setdefault(loop, {})[position] = int(goal)
                continue
            contour, along = self._nearest(np.asarray(goal, dtype=np.float64), int(vertex))
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
            raise ValueError("two boundary loops have vertices that go to the same contour of the outline")

    def _check_vertices(self, chosen: list[Any], n: int) -> None:
        vertices = index_array("corners", chosen)
        if vertices.ndim != 1 or not vertices.size:
            raise ValueError("corners must name boundary vertices by their integer indices")
        check_range("corners", vertices, n)
        alone, times = np.unique(vertices, return_counts=True)
        if (times > 1).any():
            raise ValueError(f"corners name {named('vertex', 'vertices', alone[times > 1])} more than once")
        inner = np.setdiff1d(alone, np.concatenate(self.loops))
        if inner.size:
            raise ValueError(f"{named('vertex', 'vertices', inner)} in corners, but not on the boundary")

    def along(self, loop: int, contour: int) -> list[tuple[int, float]]:
        """Return (position in the loop, parameter along its contour) for each pin, in order around the contour."""
        wanted = self.wanted.get(loop, {})
        marks, t = self.sharp[contour], arc(self.contours[contour])
        if self.all_corners and wanted and len(wanted) != len(marks):
            raise ValueError(
                f"{len(wanted)} corner {'vertex' if len(wanted) == 1 else 'vertices'} for a contour with {len(marks)} "
                f"{'corner' if len(marks) == 1 else 'corners'} ({self._listed(contour)}): name one for each, or say "
                "which corner each goes to"
            )
        names = self.loops[loop]
        found = []
        for position, goal in wanted.items():
            if isinstance(goal, int):
                if not 0 <= goal < len(marks):
                    last = len(marks) - 1
                    raise ValueError(
                        f"vertex {names[position]} goes to corner {goal}, but the contour has corners 0 to {last}: "
                        f"{self._listed(contour)}"
                    )
                goal = float(t[marks[goal]])
            found.append((goal, position))
        found.sort()
        places, positions = [goal for goal, _ in found], np.array([position for _, position in found], dtype=np.int64)
        for one, other in itertools.pairwise(found):
            if one[0] == other[0]:
                raise ValueError(
                    f"vertices {names[one[1]]} and {names[other[1]]} have the same target position on the outline"
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

    def _listed(self, contour: int) -> str:
        """List the corners of a contour with their numbers, for messages."""
        points = np.ldexp(self.contours[contour][self.sharp[contour]], self.exponent).tolist()
        named = [f"{k} at ({x:g}, {y:g})" for k, (x, y) in enumerate(points)]
        return ", ".join(named[:_MOST_LISTED]) + (", …" if len(named) > _MOST_LISTED else "")

    def _nearest(self, point: FloatArray, vertex: int) -> tuple[int, float]:
        """Return the contour on which a point lies and the parameter along it."""
        if point.shape != (2,) or not np.isfinite(point).all():
            raise ValueError(f"vertex {vertex} goes to a corner's number or a point (x, y), not to {point.tolist()}")
        # Clip, so that a point far from a tiny outline does not overflow.
        with np.errstate(over="ignore"):
            near = np.clip(np.ldexp(point, -self.exponent), -1e9, 1e9)
        least = _ON * float(np.ptp(self.contours[0], axis=0).max())
        best = (np.inf, 0, 0.0)
        for c, contour in enumerate(self.contours):
            t = np.append(arc(contour), 1.0)
            from_points = np.linalg.norm(contour - near, axis=1)
            k = int(np.argmin(from_points))
            if from_points[k] <= least:
                # Snap exactly to a contour point within the tolerance.
                return c, float(t[k])
            side = np.roll(contour, -1, axis=0) - contour
            share = np.clip(((near - contour) * side).sum(axis=1) / (side**2).sum(axis=1), 0, 1)
            away = np.linalg.norm(contour + share[:, None] * side - near, axis=1)
            k = int(np.argmin(away))
            best = min(best, (float(away[k]), c, float(t[k] + share[k] * (t[k + 1] - t[k])) % 1.0))
        off, c, along = best
        if off > least:
            x, y = np.ldexp(at(self.contours[c], np.array([along]))[0], self.exponent)
            raise ValueError(
                f"vertex {vertex} goes to ({point[0]:g}, {point[1]:g}), {np.ldexp(off, self.exponent):.3g} off the "
                f"outline at ({x:g}, {y:g})"
            )
        return c, along
