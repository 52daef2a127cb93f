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
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import QuadraticForm, damp
from quasiharmonic.energies.newton.line_search import Trial, backtrack, extend
from quasiharmonic.energies.newton.map_model import FRACTION, HALVINGS, Coordinates, MapModel, NewtonState, in_units
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves, Track, sliding_curves
from quasiharmonic.geometry.curves.deviation import DeviationBarrier
from quasiharmonic.geometry.exact.certificate import inverted_triangles, is_injective
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, invert_indices, reject

# Weight of the barrier, as a share of the current energy.
BARRIER_WEIGHT = 1e-2
# Minimum of an edge's distance to the barrier's bound after a step, as a share of the distance before it. Next to the
# bound, derivatives from interpolated curves are too inaccurate to find a direction of descent.
_LEAST_ROOM = 0.3


def move_boundary(slide: bool | BoundaryCurves, domain: Domain, uv: FloatArray) -> Track:
    """Move the boundary of an injective map onto the curves it slides along.

    Raise a ValueError as `BoundaryCurves.lay`, or if moving the boundary onto the curves inverts triangles.
    """
    track = sliding_curves(slide, domain.loops, uv).lay(domain.loops, uv)
    remedy = "find the map with the boundary on the curves (injective_map with slide, or qhm map --slide)"
    message = f"with the boundary moved onto its curves, {{}} inverted or degenerate: {remedy}"
    reject(inverted_triangles(domain.F, track.uv), "triangle", "triangles", message)
    return track


def move_onto(slide: bool | BoundaryCurves, problem: Problem) -> Problem:
    """Return the problem with its boundary's target moved onto the curves it slides along."""
    positions, loops = problem.place_fixed(), problem.domain.loops
    track = sliding_curves(slide, loops, positions).lay(loops, positions)
    return problem.with_target(track.uv[problem.fixed])


class _Boundary(NamedTuple):
    """Arc lengths (k,) of sliding vertices along the curves, and the mean energy of the map without the barrier."""

    s: FloatArray
    energy: float


class Tangents(NamedTuple):
    """Directions in which sliding vertices may move along their curves in this step.

    Attributes
    ----------
    tangent : (k,) complex128
        Unit tangents; zero for vertices that stay.
    slope : (k,) float64
        Derivative of the objective by the length along the tangent; zero for vertices that stay.
    bending : (k,) float64
        Contribution of the curves' curvature to the second derivative by this length.
    side : (k,) float64
        At kinks, the sign of the side to which the vertex may move; otherwise 0.
    """

    tangent: ComplexArray
    slope: FloatArray
    bending: FloatArray
    side: FloatArray


def choose_tangents(track: Track, s: FloatArray, pull: ComplexArray, barrier: FloatArray) -> Tangents:
    """Return the tangents at the arc lengths ``s`` (k,).

    ``pull`` (k,) is the derivative of the energy by the positions of the sliding vertices, and ``barrier`` (k,) that of
    other terms by the arc lengths.
    """
    kink = track.at_kink(s)
    ahead, curvature = track.frame(s, np.ones(s.size, dtype=bool))
    back, curvature_back = track.frame(s, ~kink)
    slope, slope_back = (_component_along(tangent, pull) + barrier for tangent in (ahead, back))
    # If the objective decreases to both sides, take the steeper one.
    turned = kink & (slope_back > np.maximum(-slope, 0))
    stays = kink & (slope >= 0) & (slope_back <= 0)
    tangent = np.where(stays, 0, np.where(turned, back, ahead))
    bending = _component_along(1j * tangent, pull) * np.where(turned, curvature_back, curvature)
    # A vertex may leave a kink only to the chosen side.
    side = np.where(kink, np.where(turned, -1.0, 1.0), 0.0)
    return Tangents(tangent, np.where(stays, 0, np.where(turned, slope_back, slope)), bending, side)


class _TangentFrame(NamedTuple):
    """First derivatives (n - k,) at a map by the unknowns, tangents, and second derivatives of the barrier (e, 2, 2).

    The derivative by a sliding vertex is in the real part; the imaginary part is zero.
    """

    gradient: ComplexArray
    tangents: Tangents
    barrier_hessian: FloatArray


class SlidingSystem(NewtonSystem):
    """Newton system in which the vertices ``sliding`` (k,) have one unknown each, the length along their curve.

    The other parameters are as in `NewtonSystem`; ``fixed`` excludes the sliding vertices.
    """

    def __init__(
        self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str, sliding: IntArray
    ) -> None:
        super().__init__(F, g, n, fixed, linear_solver)
        size = self.free.size
        self.sliding = sliding
        self.at: IntArray = np.searchsorted(self.free, sliding)
        slider = invert_indices(size, self.at)
        row = np.searchsorted(self._indptr, self._side_slots[0], side="right") - 1
        ends = slider[row // 2], slider[self._indices[self._side_slots[0]] // 2]
        # Each side's block has the slots xx, xy, yx, yy, the x-row of its lower vertex first; see `NewtonSystem`.
        # Slots of blocks with a row of a sliding vertex, and of transposed blocks with a column of one, with the
        # numbers of these vertices.
        both = self._side_slots, self._side_slots[[0, 2, 1, 3]]
        self._sliding_blocks = [(slots[:, end >= 0], end[end >= 0]) for slots, end in zip(both, ends, strict=True)]
        self._row = row // 2
        self.tangent: ComplexArray = np.zeros(sliding.size, dtype=np.complex128)
        self.curve_stiffness: FloatArray = np.zeros(sliding.size)
        self._coupled: IntArray = np.empty(0, dtype=np.int64)
        self.coupling: FloatArray = np.zeros(0)

    def couple(self, pairs: IntArray) -> None:
        """Set the pairs (e, 2) of sliding vertices, each an edge of the mesh, to which ``coupling`` belongs."""
        low, high = np.sort(self.at[pairs], axis=1).T
        column = self._indices[self._side_slots[0]] // 2
        size = self.free.size
        # Ascending, because the pattern is sorted by row, then by column.
        keys = self._row * size + column
        self._coupled = self._side_slots[0, np.searchsorted(keys, low * size + high)]
        self.coupling = np.zeros(len(pairs))

    def assemble(self, form: QuadraticForm) -> None:
        """Sum the triangles' forms in the unknowns along ``tangent``, and add ``curve_stiffness`` to the diagonal."""
        super().assemble(form)
        values, x, y = self._values, self.tangent.real, self.tangent.imag
        for (xx, xy, yx, yy), slider in self._sliding_blocks:
            a, b = x[slider], y[slider]
            values[xx], values[xy] = a * values[xx] + b * values[yx], a * values[xy] + b * values[yy]
            values[yx] = values[yy] = 0
        xx, xy, yy = self._corner_slots[:, self.at]
        along = x * x * values[xx] + 2 * x * y * values[xy] + y * y * values[yy]
        values[xx] = np.where(self.tangent == 0, 0, along + self.curve_stiffness)
        values[xy] = values[yy] = 0
        values[self._coupled] += self.coupling
        self.diagonal = values[self._first]


class SlidingModel(MapModel):
    """The model of a Newton descent whose boundary vertices slide on curves; see `MapModel`.

    In each step, `prepare` and `gradient` come first, which choose the tangents, then `assemble`, `restrict` and
    `search`, which use them.

    Parameters
    ----------
    energy : DeformationEnergy
    track : Track
        The map, and the sliding vertices on their curves.
    fixed : (k,) int64
        Fixed vertices; sliding ones are excluded.
    loops : sequence of (l,) int64
        The boundary. If it does not meet itself, it stays so.
    exponent, linear_solver
        As in `newton_descent`.
    system : SlidingSystem, optional
        From an earlier model of the same triangles with the same ``fixed``; reused if the same vertices slide.

    Attributes
    ----------
    deviation_barrier, weight : DeviationBarrier, float
        The barrier and its factor, in the energy's units.
    """

    energy: DeformationEnergy
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
        self._track, self._loops = track, list(loops)
        self.deviation_barrier = DeviationBarrier(track, self._loops)
        coordinates = Coordinates.of(track.uv, np.setdiff1d(fixed, track.vertices), exponent)
        if system is not None and np.array_equal(system.sliding, track.vertices):
            system.take_gradients(energy.g)
        else:
            system = SlidingSystem(
                energy.F, energy.g, len(track.uv), coordinates.fixed, linear_solver, sliding=track.vertices
            )
        super().__init__(energy, coordinates, system)
        both = (self.deviation_barrier.pairs >= 0).all(axis=1)
        self._both = np.flatnonzero(both)
        self.system.couple(self.deviation_barrier.pairs[both])
        # A boundary that already overlaps itself may overlap further.
        self._simple = not check_loops(self._loops, track.uv)[1]
        self.weight = 0.0
        self._frame: _TangentFrame | None = None

    def start(self) -> NewtonState:
        """Return the state of the track's map."""
        w = in_units(self._track.uv, self.coordinates.exponent)
        derivatives = self.energy.deform(w)
        energy = self.energy.value_of(derivatives)
        return self.prepare(NewtonState(w, derivatives, energy, _Boundary(self._track.s, energy)))

    def mean_energy(self, state: NewtonState) -> float:
        """The energy at a state, without the barrier."""
        boundary: _Boundary = state.extra
        return boundary.energy

    def prepare(self, state: NewtonState) -> NewtonState:
        """Set the barrier's weight to its share of the current energy, which only decreases."""
        boundary: _Boundary = state.extra
        self.weight = BARRIER_WEIGHT * boundary.energy
        return state._replace(value=boundary.energy + self.weight * self.deviation_barrier.value(boundary.s))

    def gradient(self, state: NewtonState) -> ComplexArray:
        """See `MapModel`; also sets the unknowns of the sliding vertices for this step."""
        self._frame = self.frame(state)
        self.system.tangent = self._frame.tangents.tangent
        return self._frame.gradient

    def frame(self, state: NewtonState) -> _TangentFrame:
        """Derivatives at a state by the unknowns; see `_TangentFrame`."""
        s = state.extra.s
        pull = self.energy.gradient_of(state.derivatives, state.w.size)
        barrier_gradient, barrier_hessian = self._barrier(s)
        tangents = choose_tangents(self._track, s, pull[self._track.vertices], barrier_gradient)
        gradient = pull[self.system.free]
        gradient[self.system.at] = tangents.slope
        return _TangentFrame(gradient, tangents, barrier_hessian)

    def _barrier(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the barrier in units: first by the sliding vertices' lengths, second per edge (e, 2, 2)."""
        by_ends, by_both = self.deviation_barrier.derivatives(s)
        unit = self.weight * 2.0**self.coordinates.exponent
        barrier_gradient = np.zeros(s.size)
        self.deviation_barrier.add_at_ends(barrier_gradient, unit * by_ends)
        return barrier_gradient, unit * 2.0**self.coordinates.exponent * by_both

    def assemble(self, state: NewtonState, negative: float) -> None:
        """See `MapModel`."""
        system, frame = self.system, self._frame
        assert frame is not None
        system.curve_stiffness = damp(frame.tangents.bending * 2.0**self.coordinates.exponent, negative)
        self.deviation_barrier.add_at_ends(system.curve_stiffness, frame.barrier_hessian.diagonal(axis1=1, axis2=2))
        both_move = (system.tangent[self.deviation_barrier.pairs[self._both]] != 0).all(axis=1)
        system.coupling = np.where(both_move, frame.barrier_hessian[self._both, 0, 1], 0)
        system.assemble(self.energy.curvature_of(state.derivatives, negative=negative))

    def restrict(
        self, state: NewtonState, gradient: ComplexArray, direction: ComplexArray, expected_decrease: float
    ) -> tuple[ComplexArray, float]:
        """Set the direction to zero at vertices at a kink if it leads to the other side of the kink."""
        assert self._frame is not None
        at = self.system.at
        wrong = direction[at].real * self._frame.tangents.side < 0
        if wrong.any():
            expected_decrease += float(np.sum((gradient[at] * direction[at]).real[wrong]))
            direction[at[wrong]] = 0
        return direction, expected_decrease

    def search(
        self, state: NewtonState, direction: ComplexArray, expected_decrease: float, shortened: bool
    ) -> tuple[NewtonState, bool] | None:
        """See `MapModel`; maps of a step are projected to the curves."""
        at, vertices = self.system.at, self._track.vertices
        full = self.displacement(direction, state.w.size)
        full[vertices] = self.system.tangent * direction[at].real
        along = np.ldexp(direction[at].real, self.coordinates.exponent)
        limit = FRACTION * float(self.energy.steps_to_collapse(state.w, full).min())
        s = state.extra.s
        room = _LEAST_ROOM * self.deviation_barrier.room(s)

        def make_trial(stops: Sequence[bool]) -> Trial[NewtonState]:
            """Evaluate steps projected to the curves, across kinks or stopping at them."""

            def trial(t: float, bound: float) -> tuple[float, NewtonState | None]:
                value, there = np.inf, None
                for stop in stops:
                    value, there = self._evaluate_trial(state.w + t * full, s, t * along, room, bound, stop=stop)
                    if there is not None:
                        break
                return value, there

            return trial

        taken = backtrack(
            make_trial((False, True)), state.value, expected_decrease, longest=min(1.0, limit), tries=HALVINGS
        )
        if taken is None:
            return None
        return extend(make_trial((False,)), taken, limit).state, taken.t < 1

    def _evaluate_trial(
        self, w: ComplexArray, s: FloatArray, step: FloatArray, least_room: FloatArray, bound: float, *, stop: bool
    ) -> tuple[float, NewtonState | None]:
        """Return the objective with the boundary moved along its curves, and the state if it is accepted."""
        there = self._track.advance(s, step, stop=stop)
        if stop and np.array_equal(there, self._track.advance(s, step)):
            return np.inf, None  # no kink within the step, so this repeats the previous trial
        room = self.deviation_barrier.room(there)
        if (room < least_room).any() or not self._track.in_order(there):
            return np.inf, None
        barrier = self.weight * self.deviation_barrier.value_of(room)
        w[self._track.vertices] = in_units(self._track.position(there), self.coordinates.exponent)
        derivatives = self.energy.deform(w)
        energy = self.energy.value_of(derivatives)
        value = energy + barrier
        if not value < bound:
            return value, None
        uv = self.positions(w)
        if not is_injective(self.energy.F, uv) or (self._simple and check_loops(self._loops, uv)[1]):
            return value, None
        return value, NewtonState(w, derivatives, value, _Boundary(there, energy))


def _component_along(tangent: ComplexArray, vector: ComplexArray) -> FloatArray:
    """Components of vectors along unit tangents."""
    return tangent.real * vector.real + tangent.imag * vector.imag
