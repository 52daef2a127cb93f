"""Collision avoidance by way of bijectivity: elastic shapes, and the air between them (§11.2, Figure 20).

Shapes and air together are one triangle mesh. As long as none of its triangles is inverted, and the frame does not
cross itself, no two shapes overlap, nor does a shape overlap itself, an obstacle or the container. So contact needs no
detection and no response: shapes come to rest in the injective map of least energy. The air has next to no weight in
that energy, and it is triangulated anew whenever time goes on, so that things can slide past each other.

    moved frame ──injective map──▶ valid again ──least energy──▶ at rest ──new air──▶ next frame
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP, AreaBarrier, Combination
from quasiharmonic.energies.newton.newton_descent import NewtonDescent, in_units
from quasiharmonic.geometry.exact.certificate import Certificate, certify, is_injective
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.solver.refine.mapping import injective_map
from quasiharmonic.targets.outlines.contours import signed_area
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_finite,
    kind_of,
    map_array,
    named,
    real_array,
    triangle_array,
)

#: ARAP, and what keeps triangles from collapsing.
_ELASTIC = Combination((1.0, ARAP()), (0.1, AreaBarrier()))
# Of a Newton step's promise, relative to the energy: shapes are at rest.
_AT_REST = 1e-4
# Of the way that a frame is to go: steps are halved down to this.
_SHORTEST = 1 / 64


@dataclass(frozen=True, eq=False)
class AirMeshState:
    """Shapes, frame and air at one time.

    Attributes
    ----------
    points : (n + k, 2) float64
        The shapes' vertices, then the frame's, loop by loop.
    F : (f, 3) int64
        The shapes' triangles.
    air : (a, 3) int64
        The air's triangles, of the same points.
    certificate : Certificate
        The exact verdict on shapes and air together: no overlap if it is bijective.
    energy : float
        Mean elastic energy of the shapes.
    """

    points: FloatArray
    F: IntArray
    air: IntArray
    certificate: Certificate
    energy: float


class AirMesh:
    """Elastic shapes in a container with obstacles that move.

    Parameters
    ----------
    points : (n, 2) array
        Vertices of the shapes at rest and at the start. Every one belongs to a triangle.
    F : (f, 3) array of int
        Triangles of one or more shapes, with or without holes, counterclockwise.
    frame : sequence of (k, 2) arrays
        The container's corners, counterclockwise, then those of each obstacle. Long sides are better given
        several points.
    gap : float, optional
        Air thinner than this pushes what is around it apart, in the unit of the points; a hundredth of the
        shapes' mean edge by default.
    air_weight : float
        Weight of the air in the energy, against 1 for the shapes; small, but not 0, or the first
        triangle of air to collapse would stop everything.

    Raises
    ------
    ValueError
        When an array has the wrong shape, a triangle is not counterclockwise, or shapes, container and
        obstacles overlap or touch at the start.
    ImportError
        When Shapely, which triangulates the air, is not installed.

    Attributes
    ----------
    moment : Moment
        The present.
    """

    def __init__(
        self,
        points: ArrayLike,
        F: ArrayLike,
        frame: Sequence[ArrayLike],
        *,
        gap: float | None = None,
        air_weight: float = 1e-3,
    ) -> None:
        self._rest = map_array("points", points)
        self._F = triangle_array(F, len(self._rest))
        idle = np.setdiff1d(np.arange(len(self._rest)), self._F)
        if idle.size:
            raise ValueError(f"no triangle uses {named('vertex', 'vertices', idle)}: remove unused vertices")
        turned = np.flatnonzero(orientation(*(self._rest[self._F[:, k]] for k in range(3))) <= 0)
        if turned.size:
            raise ValueError(f"{named('triangle', 'triangles', turned)} not counterclockwise")
        if not 0 < air_weight <= 1:
            raise ValueError(f"air_weight must be above 0 and at most 1, not {air_weight}")
        self._air_weight = air_weight
        sides = self._rest[self._F] - np.roll(self._rest[self._F], 1, axis=1)
        self._gap = 1e-2 * float(np.linalg.norm(sides, axis=2).mean()) if gap is None else float(gap)
        if not 0 < self._gap < np.inf:
            raise ValueError(f"gap must be positive, not {gap}")
        self._loops = boundary_loops(self._F, len(self._rest))
        around = _loops_of(frame)
        self._sizes = [len(loop) for loop in around]
        if min(self._sizes) < 3:
            raise ValueError(f"each loop of the frame needs at least 3 points, not {self._sizes}")
        self.moment = self._at_rest(np.concatenate([self._rest, self._stacked(around)]))
        if not self.moment.certificate.bijective:
            raise ValueError(f"shapes, container and obstacles overlap. {self.moment.certificate.summary()}")

    def advance(self, frame: Sequence[ArrayLike], *, max_iterations: int = 300) -> AirMeshState:
        """Move the frame and let the shapes come to rest.

        Edges of air between points of the frame can forbid a move that is not forbidden in itself. So what cannot
        be done at once is done in shorter steps along straight lines, with fresh air at each.

        Parameters
        ----------
        frame : sequence of (k, 2) arrays
            As many loops of as many points as at the start.
        max_iterations : int
            Linear solves at most to make the mesh valid after a step.

        Returns
        -------
        Moment
            Certified; also kept as ``moment``.

        Raises
        ------
        ValueError
            When loops have other sizes than at the start, or a point is not finite.
        RuntimeError
            When that does not help: the frame leaves no room, or crosses itself or what it may not. The present is
            then as it was.
        """
        there = self._stacked(frame)
        n, present = len(self._rest), self.moment
        here, done, step = present.points[n:], 0.0, 1.0
        try:
            while done < 1:
                t = min(done + step, 1.0)
                reached = self._step(here + t * (there - here) if t < 1 else there, max_iterations)
                if reached is not None:
                    self.moment, done = reached, t
                elif step > _SHORTEST:
                    step /= 2
                else:
                    raise RuntimeError(
                        f"the frame can be moved only {done:.1%} of the way: then no space is "
                        f"left, or it crosses itself or "
                        "meets a shape"
                    )
        except BaseException:
            self.moment = present
            raise
        return self.moment

    def _step(self, frame: FloatArray, max_iterations: int) -> AirMeshState | None:
        """The present with the frame elsewhere, at rest; None where that cannot be."""
        try:
            moved = self._moved(frame, max_iterations)
            reached = None if moved is None else self._at_rest(moved)
        except ValueError:
            # What has been checked when it was given is a frame by its form only: it may meet itself or the shapes.
            return None
        return reached if reached is not None and reached.certificate.bijective else None

    def _moved(self, frame: FloatArray, max_iterations: int) -> FloatArray | None:
        """The points with the frame elsewhere and no triangle inverted; None where the air does not let it."""
        n, then = len(self._rest), self.moment
        everything = np.concatenate([then.F, then.air])
        moved = np.concatenate([then.points[:n], frame])
        if is_injective(everything, moved):
            return moved
        fixed = np.arange(n, len(moved))
        result = injective_map(then.points, everything, fixed, frame, max_iterations=max_iterations)
        return result.uv if result.injective else None

    def _at_rest(self, points: FloatArray) -> AirMeshState:
        """Let shapes come to rest from a valid state, with fresh air before and after."""
        n = len(self._rest)
        fixed = np.arange(n, len(points))
        last = np.inf
        while True:
            air = self._triangulated(points)
            everything = np.concatenate([self._F, air])
            # The shapes' triangles at rest are those of the start, the air's those of the present, unless too thin.
            energy = DeformationEnergy(
                np.concatenate([self._rest, thickened(points[air], self._gap).reshape(-1, 2)]),
                everything,
                _ELASTIC,
                weights=np.concatenate([np.ones(len(self._F)), np.full(len(air), self._air_weight)]),
                rest_F=np.concatenate([self._F, n + np.arange(air.size).reshape(-1, 3)]),
            )
            descent = NewtonDescent(energy, points, fixed, 0, "auto")
            for _ in descent.descend(60, _AT_REST):
                pass
            points = descent.positions(descent.w)
            elastic = self._elastic(points)
            # Fresh air may let them slide further.
            if elastic > (1 - 1e-2) * last:
                break
            last = elastic
        air = self._triangulated(points)
        return AirMeshState(points, self._F, air, certify(np.concatenate([self._F, air]), points), elastic)

    def _elastic(self, points: FloatArray) -> float:
        return DeformationEnergy(self._rest, self._F, _ELASTIC).value(in_units(points[: len(self._rest)], 0))

    def _stacked(self, frame: Sequence[ArrayLike]) -> FloatArray:
        """The frame's points, loop by loop, checked."""
        loops = _loops_of(frame)
        sizes = [len(loop) for loop in loops]
        if sizes != self._sizes:
            raise ValueError(
                f"the frame must have loops of {self._sizes} points, as in the initial frame, not of {sizes}"
            )
        for k, loop in enumerate(loops):
            check_finite(f"loop {k} of the frame", "point", "points", loop)
        return np.concatenate(loops)

    def _triangulated(self, points: FloatArray) -> IntArray:
        """Triangulate what neither shapes nor obstacles cover, without new points."""
        return air_between(points, self._loops, self._sizes)


def _loops_of(frame: Iterable[ArrayLike]) -> list[FloatArray]:
    """The loops of a frame, one or more, each as an array (k, 2) of real numbers, a copy."""
    if isinstance(frame, str | bytes) or not isinstance(frame, Iterable):
        raise ValueError(
            f"frame must be a list of loops (k, 2), the container first, then obstacles, not {kind_of(frame)}"
        )
    loops = [real_array(f"loop {k} of the frame", loop) for k, loop in enumerate(frame)]
    if not loops:
        raise ValueError("frame has no loops: the first must be the container")
    if all(loop.shape == (2,) for loop in loops):
        raise ValueError("frame must be a list of loops (k, 2), not a single loop: pass [frame]")
    for k, loop in enumerate(loops):
        if loop.ndim != 2 or loop.shape[1] != 2:
            raise ValueError(f"loop {k} of the frame must have shape (k, 2), not {loop.shape}")
    return loops


def air_between(points: FloatArray, loops: Sequence[IntArray], frame: Sequence[int]) -> IntArray:
    """Triangulate the space between shapes, a container and obstacles by constrained Delaunay, without new points.

    Parameters
    ----------
    points : (n, 2) float64
        All vertices; the last ``sum(frame)`` are the frame's, loop by loop.
    loops : list of (l,) int64
        Boundary loops of the shapes, each shape to its loop's left.
    frame : sequence of int
        Sizes of the frame's loops, the container's first.

    Returns
    -------
    (a, 3) int64
        Triangles, counterclockwise.

    Raises
    ------
    ValueError
        When loops cross or touch, or one is not inside the container; the message names them.
    ImportError
        When Shapely is not installed.
    """
    shapely = _shapely()
    ends = len(points) - sum(frame) + np.cumsum(frame)
    container, *obstacles = (points[end - size : end] for end, size in zip(ends, frame, strict=True))
    around = [points[loop] for loop in loops]
    _check_apart(
        [*around, container, *obstacles],
        [f"the shape's boundary through vertex {loop[0]}" for loop in loops]
        + ["the container", *(f"obstacle {k}" for k in range(len(obstacles)))],
    )
    solid = [*(loop for loop in around if signed_area(loop) > 0), *obstacles]
    # Spaces with air in them: the container, and the holes of shapes. A thing lies in the smallest one around it.
    spaces = [container, *(loop for loop in around if signed_area(loop) < 0)]
    rooms = [shapely.Polygon(space) for space in spaces]
    inside: list[list[FloatArray]] = [[] for _ in rooms]
    for thing in solid:
        holding = [k for k, room in enumerate(rooms) if room.contains(shapely.Point(thing[0]))]
        if not holding:
            raise ValueError(f"the loop with a corner at {tuple(thing[0].tolist())} is not inside the container")
        inside[min(holding, key=lambda k: rooms[k].area)].append(thing)
    regions = [shapely.Polygon(space, things) for space, things in zip(spaces, inside, strict=True)]
    for region in regions:
        if not region.is_valid:
            raise ValueError(f"shapes, container and obstacles must not meet: {shapely.is_valid_reason(region)}")
    order = {place: index for index, place in enumerate(map(tuple, points.tolist()))}
    corners = shapely.get_coordinates(shapely.constrained_delaunay_triangles(regions)).reshape(-1, 4, 2)[:, :3]
    triangles = np.array([order[x, y] for x, y in corners.reshape(-1, 2).tolist()], dtype=np.int64).reshape(-1, 3)
    sign = orientation(*(points[triangles[:, k]] for k in range(3)))
    return np.where((sign < 0)[:, None], triangles[:, ::-1], triangles)


def _check_apart(loops: Sequence[FloatArray], names: Sequence[str]) -> None:
    """Refuse loops that meet, be it in a single point."""
    shapely = _shapely()
    rings = [shapely.LinearRing(loop) for loop in loops]
    first, second = shapely.STRtree(rings).query(rings, predicate="intersects")
    for i, j in sorted(zip(first.tolist(), second.tolist(), strict=True)):
        if i < j:
            x, y = shapely.get_coordinates(shapely.intersection(rings[i], rings[j]))[0].tolist()
            raise ValueError(f"{names[i]} and {names[j]} meet at ({x:.6g}, {y:.6g}): leave a gap between them")


def thickened(corners: FloatArray, gap: float) -> FloatArray:
    """Triangles laid on their longest sides, those lower than a gap raised to it.

    Without this, air that is squeezed thinner at each step, and is at rest as it is at the next, would vanish.

    Parameters
    ----------
    corners : (a, 3, 2) float64
        Counterclockwise.
    gap : float

    Returns
    -------
    (a, 3, 2) float64
        Congruent to the given ones where these are higher than the gap.
    """
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    first = sides.argmax(axis=1)
    row = np.arange(len(corners))
    start, base = corners[row, first], corners[row, (first + 1) % 3] - corners[row, first]
    length = sides[row, first]
    apex = (corners[row, (first + 2) % 3] - start) @ (1, 1j) / (base @ (1, 1j)) * length
    laid = np.zeros((len(corners), 3, 2))
    laid[row, (first + 1) % 3, 0] = length
    laid[row, (first + 2) % 3] = np.stack([apex.real, np.maximum(apex.imag, gap)], axis=1)
    return laid


def _shapely() -> Any:
    try:
        import shapely
    except ImportError as error:
        raise ImportError("the air is triangulated by Shapely: pip install 'quasiharmonic[shapes]'") from error
    return shapely
