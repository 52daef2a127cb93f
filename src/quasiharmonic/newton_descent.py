"""Projected Newton steps down a deformation energy, each of which ends in an injective map (§10, §11).

    assemble ──▶ factor ──▶ direction ──▶ t = min(1, 0.9 × first collapse) ──▶ less energy? ──▶ injective, exactly?
       ▲                                          │ ▲            no: t/2 ◀──────────┴────────────────┘ yes
       └──────────────────────────────────────────┼─┴── t = 1 went well: 2t, 4t, … as long as the energy falls
                                                  └── next map

The second derivative of the energy is made positive definite triangle by triangle, in closed form
(`quasiharmonic.energies`). While collapsing triangles cut the steps short, negative eigenvalues enter with
their absolute values, which aims less far and gets further; afterwards they are clamped at zero, which
converges faster.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.certificate import is_injective
from quasiharmonic.deformation_energy import DeformationEnergy
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.newton_system import NewtonSystem
from quasiharmonic.result import Status

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

# Of the step at which the first triangle would collapse.
_FRACTION = 0.9
# Of the decrease that the gradient promises (Armijo's condition).
_SUFFICIENT = 1e-4
# The step is halved, and then doubled, this often before the direction is given up.
_HALVINGS = 30
# Raised diagonals, one after the other until a factorisation exists. Rounding alone moves the eigenvalues
# by the first, and where triangles span many orders of magnitude they are as small as that.
_SHIFTS = 1e-15, 1e-12, 1e-9, 1e-6, 1e-3
# A step that lowers the energy by less than this part of the tolerance is idle; after so many in a row the
# map has come to rest short of convergence.
_IDLE, _PATIENCE = 1e-2, 3
# A mean energy this small is rounding: the map is an isometry, or a similarity.
_NOTHING = 1e-12


def in_units(uv: FloatArray, exponent: int) -> ComplexArray:
    """Positions (n, 2) as complex numbers (n,) in units of ``2 ** exponent``."""
    return np.ldexp(uv, -exponent).view(np.complex128).ravel()


class NewtonDescent:
    """The map at hand and how to get to the next.

    Parameters
    ----------
    energy : DeformationEnergy
        A barrier, for maps in units of ``2 ** exponent``.
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
        The energy at the start and now.
    """

    def __init__(
        self, energy: DeformationEnergy, uv: FloatArray, fixed: IntArray, exponent: int, linear_solver: str
    ) -> None:
        self.energy = energy
        self._fixed, self._pinned = fixed, uv[fixed]
        self._exponent = exponent
        self.w: ComplexArray = in_units(uv, exponent)
        self.system = NewtonSystem(energy.F, energy.g, len(uv), fixed, linear_solver)
        self._deformation = self.energy.deform(self.w)
        self.value = self.first = self.energy.value_of(self._deformation)
        self._cut = True
        self._shift = 0
        self._idle = 0

    def positions(self, w: ComplexArray) -> FloatArray:
        """A map as the caller gets it, the fixed vertices to the last bit."""
        uv = np.ldexp(w.view(np.float64).reshape(-1, 2), self._exponent)
        uv[self._fixed] = self._pinned
        return uv

    def step(self, tolerance: float) -> Status | None:
        """Take one step; a status where there is no other to take."""
        gradient = self.energy.gradient_of(self._deformation, self.w.size)[self.system.free]
        # While steps are cut short, reflect negative eigenvalues; a step in full says that clamping will do.
        for negative in (-1.0, 0.0) if self._cut else (0.0, -1.0):
            direction, promise, newton = self._direction(gradient, negative)
            small = newton and 0.5 * promise <= tolerance * (self.value + _NOTHING)
            if small and negative < 0 and self._cut:
                continue  # the reflected model is pessimistic: only the clamped one may declare an end
            before = self.value
            moved = self._search(direction, promise)
            if small and negative == 0:
                return Status.POLISHED
            if moved:
                self._idle = 0 if before - self.value > _IDLE * tolerance * before else self._idle + 1
                return Status.EXHAUSTED if self._idle >= _PATIENCE else None
        return Status.EXHAUSTED

    def _direction(self, gradient: ComplexArray, negative: float) -> tuple[ComplexArray, float, bool]:
        """Newton's direction, the rate at which the energy falls along it (the squared decrement), and True;
        or, where no factorisation exists, the gradient over the diagonal, its rate, and False.
        """
        self._assemble(negative)
        # While steps are cut short, what was too little for the last matrix is for this one.
        for number in range(self._shift if self._cut else 0, len(_SHIFTS)):
            try:
                self.system.factor(_SHIFTS[number])
                direction = self._solve(-gradient)
            except NotPositiveDefinite:
                continue
            self._shift = number
            promise = -_dot(gradient, direction)
            if promise >= 0:
                return direction, promise, True
        direction = self.system.solve_diagonal(-gradient)
        return direction, -_dot(gradient, direction), False

    def _assemble(self, negative: float) -> None:
        """Fill in the system's matrix at the map at hand."""
        self.system.assemble(self.energy.curvature_of(self._deformation, negative=negative))

    def _solve(self, load: ComplexArray) -> ComplexArray:
        """The displacement of the free vertices under a load on them, the matrix being factored."""
        return self.system.solve(load)

    def _search(self, direction: ComplexArray, promise: float) -> bool:
        """Move along a direction, as far as is good; False where no step lowers the energy enough."""
        if not promise > 0:
            return False
        full = np.zeros_like(self.w)
        full[self.system.free] = direction
        limit = _FRACTION * float(self.energy.steps_to_collapse(self.w, full).min())
        start, before = self.w, self.value
        longest = min(1.0, limit)
        halved = longest * 0.5 ** np.arange(_HALVINGS)
        # Where a triangle's area is all rounding, Newton's step is shorter than the spacing of the numbers.
        doubled = 2.0 ** np.arange(1, _HALVINGS)
        for t in (*halved, *doubled[doubled <= limit]):
            if self._accept(start + t * full, before - _SUFFICIENT * min(t, 1.0) * promise):
                break
        else:
            return False
        self._cut = t < 1
        # Far from the minimum, barriers fall by powers and Newton's step is several times too short.
        while t >= 1 and 2 * t <= limit and self._accept(start + 2 * t * full, self.value):
            t *= 2
        return True

    def _accept(self, w: ComplexArray, bound: float) -> bool:
        """Go there if the energy is below a bound and every triangle, exactly, positive."""
        deformation = self.energy.deform(w)
        value = self.energy.value_of(deformation)
        if not (value < bound and is_injective(self.energy.F, self.positions(w))):
            return False
        self.w, self._deformation, self.value = w, deformation, value
        return True


def _dot(a: ComplexArray, b: ComplexArray) -> float:
    return float(np.sum(a.real * b.real + a.imag * b.imag))
