"""The model of a Newton descent in the positions of free vertices: an energy on triangles, and terms on vertices.

Its `MapModel.search_straight` is the line search of Newton's method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.energies.newton.line_search import Trial, backtrack, extend
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, to_complex, to_points

# Maximum step, as a fraction of the step at which the first triangle would collapse.
FRACTION = 0.9
# Maximum number of halvings, and then of doublings, of a step along one direction.
HALVINGS = 30
# Steps shorter than this count as shortened, others as full.
_SHORTENED_BELOW = 0.25
# Factor by which full steps are extended.
_EXTENSION = 1.5


def in_units(uv: FloatArray, exponent: int) -> ComplexArray:
    """Return positions (n, 2) as complex numbers (n,) in units of ``2 ** exponent``."""
    return to_complex(np.ldexp(uv, -exponent))


def out_of_units(w: ComplexArray, exponent: int) -> FloatArray:
    """Return positions (n, 2) from complex numbers (n,) in units of ``2 ** exponent``."""
    return np.ldexp(to_points(w), exponent)


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Conversion of maps to positions; fixed and unmoved vertices keep their original positions exactly.

    Attributes
    ----------
    fixed : (k,) int64
        Fixed vertices.
    pinned : (k, 2) float64
        Their positions.
    exponent : int
        Maps are in units of ``2 ** exponent``.
    inexact : (s,) int64
        Vertices whose positions do not survive the conversion to the unit.
    inexact_uv, inexact_w : (s, 2) float64, (s,) complex128
        Their original positions, and these in units.
    """

    fixed: IntArray
    pinned: FloatArray
    exponent: int
    inexact: IntArray
    inexact_uv: FloatArray
    inexact_w: ComplexArray

    @classmethod
    def of(cls, uv: FloatArray, fixed: IntArray, exponent: int) -> Coordinates:
        """Return the conversion for maps that start from positions (n, 2)."""
        w = in_units(uv, exponent)
        inexact = np.flatnonzero((out_of_units(w, exponent) != uv).any(axis=1))
        return cls(fixed, uv[fixed], exponent, inexact, uv[inexact], w[inexact])

    def with_pinned(self, pinned: FloatArray) -> Coordinates:
        """Return the conversion with other positions (k, 2) of the fixed vertices."""
        return replace(self, pinned=pinned)

    def positions(self, w: ComplexArray) -> FloatArray:
        """Convert a map (n,) to positions (n, 2)."""
        uv = out_of_units(w, self.exponent)
        unmoved = w[self.inexact] == self.inexact_w
        uv[self.inexact[unmoved]] = self.inexact_uv[unmoved]
        uv[self.fixed] = self.pinned
        return uv


class NewtonObjective(Protocol):
    """Interface of an energy to minimise: a barrier on a mesh, such as `DeformationEnergy`.

    The result of ``deform`` is passed to the other methods; its type is up to the objective. ``F`` (f, 3) and ``g`` (3,
    f) are as in `NewtonSystem`; each quadratic form of ``curvature_of`` belongs to one of these triangles.
    """

    F: IntArray
    g: ComplexArray

    def deform(self, w: ComplexArray) -> Any:
        """Data of a map (n,) for the other methods."""

    def value_of(self, derivatives: Any, /) -> float:
        """Energy; ``inf`` where a triangle is inverted."""

    def gradient_of(self, derivatives: Any, n: int, /) -> ComplexArray:
        """Derivative with respect to ``n`` positions; (n,) complex128."""

    def curvature_of(self, derivatives: Any, /, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives; ``negative`` as in `Energy.curvature`."""

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """Smallest positive step along a direction at which each triangle's area vanishes; (f,) float64."""


class Term(Protocol):
    """A function of the positions that is added to an energy."""

    def value(self, w: ComplexArray) -> float:
        """Value at a map (n,) complex128."""

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """Derivative with respect to the positions, (n,) complex128."""

    def add_to(self, system: NewtonSystem, w: ComplexArray) -> None:
        """Add the second derivatives to an assembled system."""


class NewtonState(NamedTuple):
    """A map during a descent, as its model evaluated it.

    Attributes
    ----------
    w : (n,) complex128
        The map, in the model's unit.
    derivatives : object
        Derivatives of the map that the model computed.
    value : float
        The objective.
    extra : object
        Further state of the model, such as positions of sliding vertices.
    """

    w: ComplexArray
    derivatives: Any
    value: float
    extra: Any = None


class MapModel:
    """Minimise an energy plus terms; free vertices move along straight lines.

    The energy takes maps in the unit of ``coordinates``. The system has its triangles and the free vertices.
    """

    #: Factor on the tolerance of a descent.
    slack = 1.0

    def __init__(
        self, energy: NewtonObjective, coordinates: Coordinates, system: NewtonSystem, terms: Sequence[Term] = ()
    ) -> None:
        self.energy, self.coordinates, self.terms = energy, coordinates, terms
        self.system = system

    def evaluate(self, w: ComplexArray) -> NewtonState:
        """Return the state at a map (n,) complex128."""
        derivatives = self.energy.deform(w)
        return NewtonState(w, derivatives, self._value(w, derivatives))

    def with_energy(self, energy: NewtonObjective) -> MapModel:
        """Return the model with another energy on the same triangles; it shares the system."""
        self.system.take_gradients(energy.g)
        return MapModel(energy, self.coordinates, self.system, self.terms)

    def positions(self, w: ComplexArray) -> FloatArray:
        """Convert a map to positions (n, 2); see `Coordinates`."""
        return self.coordinates.positions(w)

    def mean_energy(self, state: NewtonState) -> float:
        """The energy at a state, without the terms."""
        return self.energy.value_of(state.derivatives) if self.terms else state.value

    def _value(self, w: ComplexArray, derivatives: Any) -> float:
        value = self.energy.value_of(derivatives)
        return value + sum(term.value(w) for term in self.terms) if self.terms else value

    def prepare(self, state: NewtonState) -> NewtonState:
        """Set up a step, and return the state with the objective of this step."""
        return state

    def gradient(self, state: NewtonState) -> ComplexArray:
        """Derivative of the objective by the unknowns."""
        free = self.system.free
        gradient = self.energy.gradient_of(state.derivatives, state.w.size)[free]
        for term in self.terms:
            gradient += term.gradient(state.w)[free]
        return gradient

    def assemble(self, state: NewtonState, negative: float) -> None:
        """Assemble the matrix of second derivatives; ``negative`` as in `Energy.curvature`."""
        self.system.assemble(self.energy.curvature_of(state.derivatives, negative=negative))
        for term in self.terms:
            term.add_to(self.system, state.w)

    def solve(self, load: ComplexArray) -> ComplexArray:
        """Displacement of the unknowns under a load, with the factored matrix."""
        return self.system.solve(load)

    def restrict(
        self, state: NewtonState, gradient: ComplexArray, direction: ComplexArray, expected_decrease: float
    ) -> tuple[ComplexArray, float]:
        """Return the allowed part of a direction and its expected decrease."""
        return direction, expected_decrease

    def displacement(self, direction: ComplexArray, n: int) -> ComplexArray:
        """Return a direction of the unknowns as a displacement (n,) of all vertices."""
        full = np.zeros(n, dtype=np.complex128)
        full[self.system.free] = direction
        return full

    def search(
        self, state: NewtonState, direction: ComplexArray, expected_decrease: float, shortened: bool
    ) -> tuple[NewtonState, bool] | None:
        """Line search: the next state and whether the step was shortened; None if no step lowers the objective.

        ``expected_decrease`` is positive; ``shortened`` tells whether the previous step was shortened.
        """
        full = self.displacement(direction, state.w.size)

        def trial(t: float, bound: float) -> tuple[float, NewtonState | None]:
            return self.evaluate_trial(state.w + t * full, bound)

        return self.search_straight(state, full, expected_decrease, trial)

    def search_straight(
        self, state: NewtonState, full: ComplexArray, expected_decrease: float, trial: Trial[NewtonState]
    ) -> tuple[NewtonState, bool] | None:
        """Line search along a displacement (n,), with the given evaluation of its maps."""
        limit = FRACTION * float(self.energy.steps_to_collapse(state.w, full).min())
        taken = backtrack(trial, state.value, expected_decrease, longest=min(1.0, limit), tries=HALVINGS)
        if taken is None:
            # If a triangle's area is at rounding level, Newton's step may be shorter than the spacing of doubles, so
            # try longer ones.
            doublings = int(np.count_nonzero(2.0 ** np.arange(1, HALVINGS) <= limit))
            taken = backtrack(
                trial, state.value, expected_decrease, longest=2.0, tries=doublings, factor=lambda t, value: 2.0
            )
        if taken is None:
            return None
        return extend(trial, taken, limit, longer=_EXTENSION).state, taken.t < _SHORTENED_BELOW

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, NewtonState | None]:
        """Return the objective at a map (n,) complex128, and the state if it is accepted.

        A map is accepted if its objective is below ``bound`` and every triangle is positive, computed exactly.
        """
        state = self.evaluate(w)
        accepted = state.value < bound and is_injective(self.energy.F, self.positions(w))
        return state.value, state if accepted else None

    def check_numbers(self, state: NewtonState) -> None:
        """Raise a ValueError if the energy or a derivative is NaN or infinite without extreme stretch."""
        if isinstance(self.energy, DeformationEnergy):
            self.energy.check_numbers(state.derivatives)
