"""Projected Newton descent of a deformation energy; the map after every step is injective (§10, §11).

::

    assemble ──▶ factor ──▶ direction ──▶ t = min(1, 0.9 × first collapse) ──▶ less energy? ──▶ injective, exactly?
       ▲                                          │ ▲            no: t/2 ◀──────────┴────────────────┘ yes
       └──────────────────────────────────────────┼─┴── t = 1 went well: 1.5t, … as long as the energy falls
                                                  └── next map

The second derivative of the energy is made positive definite triangle by triangle, in closed form
(`quasiharmonic.energies.energies`). While collapsing triangles shorten the steps, negative eigenvalues are replaced by
their absolute values, which allows longer steps. Afterwards they are clamped to zero, which converges faster.
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

# Maximum step, as a fraction of the step at which the first triangle would collapse.
FRACTION = 0.9
# Maximum number of halvings, and then of doublings, of a step along one direction.
HALVINGS = 30
# Relative increases of the diagonal, tried in turn until a factorisation exists. Rounding alone changes the eigenvalues
# by about the first. They can be this small where triangle sizes span many orders of magnitude.
SHIFTS = 1e-15, 1e-12, 1e-9, 1e-6, 1e-3
# Steps shorter than the first value count as shortened, others as full. Full steps are extended by the second factor.
_SHORT, _LONGER = 0.25, 1.5
# A step that lowers the energy by less than the first value times the tolerance is idle. After this many successive
# idle steps the descent has stalled.
_IDLE, _PATIENCE = 1e-2, 3
# If a step with an expected decrease below the tolerance gains more than this multiple of the tolerance, the model is
# pessimistic and the map has not converged.
_MORE = 4.0
# A mean energy this small is rounding error: the map is an isometry or a similarity.
_NOTHING = 1e-12
# Above this mean energy, clamping may increase the second derivatives so much that the expected decrease is far too
# low. The error is about the energy: a factor of a thousand for a stretch of thirty.
_STRETCHED = 100.0


def in_units(uv: FloatArray, exponent: int) -> ComplexArray:
    """Return positions (n, 2) as complex numbers (n,) in units of ``2 ** exponent``."""
    return np.ldexp(uv, -exponent).view(np.complex128).ravel()


def _out_of_units(w: ComplexArray, exponent: int) -> FloatArray:
    """Return positions (n, 2) from complex numbers (n,) in units of ``2 ** exponent``."""
    return np.ldexp(w.view(np.float64).reshape(-1, 2), exponent)


class NewtonObjective(Protocol):
    """Interface of the objectives of `NewtonDescent`: a barrier energy on a mesh, such as `DeformationEnergy`.

    The result of ``deform`` is passed to the other methods; its type is up to the objective.

    Attributes
    ----------
    F : (f, 3) int64
    g : (3, f) complex128
        As in `NewtonSystem`; each quadratic form of ``curvature_of`` belongs to one of these triangles.
    """

    F: IntArray
    g: ComplexArray

    def deform(self, w: ComplexArray) -> Any:
        """Data of a map (n,) for the other methods."""

    def value_of(self, moment: Any, /) -> float:
        """Energy; ``inf`` where a triangle is inverted."""

    def gradient_of(self, moment: Any, n: int, /) -> ComplexArray:
        """Derivative with respect to ``n`` positions; (n,) complex128."""

    def curvature_of(self, moment: Any, /, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives; ``negative`` as in `Energy.curvature`."""

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """Smallest positive step along a direction at which each triangle's area vanishes; (f,) float64."""


class NewtonDescent:
    """State of a Newton descent: the current map and the computation of the next.

    Parameters
    ----------
    energy : NewtonObjective
        For maps in units of ``2 ** exponent``.
    uv : (n, 2) float64
        An injective map.
    fixed : (k,) int64
        Fixed vertices, which keep their positions in ``uv`` exactly.
    exponent : int
        Binary exponent of the length unit of the computation.
    linear_solver : str

    Attributes
    ----------
    w : (n,) complex128
        The current map, in units.
    first, value : float
        Objective at the start and now.
    fixed : (k,) int64
        The fixed vertices.
    exponent : int
        Binary exponent of the length unit of the computation.
    """

    def __init__(
        self, energy: NewtonObjective, uv: FloatArray, fixed: IntArray, exponent: int, linear_solver: str
    ) -> None:
        self.energy = energy
        self.fixed, self._pinned = fixed, uv[fixed]
        self.exponent = exponent
        self.w: ComplexArray = in_units(uv, exponent)
        # Coordinates too small for the unit do not survive the conversion and are stored separately.
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
        """Mean energy at the start and now."""
        return self.first, self.value

    def positions(self, w: ComplexArray) -> FloatArray:
        """Convert a map to positions (n, 2); fixed and unmoved vertices keep their original positions exactly."""
        uv = _out_of_units(w, self.exponent)
        still = w[self._faint] == self._faint_w
        uv[self._faint[still]] = self._faint_uv[still]
        uv[self.fixed] = self._pinned
        return uv

    def descend(self, steps: int, tolerance: float) -> Iterator[Status | None]:
        """Take at most ``steps`` steps and yield the result of `step` after each; stop at the first status."""
        outcome = None
        while outcome is None and steps > 0:
            # Overflow gives inf or NaN. Steps with either are never accepted.
            with np.errstate(all="ignore"):
                outcome = self.step(tolerance)
            steps -= 1
            yield outcome

    def step(self, tolerance: float) -> Status | None:
        """Take one step; return a status if no further step is possible."""
        if not np.isfinite(self.value):
            self._check_numbers()
        gradient = self.gradient()
        # While steps are shortened, reflect negative eigenvalues. After a full step, clamp them.
        for negative in (-1.0, 0.0) if self._cut else (0.0, -1.0):
            direction, expected_decrease, newton = self._direction(gradient, negative)
            small = newton and 0.5 * expected_decrease <= tolerance * (self.value + _NOTHING)
            if small and negative < 0 and self._cut:
                continue  # the reflected model is pessimistic: only the clamped one may report convergence
            if small and negative == 0 and self.value > _STRETCHED:
                # The unmodified model decides, if it has a minimum within double precision.
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
        """Raise a ValueError if the energy or a derivative is NaN or infinite without extreme stretch."""
        if isinstance(self.energy, DeformationEnergy):
            self.energy.check_numbers(self._deformation)

    def lower(self, energy: NewtonObjective) -> None:
        """Continue the descent with another energy on the same triangles."""
        self.energy = energy
        self.system.take_gradients(energy.g)
        self._deformation = energy.deform(self.w)
        self.value = energy.value_of(self._deformation)
        self._cut, self._shift, self._idle = True, 0, 0

    def _system(self, n: int, linear_solver: str) -> NewtonSystem:
        """Return the linear system of Newton's steps for ``n`` vertices."""
        return NewtonSystem(self.energy.F, self.energy.g, n, self.fixed, linear_solver)

    def gradient(self) -> ComplexArray:
        """Derivative of the energy with respect to the unknowns."""
        return self.energy.gradient_of(self._deformation, self.w.size)[self.system.free]

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        """Return Newton's direction, its expected decrease (the squared Newton decrement), and True.

        If no factorisation exists, return the negative gradient divided by the diagonal, its expected decrease, and
        False.
        """
        self.assemble(negative)
        # While steps are shortened, skip shifts that were too small for the previous matrix.
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
        """Assemble the system's matrix at the current map."""
        self.system.assemble(self.energy.curvature_of(self._deformation, negative=negative))

    def solve(self, load: ComplexArray) -> ComplexArray:
        """Displacement of the free vertices under a load on them, with the factored matrix."""
        return self.system.solve(load)

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """Return the energy of a map (n,) complex128, and the map with its deformation if it is accepted.

        A map is accepted if its energy is below ``bound`` and every triangle is positive, computed exactly.
        """
        deformation = self.energy.deform(w)
        value = self.energy.value_of(deformation)
        accepted = value < bound and is_injective(self.energy.F, self.positions(w))
        return value, (w, deformation) if accepted else None

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """Line search along a direction; return False if no step lowers the energy enough."""
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
            # If a triangle's area is at rounding level, Newton's step may be shorter than the spacing of doubles, so
            # try longer ones.
            doublings = int(np.count_nonzero(2.0 ** np.arange(1, HALVINGS) <= limit))
            taken = backtrack(
                trial, before, expected_decrease, longest=2.0, tries=doublings, factor=lambda t, value: 2.0
            )
        if taken is None:
            return False
        self._cut = taken.t < _SHORT
        _, self.value, (self.w, self._deformation) = extend(trial, taken, limit, longer=_LONGER)
        return True
