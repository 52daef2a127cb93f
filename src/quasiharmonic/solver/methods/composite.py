"""Initial map composed of two maps through a disk.

    mesh ──Tutte──▶ disk of chords ◀──same triangles── target, triangulated between its boundary vertices

Tutte's embedding onto a convex outline is injective. A triangulation of the target without interior vertices is also a
triangulation of any convex polygon with as many corners. It therefore defines a bijective map of the disk onto the
target, affine on every triangle. Every vertex is mapped through both. For ever finer meshes this would be an injective
map. The inverted triangles are among those across which the second map bends; they are usually few, so a descent from
this map's tensors is short. (Weber and Zorin 2014 compose such maps for injectivity itself, and split the mesh for it.)

The method requires a single boundary loop with a simple image.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import islice
from typing import ClassVar

import numpy as np

from quasiharmonic.geometry.exact.constrained_delaunay import delaunay_of_polygon
from quasiharmonic.geometry.exact.loops import simple_loops
from quasiharmonic.geometry.exact.point_location import PointLocator
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates
from quasiharmonic.solver.methods.vector_adam import VectorAdam
from quasiharmonic.util.arrays import ComplexArray, IntArray, to_points
from quasiharmonic.util.options import count, option

# Corners of the disk are spread half by the target's arc length and half evenly, so that none are too close.
_EVEN_SHARE = 0.5
# Schedule after the composite: short steps suffice, and long ones would leave its neighbourhood.
NEARBY_STEPS = ((0, 0.2), (39, 0.2), (40, 0.05))


@dataclass(frozen=True, kw_only=True)
class Composite(VectorAdam):
    """Descend by VectorAdam: a few steps, then again from the composite of two maps through a disk, if it exists.

    Attributes
    ----------
    direct : int
        Number of steps before the composite. They suffice for many maps. The composite costs as much as 5 to 15
        steps.
    """

    direct: int = option(6, check=count)

    label: ClassVar[str] = "composite"
    #: Short: close to a solution it is found soon; the rest is for local repair.
    patience: ClassVar[tuple[int, float] | None] = (10, 0.5)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; without a composite all steps are those of `VectorAdam`."""
        steps = super().iterates(objective, start)
        yield from islice(steps, self.direct)
        left = self.iterations - self.direct - 1
        w = composite_map(objective) if left > 0 else None
        if w is None:
            # The result is None if the iterator was used up before.
            return bool((yield from steps))
        there = objective.near_map(w)
        yield there
        shared = {one.name: getattr(self, one.name) for one in fields(VectorAdam)}
        nearby = VectorAdam(**shared | {"iterations": left, "schedule": self.schedule or NEARBY_STEPS})
        return (yield from nearby.iterates(objective, there))


def composite_map(objective: Objective) -> ComplexArray | None:
    """Map every vertex through a disk to the target; fixed vertices lie at their target positions.

    Return None if there are several loops or pins, or if the target's outline intersects itself or is too narrow for
    doubles.
    """
    problem = objective.problem
    if len(problem.domain.loops) != 1 or problem.domain.pins.size:
        return None
    loop = problem.domain.loops[0]
    w = problem.fixed_positions.copy()
    outline = w[loop]
    F = polygon_triangles(outline)
    if F is None:
        return None
    onto_disk = np.zeros(problem.n, dtype=np.complex128)
    onto_disk[loop] = _corners_of_disk(outline)
    unit = objective.parameterisation.field(np.zeros(len(problem.F), dtype=np.complex128))
    onto_disk = objective.operator(unit).extend(onto_disk)
    free = objective.laplacian.free
    corners = onto_disk[loop][F]
    locator = PointLocator(to_points(corners).reshape(-1, 3, 2))
    points = to_points(onto_disk[free])
    triangle = locator.find(points)
    if (triangle < 0).any():
        return None
    w[free] = (locator.barycentric(points, triangle) * outline[F[triangle]]).sum(axis=1)
    return w


def polygon_triangles(outline: ComplexArray) -> IntArray | None:
    """Triangulate a simple polygon without additional vertices; corners (k,).

    Return strictly positive triangles (k - 2, 3), or None if the polygon intersects itself or runs clockwise.
    """
    points = to_points(outline)
    simple = simple_loops([np.arange(len(outline))], points).all()
    return delaunay_of_polygon(points) if simple else None


def _corners_of_disk(outline: ComplexArray) -> ComplexArray:
    """Return points of the unit circle for the corners of an outline."""
    k = len(outline)
    length = np.abs(np.roll(outline, -1) - outline)
    share = (1 - _EVEN_SHARE) * length / length.sum() + _EVEN_SHARE / k
    along: ComplexArray = np.exp(2j * np.pi * (np.cumsum(share) - share))
    return along
