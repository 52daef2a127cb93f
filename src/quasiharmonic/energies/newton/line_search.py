"""Parts of a line search: backtracking with Armijo's rule, extension beyond Newton's step, and curved paths.

`map_model` combines them to the line search of Newton's method on positions, and sets its constants. `sliding_boundary`
and `surface_descent` do so for their paths. Gradient methods on tensors (`solver.methods`) do not use this module.

A `RotationPath` is for maps with large rotations. A strip that rolls up hardly strains its triangles but rotates them
by whole turns. Along a straight line, a triangle that rotates by θ grows by ``√(1 + θ²)``. So the energy permits only
small rotations per step. Hundreds of full steps each lower the energy by one percent. With the angular velocity
``θ = Im dp/p`` of a triangle along a direction, the path::

    p(t) = e^{iθt} (p + t (dp − iθp)),    q(t) = e^{iθt} (q + t (dq − iθq))

is tangent to the straight line and rotates the triangle without strain. Triangles rotated separately do not fit
together. The map whose derivatives are closest to these, weighted by rest area, is the solution of a linear system with
a constant Laplacian. At first order the triangles fit, so the path is tangent to the direction. A step along it has the
same expected decrease as Newton's step.

The same system has two more uses near an isometry. The map whose derivatives are closest to the rotations of all
triangles has less strain (`RotationPath.turn`), without the limits that thin triangles set to a straight step. And the
Laplacian approximates the second derivatives of the energy, so conjugate gradients with it converge in few iterations
(`RotationPath.inverse_near`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from quasiharmonic.energies.deformation import pulls
from quasiharmonic.energies.energies import Deformation
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian, weigh_edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, sum_at
from quasiharmonic.util.progress import heartbeat

S = TypeVar("S")

# Minimum decrease of a step, as a fraction of the expected decrease (Armijo's condition).
_SUFFICIENT = 1e-4


class AcceptedStep(NamedTuple, Generic[S]):
    """An accepted step: its length in units of the direction, and the function's value and the trial's state there."""

    t: float
    value: float
    state: S


#: Takes a length and a bound; returns the value there, and the state if the value is below the bound and accepted.
Trial = Callable[[float, float], tuple[float, S | None]]


def _halve(t: float, value: float) -> float:
    return 0.5


def backtrack(
    trial: Trial[S],
    before: float,
    expected_decrease: float,
    *,
    longest: float = 1.0,
    tries: int,
    factor: Callable[[float, float], float] = _halve,
) -> AcceptedStep[S] | None:
    """Try successive step lengths until the function decreases sufficiently; return the first accepted step or None.

    Parameters
    ----------
    trial : callable
        See `Trial`.
    before : float
        The function's value at the start.
    expected_decrease : float
        Rate of decrease along the direction, to first order; positive.
    longest : float
        The first length.
    tries : int
        Maximum number of lengths.
    factor : callable
        Takes a length and the value there; returns the factor for the next length.
    """
    t = longest
    for _ in range(tries):
        heartbeat()
        value, there = trial(t, before - _SUFFICIENT * min(t, 1.0) * expected_decrease)
        if there is not None:
            return AcceptedStep(t, value, there)
        t *= factor(t, value)
    return None


def backtrack_each(
    values: Callable[[FloatArray], FloatArray],
    before: FloatArray,
    expected_decrease: FloatArray,
    longest: FloatArray,
    *,
    tries: int,
) -> tuple[FloatArray, FloatArray]:
    """Backtrack along one direction with a length for each of many independent functions.

    ``values`` takes lengths (k,) and returns the functions' values (k,). A function with ``longest`` 0 stays. See
    `backtrack` for the others. Return the accepted lengths (k,), 0 where none was accepted, and the values there.
    """
    t, moving = longest.copy(), longest > 0
    for _ in range(tries):
        heartbeat()
        value = values(t)
        too_far = moving & ~(value <= before - _SUFFICIENT * t * expected_decrease)
        if not too_far.any():
            return t, value
        t[too_far] *= 0.5
    t[too_far] = 0
    return t, values(t)


def extend(
    trial: Trial[S], taken: AcceptedStep[S], limit: float = float("inf"), *, longer: float = 2.0
) -> AcceptedStep[S]:
    """Lengthen an accepted full step by factors ``longer``, up to ``limit``, as long as the function decreases.

    Far from the minimum, barriers decrease like powers, and Newton's step is several times too short.
    """
    while taken.t >= 1 and longer * taken.t <= limit:
        heartbeat()
        value, there = trial(longer * taken.t, taken.value)
        if there is None:
            break
        taken = AcceptedStep(longer * taken.t, value, there)
    return taken


def rates(F: IntArray, g: ComplexArray, w: ComplexArray, direction: ComplexArray) -> ComplexArray:
    """``dp/p`` of every triangle (f,) along a direction: the growth rate plus ``i`` times the angular velocity."""
    corners = F.T
    rate: ComplexArray = np.sum(g.conj() * direction[corners], axis=0) / np.sum(g.conj() * w[corners], axis=0)
    return rate


class RotationPath:
    """Rotation paths of maps of one mesh, each of whose vertices is in a triangle.

    ``g`` (3, f) is as in `NewtonSystem`. Each component has at least one fixed vertex. The constructor raises
    `NotPositiveDefinite` if rest triangles differ too much for a positive definite Laplacian; see `of`.
    """

    def __init__(self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str = "auto") -> None:
        self._F = F
        self._g = g
        # The cross product of the gradients gives the area up to a common factor.
        self._area: FloatArray = 1 / np.abs((g[1].conj() * g[2]).imag)
        self._laplacian = Laplacian(F, n, fixed, linear_solver).factor(weigh_edges(g, self._area))

    @cached_property
    def _corners(self) -> IntArray:
        return np.ascontiguousarray(self._F.T)

    @property
    def linear_solver(self) -> str:
        """Name of the linear solver."""
        return self._laplacian.laplacian.solver.name

    @classmethod
    def of(
        cls, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str = "auto"
    ) -> RotationPath | None:
        """Create a `RotationPath`, or return None if rounding leaves no positive definite Laplacian."""
        try:
            return cls(F, g, n, fixed, linear_solver)
        except NotPositiveDefinite:
            return None

    def path(self, w: ComplexArray, direction: ComplexArray) -> Callable[[float], ComplexArray]:
        """Return a path through a map (n,) complex128 along a direction (n,), which is zero at the fixed vertices.

        It maps a length t to a map, ``w + t · direction`` to first order. It may raise `NotPositiveDefinite` if
        rounding leaves no correct digit.
        """
        (p, q), (dp, dq) = self._derivatives(w), self._derivatives(direction)
        angle = rates(self._F, self._g, w, direction).imag
        strain_p, strain_q = dp - 1j * angle * p, dq - 1j * angle * q

        def at(t: float) -> ComplexArray:
            turned = np.exp(1j * t * angle)
            beyond_p = turned * (p + t * strain_p) - (p + t * dp)
            beyond_q = turned * (q + t * strain_q) - (q + t * dq)
            load = self._area * (beyond_p * self._g + beyond_q * self._g.conj())
            return w + t * direction + self._laplacian.respond(sum_at(self._corners.ravel(), load.ravel(), w.size))

        return at

    def turn(self, w: ComplexArray, d: Deformation, rotations: ComplexArray) -> ComplexArray:
        """Return the map (n,) closest to given rotations (f,) of the rest triangles' frames, as unit complex numbers.

        The fixed vertices stay as in the map ``w`` (n,), whose deformation is ``d``. Triangles may be inverted. With
        the rotations of ``w``, this is a step of Sorkine and Alexa's method (2007) for `ARAP`. May raise
        `NotPositiveDefinite` as `path`.
        """
        load = np.empty(w.size, dtype=np.complex128)
        pulls(rotations - d.p, -d.q, self._area, self._F, self._g, load)
        return w + self._laplacian.respond(load)

    def inverse_near(self, diagonal: FloatArray) -> Callable[[ComplexArray], ComplexArray]:
        """Return an approximate inverse of an energy's second derivatives near an isometry, for `NewtonSystem.iterate`.

        ``diagonal`` (2 (n - k),) is theirs. The function maps (n - k,) to (n - k,) complex128.
        """
        free = self._laplacian.laplacian.free
        own = np.bincount(self._F.T.ravel(), (2 * self._area * np.abs(self._g) ** 2).ravel())
        scale = np.median(own[free] / diagonal.reshape(-1, 2).mean(axis=1))

        def solve(load: ComplexArray) -> ComplexArray:
            full = np.zeros(own.size, dtype=np.complex128)
            full[free] = scale * load
            return self._laplacian.respond(full)[free]

        return solve

    def _derivatives(self, w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """``∂w/∂z`` and ``∂w/∂z̄`` on every triangle, (f,) complex128 each."""
        corners = w[self._corners]
        return np.sum(self._g.conj() * corners, axis=0), np.sum(self._g * corners, axis=0)
