"""VectorAdam, and its variant that starts again from the composite of two maps through a disk.

VectorAdam (Ling et al. 2022) is Adam with steps normalised by each triangle's complex modulus (§9.4, §F.1). The
normalisation gives every triangle steps of similar length in ξ, however small its area. It also makes the path
independent of the frames in which the triangles' ξ are expressed.

The composite is an initial map::

    mesh ──Tutte──▶ disk of chords ◀──same triangles── target, triangulated between its boundary vertices

Tutte's embedding onto a convex outline is injective. A triangulation of the target without interior vertices is also a
triangulation of any convex polygon with as many corners. It therefore defines a bijective map of the disk onto the
target, affine on every triangle. Every vertex is mapped through both. For ever finer meshes this would be an injective
map. The inverted triangles are among those across which the second map bends; they are usually few, so a descent from
this map's tensors is short. (Weber and Zorin 2014 compose such maps for injectivity itself, and split the mesh for it.)

The composite requires a single boundary loop with a simple image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import islice
from typing import ClassVar

import numpy as np

from quasiharmonic.geometry.exact.constrained_delaunay import delaunay_of_polygon
from quasiharmonic.geometry.exact.loops import simple_loops
from quasiharmonic.geometry.exact.point_location import PointLocator
from quasiharmonic.geometry.mesh.reference import blocks
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import FunctionalDescent, Iterates
from quasiharmonic.solver.methods.relocation import RetrySchedule, relocate
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, to_points
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.options import count, option

# Less momentum than Adam's usual 0.9 / 0.999 gives the largest single gain. The objective changes as fast as the map
# unfolds, and old gradients point to folds that no longer exist.
MOMENTA = 0.6, 0.9
# Long steps unfold a map in few iterations; short ones are needed in narrow regions. Chosen on letters and on random
# pairs of surface and outline.
TANH_STEPS = ((0, 0.5), (10, 0.2), (39, 0.2), (40, 0.05))
# With si-log, ξ has farther to go to the same tensor, so steps are longer.
SI_LOG_STEPS = ((0, 0.5),)
# Corners of the disk are spread half by the target's arc length and half evenly, so that none are too close.
_EVEN_SHARE = 0.5
# Schedule after the composite: short steps suffice, and long ones would leave its neighbourhood.
NEARBY_STEPS = ((0, 0.2), (39, 0.2), (40, 0.05))


@dataclass(frozen=True, kw_only=True)
class VectorAdam(FunctionalDescent):
    """Descend by VectorAdam.

    Attributes
    ----------
    schedule : sequence of (int, float)
        Step lengths at given iterations, linear in between and constant after the last. Default (empty): a schedule for
        the parameterisation.
    momenta : (float, float)
        Decay rates of the mean gradient and of its mean square, Adam's β₁ and β₂; at least 0 and below 1. The paper
        names none; Adam's usual ones are 0.9 and 0.999. With these and the paper's steps the method is
        ``VectorAdam(schedule=[(0, 0.1)], momenta=(0.9, 0.999))``.
    relocation : bool
        From time to time, try to untangle the last inverted triangles at once by moving their vertices
        (`quasiharmonic.solver.methods.relocation`). A failed try does not affect the descent.
    """

    schedule: Sequence[tuple[int, float]] = ()
    momenta: tuple[float, float] = MOMENTA
    relocation: bool = False

    label: ClassVar[str] = "vector-adam"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            times, lengths = np.array([*zip(*self._steps, strict=True)], dtype=np.float64)
        except (TypeError, ValueError):
            times, lengths = np.zeros(2), np.zeros(2)
        if not np.all(np.diff(times) > 0) or not np.all((times >= 0) & (lengths > 0) & np.isfinite(times + lengths)):
            raise ValueError(
                "schedule must be pairs (iteration, step length) with ascending iterations and positive lengths, "
                f"not {self.schedule!r}"
            )
        try:
            momenta = np.array(self.momenta, dtype=np.float64)
        except (TypeError, ValueError):
            momenta = np.full(2, np.nan)
        if momenta.shape != (2,) or not np.all((momenta >= 0) & (momenta < 1)):
            raise ValueError(f"momenta must be two numbers of at least 0 and below 1, not {self.momenta!r}")

    @property
    def _steps(self) -> Sequence[tuple[int, float]]:
        return self.schedule or (TANH_STEPS if self.parameterisation == "tanh" else SI_LOG_STEPS)

    def make_state(self, triangles: int) -> AdamState:
        """Return the Adam state for this number of triangles."""
        times, lengths = zip(*self._steps, strict=True)
        return AdamState(triangles, self.momenta, times, lengths)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; a step is shortened if the Laplacian is not positive definite after it."""
        state = self.make_state(start.xi.size)
        problem, retries, here = objective.problem, RetrySchedule(), start
        for _ in range(self.iterations):
            if self.relocation and retries.is_due(here.inverted):
                w = relocate(problem.F, here.w, problem.fixed)
                if w is not None:
                    yield objective.of_map(w)
            here = objective.step(here, state.step(here.gradient))
            yield here
        return False


class AdamState:
    """Mean gradient and mean square per triangle, and the resulting steps; see `VectorAdam` for the settings.

    Triangles do not interact, so they may belong to one mesh or several.
    """

    def __init__(
        self, triangles: int, momenta: tuple[float, float], times: Sequence[int], lengths: Sequence[float]
    ) -> None:
        self._momenta, self._times, self._lengths = momenta, times, lengths
        self._mean = np.zeros(triangles, dtype=np.complex128)
        self._square = np.zeros(triangles)
        self._steps = 0

    def take_part(self, triangles: BoolArray) -> AdamState:
        """Return the state of the triangles in a mask (f,), to continue separately."""
        other = AdamState(0, self._momenta, self._times, self._lengths)
        other._mean, other._square, other._steps = self._mean[triangles], self._square[triangles], self._steps
        return other

    def step(self, gradient: ComplexArray) -> ComplexArray:
        """Return the step in ξ for the next gradient; (f,) complex128."""
        first, second = self._momenta
        length = float(np.interp(self._steps, self._times, self._lengths))
        self._steps += 1
        length *= np.sqrt(1 - second**self._steps) / (1 - first**self._steps)
        step = np.empty_like(self._mean)
        adam_step(gradient, first, second, length, self._mean, self._square, step)
        return step


@compiled
def adam_step(
    gradient: ComplexArray,
    first: float,
    second: float,
    length: float,
    mean: ComplexArray,
    square: FloatArray,
    step: ComplexArray,
) -> None:
    """Update the mean and the mean square with a gradient, and fill in the step of this length."""
    for part in blocks(step.size):
        g, average, squares = gradient[part], mean[part], square[part]
        average *= first
        average += (1 - first) * g
        squares *= second
        squares += (1 - second) * (g.real**2 + g.imag**2)
        root = np.sqrt(squares)
        # A triangle whose gradients were all zero does not move.
        root[root == 0] = np.inf
        np.multiply(average, -length / root, out=step[part])


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
