"""Projected Newton steps down a deformation energy, each of which ends in an injective map (§10, §11).

::

    assemble ──▶ factor ──▶ direction ──▶ t = min(1, 0.9 × first collapse) ──▶ less energy? ──▶ injective, exactly?
       ▲                                          │ ▲            no: t/2 ◀──────────┴────────────────┘ yes
       └──────────────────────────────────────────┼─┴── t = 1 went well: 1.5t, … as long as the energy falls
                                                  └── next map

The second derivative of the energy is made positive definite triangle by triangle, in closed form
(`quasiharmonic.energies.energies`). While collapsing triangles cut the steps short, negative eigenvalues enter with
their absolute values, which aims less far and gets further; afterwards they are clamped at zero, which
converges faster.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.energies.newton.line_search import backtrack, extend
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, work

# Fraction of the step at which the first triangle would collapse; no longer step is tried.
FRACTION = 0.9
# The step is halved, and then doubled, this often before the direction is given up.
HALVINGS = 30
# Raised diagonals, one after the other until a factorisation exists. Rounding alone moves the eigenvalues
# by the first, and where triangles span many orders of magnitude they are as small as that.
SHIFTS = 1e-15, 1e-12, 1e-9, 1e-6, 1e-3
# Steps shorter than this share count as cut short, and longer ones as in full; these are tried so many times as long.
_SHORT, _LONGER = 0.25, 1.5
# A step that lowers the energy by less than this part of the tolerance is idle; after so many in a row the
# map has come to rest short of convergence.
_IDLE, _PATIENCE = 1e-2, 3
# Where a step that promised less than the tolerance brings more than so many times that, the model is pessimistic, and
# the map not at rest.
_MORE = 4.0
# A mean energy this small is rounding: the map is an isometry, or a similarity.
_NOTHING = 1e-12
# Where maps stretch as much as this mean energy says, what clamping adds to the second derivatives may be so much that
# a long way down looks like a short one: by about the energy, a thousand times where maps are stretched thirty times.
_STRETCHED = 100.0


def in_units(uv: FloatArray, exponent: int) -> ComplexArray:
    """Positions (n, 2) as complex numbers (n,) in units of ``2 ** exponent``."""
    return np.ldexp(uv, -exponent).view(np.complex128).ravel()


def _out_of_units(w: ComplexArray, exponent: int) -> FloatArray:
    """The way back."""
    return np.ldexp(w.view(np.float64).reshape(-1, 2), exponent)


class NewtonObjective(Protocol):
    """What `NewtonDescent` asks of an energy: a barrier on a mesh, such as `DeformationEnergy`.

    What ``deform`` makes of a map is handed to the other methods as it is, and is nobody else's concern.

    Attributes
    ----------
    F : (f, 3) int64
    g : (3, f) complex128
        As `NewtonSystem` has them: each quadratic form of ``curvature_of`` is on one of these triangles.
    """

    F: IntArray
    g: ComplexArray

    def deform(self, w: ComplexArray) -> Any:
        """What the other methods read of a map (n,)."""

    def value_of(self, moment: Any, /) -> float:
        """The energy; ``inf`` where a triangle is inverted."""

    def gradient_of(self, moment: Any, n: int, /) -> ComplexArray:
        """The derivative by ``n`` positions; (n,) complex128."""

    def curvature_of(self, moment: Any, /, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives; ``negative`` as `Energy.curvature` has it."""

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """How far along a direction each triangle's area first vanishes; (f,) float64."""


class NewtonDescent:
    """The map at hand and how to get to the next.

    Parameters
    ----------
    energy : Lowered
        For maps in units of ``2 ** exponent``.
    uv : (n, 2) float64
        An injective map.
    fixed : (k,) int64
        Vertices that stay where they are in ``uv``, to the last bit.
    exponent : int
        Of the unit of computation.
    linear_solver : str

    Attributes
    ----------
    w : (n,) complex128
        The map, in units.
    first, value : float
        What is descended, at the start and now.
    fixed : (k,) int64
        The vertices that stay.
    exponent : int
        Of the unit of computation.
    """

    def __init__(
        self, energy: NewtonObjective, uv: FloatArray, fixed: IntArray, exponent: int, linear_solver: str
    ) -> None:
        self.energy = energy
        self.fixed, self._pinned = fixed, uv[fixed]
        self.exponent = exponent
        self.w: ComplexArray = in_units(uv, exponent)
        # What is too small for the unit does not come back from it.
        self._faint = np.flatnonzero((_out_of_units(self.w, exponent) != uv).any(axis=1))
        self._faint_uv, self._faint_w = uv[self._faint], self.w[self._faint]
        self.system = self._system(len(uv), linear_solver)
        self._deformation = self.energy.deform(self.w)
        self.value = self.first = self.energy.value_of(self._deformation)
        self._cut = True
        self._shift = 0
        self._idle = 0

    @property
    def energies(self) -> tuple[float, float]:
        """The mean energy at the start and now."""
        return self.first, self.value

    def positions(self, w: ComplexArray) -> FloatArray:
        """A map as the caller gets it, the fixed vertices and those that have not moved to the last bit."""
        uv = _out_of_units(w, self.exponent)
        still = w[self._faint] == self._faint_w
        uv[self._faint[still]] = self._faint_uv[still]
        uv[self.fixed] = self._pinned
        return uv

    def descend(self, steps: int, tolerance: float) -> Iterator[Status | None]:
        """Take so many steps at most, and tell after each what `step` does; a status after the last that there is."""
        outcome = None
        while outcome is None and steps > 0:
            # Overflow gives inf or NaN, and a step with either is never accepted.
            with np.errstate(all="ignore"):
                outcome = self.step(tolerance)
            steps -= 1
            yield outcome

    def step(self, tolerance: float) -> Status | None:
        """Take one step; a status where there is no other to take."""
        if not np.isfinite(self.value):
            self._check_numbers()
        gradient = self.gradient()
        # While steps are cut short, reflect negative eigenvalues; a step in full says that clamping will do.
        for negative in (-1.0, 0.0) if self._cut else (0.0, -1.0):
            direction, expected_decrease, newton = self._direction(gradient, negative)
            small = newton and 0.5 * expected_decrease <= tolerance * (self.value + _NOTHING)
            if small and negative < 0 and self._cut:
                continue  # the reflected model is pessimistic: only the clamped one may declare an end
            if small and negative == 0 and self.value > _STRETCHED:
                # The model as it is has the last word, if it has a lowest point that doubles can tell.
                true, further, newton = self._direction(gradient, 1.0, SHIFTS[:1])
                if not newton:
                    self._search(direction, expected_decrease)
                    return Status.EXHAUSTED
                direction, expected_decrease, small = true, further, 0.5 * further <= tolerance * self.value
            before = self.value
            moved = self._search(direction, expected_decrease)
            if small and negative == 0 and not before - self.value > _MORE * tolerance * before:
                return Status.POLISHED
            if moved:
                self._idle = 0 if before - self.value > _IDLE * tolerance * before else self._idle + 1
                return Status.EXHAUSTED if self._idle >= _PATIENCE else None
        self._check_numbers()
        return Status.EXHAUSTED

    def _check_numbers(self) -> None:
        """Raise a ValueError if the energy at hand, or a derivative of it, is NaN or infinite for no good reason."""
        if isinstance(self.energy, DeformationEnergy):
            self.energy.check_numbers(self._deformation)

    def lower(self, energy: NewtonObjective) -> None:
        """Go on with another energy on the same triangles."""
        self.energy = energy
        self.system.take_gradients(energy.g)
        self._deformation = energy.deform(self.w)
        self.value = energy.value_of(self._deformation)
        self._cut, self._shift, self._idle = True, 0, 0

    def _system(self, n: int, linear_solver: str) -> NewtonSystem:
        """The matrix of Newton's steps for ``n`` vertices."""
        return NewtonSystem(self.energy.F, self.energy.g, n, self.fixed, linear_solver)

    def gradient(self) -> ComplexArray:
        """The energy's derivative by the unknowns."""
        return self.energy.gradient_of(self._deformation, self.w.size)[self.system.free]

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        """Newton's direction, the rate at which the energy falls along it (the squared decrement), and True;
        or, where no factorisation exists, the gradient over the diagonal, its rate, and False.
        """
        self.assemble(negative)
        # While steps are cut short, what was too little for the last matrix is for this one.
        skipped = self._shift if self._cut and shifts is SHIFTS else 0
        found = self.system.descent(gradient, shifts[skipped:], self.solve)
        if found is not None:
            direction, expected_decrease, tried = found
            self._shift = skipped + tried
            return direction, expected_decrease, True
        self._check_numbers()
        if shifts is SHIFTS:
            self._shift = len(SHIFTS) - 1
        direction = self.system.solve_diagonal(-gradient)
        return direction, -work(gradient, direction), False

    def assemble(self, negative: float) -> None:
        """Fill in the system's matrix at the map at hand."""
        self.system.assemble(self.energy.curvature_of(self._deformation, negative=negative))

    def solve(self, load: ComplexArray) -> ComplexArray:
        """The displacement of the free vertices under a load on them, the matrix being factored."""
        return self.system.solve(load)

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """The energy of a map (n,) complex128, and the map with what was made of it if it may be gone on from: if its
        energy is below a bound and every triangle, exactly, positive.
        """
        deformation = self.energy.deform(w)
        value = self.energy.value_of(deformation)
        accepted = value < bound and is_injective(self.energy.F, self.positions(w))
        return value, (w, deformation) if accepted else None

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """Move along a direction, as far as is good; False where no step lowers the energy enough."""
        if not expected_decrease > 0:
            return False
        full = np.zeros_like(self.w)
        full[self.system.free] = direction
        limit = FRACTION * float(self.energy.steps_to_collapse(self.w, full).min())
        start, before = self.w, self.value

        def trial(t: float, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
            return self.evaluate_trial(start + t * full, bound)

        taken = backtrack(trial, before, expected_decrease, longest=min(1.0, limit), tries=HALVINGS)
        if taken is None:
            # Where a triangle's area is all rounding, Newton's step is shorter than the spacing of the numbers.
            doublings = int(np.count_nonzero(2.0 ** np.arange(1, HALVINGS) <= limit))
            taken = backtrack(
                trial, before, expected_decrease, longest=2.0, tries=doublings, factor=lambda t, value: 2.0
            )
        if taken is None:
            return False
        self._cut = taken.t < _SHORT
        _, self.value, (self.w, self._deformation) = extend(trial, taken, limit, longer=_LONGER)
        return True
