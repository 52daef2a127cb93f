"""Collision avoidance by bijectivity: elastic shapes and the air between them (§11.2, Figure 20).

Shapes and air form one triangle mesh. As long as no triangle is inverted and the frame does not cross itself, no shape
overlaps another shape, itself, an obstacle or the container. So no collision detection or response is needed: the
shapes converge to the injective map of minimum energy. The air has a very small weight in that energy. It is
triangulated again at every time step, so that shapes can slide past each other.

    moved frame ──injective map──▶ valid ──minimum energy──▶ converged ──new air──▶ next frame
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP, AreaBarrier, Combination
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.newton_descent import newton_descent
from quasiharmonic.geometry.exact.certificate import Certificate, certify, is_injective
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.solver.mapping import injective_map
from quasiharmonic.targets.outlines.contours import signed_area
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_finite,
    check_numbers,
    check_positive,
    describe,
    map_array,
    real_array,
    reject,
    triangle_array,
)
from quasiharmonic.util.hints import explain_missing

#: ARAP, and a barrier that keeps triangles from collapsing.
_ELASTIC = Combination((1.0, ARAP()), (0.1, AreaBarrier()))


@dataclass(frozen=True, eq=False)
class AirMeshState:
    """Shapes, frame and air at one time step.

    Attributes
    ----------
    points : (n + k, 2) float64
        Vertices of the shapes, then those of the frame, loop by loop.
    F : (f, 3) int64
        Triangles of the shapes.
    air : (a, 3) int64
        Triangles of the air, with indices into the same points.
    certificate : Certificate
        The exact certificate of shapes and air together; there is no overlap if it is bijective.
    energy : float
        Mean elastic energy of the shapes.

    See Also
    --------
    AirMesh : Its steps return it.

    Examples
    --------
    >>> from quasiharmonic import AirMesh
    >>> from quasiharmonic.surfaces import grid
    >>> points, F = grid(2, 2)
    >>> state = AirMesh(points, F, [[(-1, -1), (3, -1), (3, 3), (-1, 3)]]).moment
    >>> bool(state.certificate.bijective), len(state.points)
    (True, 13)
    """

    points: FloatArray
    F: IntArray
    air: IntArray
    certificate: Certificate
    energy: float


class AirMesh:
    """Elastic shapes in a container with moving obstacles.

    Parameters
    ----------
    points : (n, 2) array
        Rest positions of the shapes' vertices, also their initial positions. Every vertex belongs to a triangle.
    F : (f, 3) array of int
        Triangles of one or more shapes, with or without holes, counterclockwise.
    frame : sequence of (k, 2) arrays
        Corners of the container, counterclockwise, then those of each obstacle. Long sides should have several points.
    gap : float, optional
        Air thinner than this pushes its surroundings apart, in the unit of the points; a hundredth of the shapes'
        mean edge length by default.
    air_weight : float
        Weight of the air in the energy, relative to 1 for the shapes; small but positive. With 0, the first collapsed
        air triangle would block all movement.

    Raises
    ------
    ValueError
        If an array has the wrong shape, a triangle is not counterclockwise, or shapes, container and obstacles
        overlap or touch at the start.
    ImportError
        If Shapely, which triangulates the air, is not installed.

    Attributes
    ----------
    moment : AirMeshState
        The current state.

    See Also
    --------
    MovingMesh : A mesh that follows its boundary.
    results.AirMeshState : The state that every step returns.

    Examples
    --------
    >>> from quasiharmonic import AirMesh
    >>> from quasiharmonic.surfaces import grid
    >>> points, F = grid(2, 2)
    >>> air = AirMesh(points, F, [[(-1, -1), (3, -1), (3, 3), (-1, 3)]])
    >>> bool(air.moment.certificate.bijective)
    True
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
        reject(idle, "vertex", "vertices", "no triangle uses {}: remove unused vertices")
        turned = orientation(*(self._rest[self._F[:, k]] for k in range(3))) <= 0
        reject(turned, "triangle", "triangles", "{} not counterclockwise: reverse the order of their corners")
        check_numbers(air_weight=air_weight)
        if not 0 < air_weight <= 1:
            raise ValueError(f"air_weight must be above 0 and at most 1, not {air_weight}")
        self._air_weight = air_weight
        sides = self._rest[self._F] - np.roll(self._rest[self._F], 1, axis=1)
        self._gap = 1e-2 * float(np.linalg.norm(sides, axis=2).mean()) if gap is None else gap
        check_positive(gap=self._gap)
        self._loops = boundary_loops(self._F, len(self._rest))
        around = _check_loops(frame)
        self._sizes = [len(loop) for loop in around]
        if min(self._sizes) < 3:
            raise ValueError(f"each loop of the frame needs at least 3 points, not {self._sizes}")
        self.moment = self._converge(np.concatenate([self._rest, self._stack(around)]))
        if not self.moment.certificate.bijective:
            raise ValueError(f"shapes, container and obstacles overlap. {self.moment.certificate.summary()}")

    def advance(self, frame: Sequence[ArrayLike], *, max_iterations: int = 300) -> AirMeshState:
        """Move the frame, and converge the shapes.

        Air edges between points of the frame can forbid a move that is possible without them. If the whole move is not
        possible, it is done in shorter steps along straight lines, each with new air.

        Parameters
        ----------
        frame : sequence of (k, 2) arrays
            As many loops, with as many points, as at the start.
        max_iterations : int
            Maximum number of linear solves to make the mesh valid after a step.

        Returns
        -------
        AirMeshState
            The new state, certified; also stored as ``moment``.

        Raises
        ------
        ValueError
            If loops have other sizes than at the start, or a point is not finite.
        RuntimeError
            If the move fails: the frame leaves no space, or crosses itself or a shape. The state is then unchanged.
        """
        # Steps of the frame are halved down to this fraction of its movement.
        shortest = 1 / 64
        there = self._stack(frame)
        n, present = len(self._rest), self.moment
        here, done, step = present.points[n:], 0.0, 1.0
        try:
            while done < 1:
                t = min(done + step, 1.0)
                reached = self._step(here + t * (there - here) if t < 1 else there, max_iterations)
                if reached is not None:
                    self.moment, done = reached, t
                elif step > shortest:
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
        """The converged state with a moved frame; None if there is none."""
        try:
            moved = self._move(frame, max_iterations)
            reached = None if moved is None else self._converge(moved)
        except ValueError:
            # Only the frame's shape and values were checked, so the moved frame may cross itself or the shapes.
            return None
        return reached if reached is not None and reached.certificate.bijective else None

    def _move(self, frame: FloatArray, max_iterations: int) -> FloatArray | None:
        """The points with a moved frame and without inverted triangles; None if no such map was found."""
        n, then = len(self._rest), self.moment
        everything = np.concatenate([then.F, then.air])
        moved = np.concatenate([then.points[:n], frame])
        if is_injective(everything, moved):
            return moved
        fixed = np.arange(n, len(moved))
        result = injective_map(then.points, everything, fixed, frame, max_iterations=max_iterations)
        return result.uv if result.injective else None

    def _converge(self, points: FloatArray) -> AirMeshState:
        """Converge the shapes from a valid state, with new air before and after."""
        # Shapes have converged when a Newton step predicts a relative decrease of the energy below this.
        at_rest = 1e-4
        n = len(self._rest)
        fixed = np.arange(n, len(points))
        last = np.inf
        while True:
            air = self._triangulate(points)
            everything = np.concatenate([self._F, air])
            # Rest triangles of the shapes are those at the start. Those of the air are the current ones, thickened if
            # too thin.
            energy = DeformationEnergy(
                np.concatenate([self._rest, thicken(points[air], self._gap).reshape(-1, 2)]),
                everything,
                _ELASTIC,
                weights=np.concatenate([np.ones(len(self._F)), np.full(len(air), self._air_weight)]),
                rest_F=np.concatenate([self._F, n + np.arange(air.size).reshape(-1, 3)]),
            )
            descent, model = newton_descent(energy, points, fixed, 0, "auto")
            for _ in descent.descend(60, at_rest):
                pass
            points = model.positions(descent.w)
            elastic = self._elastic(points)
            # New air may let shapes slide further.
            if elastic > (1 - 1e-2) * last:
                break
            last = elastic
        air = self._triangulate(points)
        return AirMeshState(points, self._F, air, certify(np.concatenate([self._F, air]), points), elastic)

    def _elastic(self, points: FloatArray) -> float:
        return DeformationEnergy(self._rest, self._F, _ELASTIC).value(in_units(points[: len(self._rest)], 0))

    def _stack(self, frame: Sequence[ArrayLike]) -> FloatArray:
        """Check the frame's points, and return them loop by loop."""
        loops = _check_loops(frame)
        sizes = [len(loop) for loop in loops]
        if sizes != self._sizes:
            raise ValueError(
                f"the frame must have loops of {self._sizes} points, as in the initial frame, not of {sizes}"
            )
        for k, loop in enumerate(loops):
            check_finite(f"loop {k} of the frame", "point", "points", loop)
        return np.concatenate(loops)

    def _triangulate(self, points: FloatArray) -> IntArray:
        """Triangulate the space outside shapes and obstacles, without new points."""
        return triangulate_between(points, self._loops, self._sizes)


def _check_loops(frame: Iterable[ArrayLike]) -> list[FloatArray]:
    """Convert the loops of a frame, one or more, to new arrays (k, 2) of real numbers."""
    if isinstance(frame, str | bytes) or not isinstance(frame, Iterable):
        raise ValueError(
            f"frame must be a list of loops (k, 2), the container first, then obstacles, not {describe(frame)}"
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


def triangulate_between(points: FloatArray, loops: Sequence[IntArray], frame: Sequence[int]) -> IntArray:
    """Triangulate the space between shapes, a container and obstacles by constrained Delaunay, without new points.

    The last ``sum(frame)`` of the ``points`` (n, 2) belong to the frame, loop by loop; ``frame`` has the sizes of its
    loops, the container first. ``loops`` are boundary loops of the shapes, with the shape on the left. Return triangles
    (a, 3), counterclockwise. Raises ValueError if loops cross or touch, or one is not inside the container, and names
    them. Raises ImportError if Shapely is not installed.
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
    # Air fills the container and the holes of shapes. Each solid belongs to the smallest of these regions around it.
    spaces = [container, *(loop for loop in around if signed_area(loop) < 0)]
    rooms = [shapely.Polygon(space) for space in spaces]
    inside: list[list[FloatArray]] = [[] for _ in rooms]
    for thing in solid:
        holding = [k for k, room in enumerate(rooms) if room.contains(shapely.Point(thing[0]))]
        if not holding:
            raise ValueError(f"the loop with a corner at {tuple(thing[0].tolist())} is not inside the container")
        inside[min(holding, key=lambda k: rooms[k].area)].append(thing)
    regions = [shapely.Polygon(space, things) for space, things in zip(spaces, inside, strict=True)]
    for region, things in zip(regions, inside, strict=True):
        if not region.is_valid:
            blocks = [shapely.Polygon(thing) for thing in things]
            pair = shapely.STRtree(blocks).query(blocks, predicate="contains_properly")[:, 0]
            outer, inner = (f"the loop with a corner at {tuple(things[k][0].tolist())}" for k in pair)
            raise ValueError(f"{inner} is inside {outer}: move it out")
    order = {place: index for index, place in enumerate(map(tuple, points.tolist()))}
    corners = shapely.get_coordinates(shapely.constrained_delaunay_triangles(regions)).reshape(-1, 4, 2)[:, :3]
    triangles = np.array([order[x, y] for x, y in corners.reshape(-1, 2).tolist()], dtype=np.int64).reshape(-1, 3)
    sign = orientation(*(points[triangles[:, k]] for k in range(3)))
    return np.where((sign < 0)[:, None], triangles[:, ::-1], triangles)


def _check_apart(loops: Sequence[FloatArray], names: Sequence[str]) -> None:
    """Raise ValueError if loops share a point, or one crosses or touches itself."""
    shapely = _shapely()
    rings = [shapely.LinearRing(loop) for loop in loops]
    for name, ring in zip(names, rings, strict=True):
        if not ring.is_simple:
            at = shapely.is_valid_reason(ring).partition("[")[2].rstrip("]").replace(" ", ", ")
            raise ValueError(f"{name} meets itself at ({at})")
    first, second = shapely.STRtree(rings).query(rings, predicate="intersects")
    for i, j in sorted(zip(first.tolist(), second.tolist(), strict=True)):
        if i < j:
            x, y = shapely.get_coordinates(shapely.intersection(rings[i], rings[j]))[0].tolist()
            raise ValueError(f"{names[i]} and {names[j]} meet at ({x:.6g}, {y:.6g}): leave a gap between them")


def thicken(corners: FloatArray, gap: float) -> FloatArray:
    """Lay triangles (a, 3, 2) on their longest sides, and raise heights below a gap to it.

    The result is congruent to triangles whose height exceeds the gap. Without it, air whose rest triangles are its
    current ones would become thinner at each step and vanish.
    """
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    first = sides.argmax(axis=1)
    row = np.arange(len(corners))
    start, base = corners[row, first], corners[row, (first + 1) % 3] - corners[row, first]
    length = sides[row, first]
    apex = (corners[row, (first + 2) % 3] - start) @ (1, 1j) / (base @ (1, 1j)) * length
    layout = np.zeros((len(corners), 3, 2))
    layout[row, (first + 1) % 3, 0] = length
    layout[row, (first + 2) % 3] = np.stack([apex.real, np.maximum(apex.imag, gap)], axis=1)
    return layout


def _shapely() -> Any:
    with explain_missing("the air is triangulated by Shapely", extra="shapes"):
        import shapely
    return shapely
