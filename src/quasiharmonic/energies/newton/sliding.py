"""Newton steps in the positions of free vertices and the arc lengths of sliding boundary vertices.

A sliding vertex has one unknown, a length δ along its curve. To first order it moves by ``δ τ`` with the unit tangent
τ, to second order also by ``½ κ δ² iτ``. Let P be the matrix from unknowns to displacements, g the energy's gradient by
positions and H its second derivative::

    gradient  Pᵀ g        Hessian  Pᵀ H P + diag(κ g · iτ)

The unknown across the curve keeps its row and column, without entries, so that the pattern is that of the mesh. A step
is projected to the curve by moving the length δ along it.

The objective is the energy plus a small barrier that keeps the boundary's edges near the curves
(`quasiharmonic.geometry.curves.deviation`).

At a kink the energy has two one-sided derivatives. If it decreases to neither side, the vertex stays for this step.
Otherwise it may move to the side with the steeper descent. If a step across kinks does not lower the energy, a step
that stops at kinks is tried.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, QuadraticForm, damped
from quasiharmonic.energies.newton.line_search import Trial, backtrack, extend
from quasiharmonic.energies.newton.newton_descent import FRACTION, HALVINGS, SHIFTS, NewtonDescent, in_units
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves, Track, rails_of
from quasiharmonic.geometry.curves.deviation import DeviationBarrier
from quasiharmonic.geometry.exact.certificate import inverted_triangles, is_injective
from quasiharmonic.geometry.exact.loops import judge_loops
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, named

# Weight of the barrier, as a share of the current energy.
_WEIGHT = 1e-2


def lay_boundary(slide: bool | BoundaryCurves, domain: Domain, uv: FloatArray) -> Track:
    """Move the boundary of an injective map onto the curves it slides along.

    Raises
    ------
    ValueError
        As `BoundaryCurves.lay`; when moving the boundary onto the curves inverts triangles.
    """
    track = rails_of(slide, domain.loops, uv).lay(domain.loops, uv)
    inverted = inverted_triangles(domain.F, track.uv)
    if inverted.size:
        raise ValueError(
            f"with the boundary moved onto its curves, {named('triangle', 'triangles', inverted)} inverted or "
            "degenerate: find the map with the boundary on the curves (injective_map with slide, or qhm map --slide)"
        )
    return track


def moved_onto(slide: bool | BoundaryCurves, problem: Problem) -> Problem:
    """Return the problem with its boundary's target moved onto the curves it slides along."""
    places = np.zeros((problem.n, 2))
    places[problem.fixed] = problem.target
    loops = problem.domain.loops
    track = rails_of(slide, loops, places).lay(loops, places)
    return problem.with_target(track.uv[problem.fixed])


#: A map in units, arc lengths along the curves, the map's Jacobians, and its energy without the barrier.
_State: TypeAlias = tuple[ComplexArray, FloatArray, Deformation, float]


class SlidingSystem(NewtonSystem):
    """Newton system in which some vertices have one unknown, the length along their curve.

    Parameters
    ----------
    F, g, n, fixed, linear_solver
        As in `NewtonSystem`; ``fixed`` without the sliding vertices.
    sliding : (k,) int64
        Sliding vertices.

    Attributes
    ----------
    sliding : (k,) int64
        As given, in the same order.
    """

    def __init__(
        self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str, sliding: IntArray
    ) -> None:
        super().__init__(F, g, n, fixed, linear_solver)
        size = self.free.size
        self.sliding = sliding
        self.at: IntArray = np.searchsorted(self.free, sliding)
        place = np.full(size, -1)
        place[self.at] = np.arange(sliding.size)
        row = np.searchsorted(self._indptr, self._side_slots[0], side="right") - 1
        ends = place[row // 2], place[self._indices[self._side_slots[0]] // 2]
        # Blocks with a row or a column of a sliding vertex, and the numbers of these vertices.
        self._by_row, self._by_column = (np.flatnonzero(end >= 0) for end in ends)
        self._of_row, self._of_column = ends[0][self._by_row], ends[1][self._by_column]
        self._row = row // 2
        self.tangent: ComplexArray = np.zeros(sliding.size, dtype=np.complex128)
        self.bend: FloatArray = np.zeros(sliding.size)
        self._coupled: IntArray = np.empty(0, dtype=np.int64)
        self.coupling: FloatArray = np.zeros(0)

    def couple(self, pairs: IntArray) -> None:
        """Set the pairs (e, 2) of sliding vertices, each an edge of the mesh, to which ``coupling`` belongs."""
        low, high = np.sort(self.at[pairs], axis=1).T
        column = self._indices[self._side_slots[0]] // 2
        size = self.free.size
        keys = self._row * size + column
        self._coupled = self._side_slots[0, np.searchsorted(keys, low * size + high)]
        self.coupling = np.zeros(len(pairs))

    def assemble(self, form: QuadraticForm) -> None:
        """Sum the triangles' forms in the unknowns along ``tangent``, and add ``bend`` to the diagonal."""
        super().assemble(form)
        values, slots = self._values, self._side_slots
        x, y = self.tangent.real, self.tangent.imag
        xx, xy, yx, yy = slots[:, self._by_row]
        a, b = x[self._of_row], y[self._of_row]
        values[xx], values[xy] = a * values[xx] + b * values[yx], a * values[xy] + b * values[yy]
        values[yx] = values[yy] = 0
        xx, xy, yx, yy = slots[:, self._by_column]
        a, b = x[self._of_column], y[self._of_column]
        values[xx], values[yx] = a * values[xx] + b * values[xy], a * values[yx] + b * values[yy]
        values[xy] = values[yy] = 0
        xx, xy, yy = self._corner_slots[:, self.at]
        along = x * x * values[xx] + 2 * x * y * values[xy] + y * y * values[yy]
        values[xx] = np.where(self.tangent == 0, 0, along + self.bend)
        values[xy] = values[yy] = 0
        values[self._coupled] += self.coupling
        self._diagonal = values[self._first]


class SlidingDescent(NewtonDescent):
    """`NewtonDescent` with boundary vertices that slide on curves.

    Parameters
    ----------
    energy : DeformationEnergy
    track : Track
        The map, and the sliding vertices on their curves.
    fixed : (k,) int64
        Fixed vertices; sliding ones are excluded.
    loops : sequence of (l,) int64
        The boundary, which must not meet itself.
    exponent : int
    linear_solver : str
        As in `NewtonDescent`.
    system : SlidingSystem, optional
        From an earlier descent on the same triangles with the same ``fixed``; reused if the same vertices slide.

    Attributes
    ----------
    deviation_barrier, weight : DeviationBarrier, float
        The barrier and its factor, in the energy's units.
    forces : (k,) float64
        Contribution of the curves' curvature to the second derivative for each sliding vertex, in units.
    """

    system: SlidingSystem

    def __init__(
        self,
        energy: DeformationEnergy,
        track: Track,
        fixed: IntArray,
        loops: Sequence[IntArray],
        exponent: int,
        linear_solver: str,
        system: SlidingSystem | None = None,
    ) -> None:
        self._earlier = system
        self._track, self._s, self._loops = track, track.s, list(loops)
        self.deviation_barrier = DeviationBarrier(track, self._loops)
        super().__init__(energy, track.uv, np.setdiff1d(fixed, track.vertices), exponent, linear_solver)
        self._energies = self.value, self.value
        self._weigh()
        self.first = self.value
        both = (self.deviation_barrier.pairs >= 0).all(axis=1)
        self._both = np.flatnonzero(both)
        self.system.couple(self.deviation_barrier.pairs[both])
        # A boundary that already overlaps itself may overlap further.
        self._simple = not judge_loops(self._loops, track.uv)[1]

    def _system(self, n: int, linear_solver: str) -> SlidingSystem:
        if self._earlier is not None and np.array_equal(self._earlier.sliding, self._track.vertices):
            self._earlier.take_gradients(self.energy.g)
            return self._earlier
        return SlidingSystem(self.energy.F, self.energy.g, n, self.fixed, linear_solver, sliding=self._track.vertices)

    @property
    def energies(self) -> tuple[float, float]:
        """Mean energy at the start and now, without the barrier."""
        return self._energies

    def _weigh(self) -> None:
        """Set the barrier's weight to its share of the current energy, which only decreases."""
        self.weight = _WEIGHT * self._energies[1]
        self.value = self._energies[1] + self.weight * self.deviation_barrier.value(self._s)

    def step(self, tolerance: float) -> Status | None:
        """Take one step; return a status if no further step is possible."""
        self._weigh()
        return super().step(tolerance)

    def gradient(self) -> ComplexArray:
        """Derivative by the unknowns; for a sliding vertex it is in the real part, and the imaginary part is zero."""
        pull = self.energy.gradient_of(self._deformation, self.w.size)
        at, system = pull[self._track.vertices], self.system
        slopes, self._bends = self._barrier()
        kink = self._track.at_kink(self._s)
        ahead, curvature = self._track.frame(self._s, np.ones(at.size, dtype=bool))
        back, curvature_back = self._track.frame(self._s, ~kink)
        slope, slope_back = _along(ahead, at) + slopes, _along(back, at) + slopes
        # If the energy decreases to both sides, take the steeper one.
        turned = kink & (slope_back > np.maximum(-slope, 0))
        rests = kink & (slope >= 0) & (slope_back <= 0)
        tangent = np.where(rests, 0, np.where(turned, back, ahead))
        system.tangent = tangent
        self.forces = _along(1j * tangent, at) * np.where(turned, curvature_back, curvature) * 2.0**self.exponent
        # A vertex may leave a kink only to the chosen side.
        self._side = np.where(kink, np.where(turned, -1.0, 1.0), 0.0)
        gradient = pull[system.free]
        gradient[system.at] = np.where(tangent == 0, 0, _along(tangent, at) + slopes)
        return gradient

    def _barrier(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the barrier in units: first by the sliding vertices' lengths, second per edge (e, 2, 2)."""
        by_ends, by_both = self.deviation_barrier.derivatives(self._s)
        unit = self.weight * 2.0**self.exponent
        slopes = np.zeros(self._s.size)
        for end in (0, 1):
            number = self.deviation_barrier.pairs[:, end]
            np.add.at(slopes, number[number >= 0], unit * by_ends[number >= 0, end])
        return slopes, unit * 2.0**self.exponent * by_both

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        system = self.system
        system.bend = damped(self.forces, negative)
        for end in (0, 1):
            number = self.deviation_barrier.pairs[:, end]
            np.add.at(system.bend, number[number >= 0], self._bends[number >= 0, end, end])
        moves = (system.tangent[self.deviation_barrier.pairs[self._both]] != 0).all(axis=1)
        system.coupling = np.where(moves, self._bends[self._both, 0, 1], 0)
        direction, expected_decrease, newton = super()._direction(gradient, negative, shifts)
        wrong = direction[system.at].real * self._side < 0
        if wrong.any():
            expected_decrease += float(np.sum((gradient[system.at] * direction[system.at]).real[wrong]))
            direction[system.at[wrong]] = 0
        return direction, expected_decrease, newton

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """Line search along a direction; return False if no step lowers the energy enough."""
        if not expected_decrease > 0:
            return False
        at, vertices = self.system.at, self._track.vertices
        full = np.zeros_like(self.w)
        full[self.system.free] = direction
        full[vertices] = self.system.tangent * direction[at].real
        along = np.ldexp(direction[at].real, self.exponent)
        limit = FRACTION * float(self.energy.steps_to_collapse(self.w, full).min())
        start, s = self.w, self._s

        def going(stops: Sequence[bool]) -> Trial[_State]:
            """Evaluate steps projected to the curves, across kinks or stopping at them."""

            def trial(t: float, bound: float) -> tuple[float, _State | None]:
                value, there = np.inf, None
                for stop in stops:
                    value, there = self._laid(start + t * full, s, t * along, bound, stop=stop)
                    if there is not None:
                        break
                return value, there

            return trial

        taken = backtrack(going((False, True)), self.value, expected_decrease, longest=min(1.0, limit), tries=HALVINGS)
        if taken is None:
            return False
        self._cut = taken.t < 1
        _, self.value, (self.w, self._s, self._deformation, energy) = extend(going((False,)), taken, limit)
        self._energies = self._energies[0], energy
        return True

    def _laid(
        self, w: ComplexArray, s: FloatArray, step: FloatArray, bound: float, *, stop: bool
    ) -> tuple[float, _State | None]:
        """Return the objective with the boundary moved along its curves, and the state if it is accepted."""
        there = self._track.advance(s, step, stop=stop)
        if stop and np.array_equal(there, self._track.advance(s, step)):
            return np.inf, None  # no kink within the step, so this repeats the previous trial
        barrier = self.weight * self.deviation_barrier.value(there)
        if barrier == np.inf or not self._track.in_order(there):
            return np.inf, None
        w[self._track.vertices] = in_units(self._track.position(there), self.exponent)
        deformation = self.energy.deform(w)
        energy = self.energy.value_of(deformation)
        value = energy + barrier
        if not value < bound:
            return value, None
        uv = self.positions(w)
        if not is_injective(self.energy.F, uv) or (self._simple and judge_loops(self._loops, uv)[1]):
            return value, None
        return value, (w, there, deformation, energy)


def _along(tangent: ComplexArray, vector: ComplexArray) -> FloatArray:
    """Components of vectors along unit tangents."""
    return tangent.real * vector.real + tangent.imag * vector.imag
