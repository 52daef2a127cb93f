"""Converge a map to rounding, and factor the second derivative there.

A polish stops when Newton's model predicts a decrease below a tolerance, and its matrices are made positive definite.
This module takes Newton steps with exact second derivatives, until rounding limits the last step. If the exact matrix
is not positive definite, only as much of the negative curvature of triangles is removed as necessary.
"""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.apps.gradients.derivative import Doubt
from quasiharmonic.apps.gradients.forces import Forces
from quasiharmonic.apps.gradients.freedom import Freedom
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation
from quasiharmonic.energies.newton.line_search import backtrack
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.util.arrays import ComplexArray, to_points
from quasiharmonic.util.progress import heartbeat


class MinimumTuning(NamedTuple):
    """Numbers that tune the exact steps to a minimum."""

    # Maximum number of steps.
    max_steps: int = 100
    # If the matrix is not positive definite, these fractions of the triangles' negative curvature are removed in turn.
    clamped: tuple[float, ...] = (1 / 64, 1 / 16, 1 / 4, 1.0)
    # Steps with a strain of at most this on every triangle count as zero.
    zero_strain: float = 1e-12
    # Exact steps below this that are more than half as long as the step before are limited by rounding.
    rounding_strain: float = 1e-6
    # If the last step strains more than this, the map has not converged.
    converged: float = 1e-6
    # After a step this short, second derivatives have the same leading digits, and are not factored again.
    reuse_strain: float = 1e-8
    # Relative increase of the energy that counts as rounding.
    rounding: float = 1e-13
    # With a unit diagonal, an eigenvalue below this counts as zero.
    singular: float = 1e-10
    # A triangle whose ratio of smaller to larger singular value is below this counts as nearly collapsed.
    collapsed_ratio: float = 1e-8


_TUNING = MinimumTuning()


class Minimum:
    """A stationary point of an energy, and the inverse of its second derivative.

    The map ``w`` (n,) complex128 is injective and near the stationary point; sliding vertices of ``freedom`` are on
    their curves. Without ``converge``, keep the map, and treat the remaining forces as constant. Raises ValueError if
    the energy or a derivative is NaN or infinite at the map, or its second derivative is singular.

    Attributes
    ----------
    w : (n,) complex128
        The converged map, certified as injective.
    forces : Forces
        Forces at ``w``.
    doubts : list of Doubt
    """

    def __init__(self, energy: DeformationEnergy, w: ComplexArray, freedom: Freedom, *, converge: bool = True) -> None:
        self._energy, self._freedom, self.w = energy, freedom, w
        self._lock = Lock()
        self._lu: Any = None
        self._clamped = 0.0
        self.doubts: list[Doubt] = []
        with np.errstate(all="ignore"):
            left = self._converge(_TUNING.max_steps if converge else 0)
            d, density = self._deformation, energy.energy
            curvature = density.curvature(d, negative=1.0)
            corners = np.ascontiguousarray(energy.F.T)
            self.forces = Forces(corners, w.size, energy.g, energy.share, d.p, d.q, *density.gradient(d), curvature)
            self._check_numbers()
            if not self._exact:
                self._factor_by_lu()
            self._record_doubts(left)

    def solve(self, load: ComplexArray) -> ComplexArray:
        """Return the displacement (n,) of the vertices under a load (n,) on them."""
        return self._freedom.spread(self._solve_unknowns(self._freedom.gather(load)))

    def _solve_unknowns(self, load: ComplexArray) -> ComplexArray:
        """Return the change of the unknowns under a load on them."""
        if self._lu is None:
            return self._freedom.system.solve(load)
        with self._lock:
            answer: ComplexArray = self._lu.solve(load.view(np.float64)).view(np.complex128)
            return answer

    def _converge(self, steps: int) -> float:
        """Take steps until converged, leave the system factored, and return the strain of the step not taken."""
        last = np.inf
        while True:
            heartbeat()
            step, self._exact = self._direction(self._evaluate())
            size = self._strain(step)
            if size <= _TUNING.zero_strain or (self._exact and size <= _TUNING.rounding_strain and size > 0.5 * last):
                return size
            if not steps or not self._take_step(step):
                return size
            if self._exact and size <= _TUNING.reuse_strain:
                # Convergence is quadratic, so this was the last step, and the factor is accurate to the same number of
                # digits.
                self._evaluate()
                return size
            last, steps = size, steps - 1

    def _evaluate(self) -> ComplexArray:
        """Evaluate the energy at the current map; return its gradient with respect to the unknowns."""
        self._deformation: Deformation = self._energy.deform(self.w)
        pull = self._energy.gradient_of(self._deformation, self.w.size)
        self._freedom.prepare(pull)
        return self._freedom.gradient(pull)

    def _direction(self, gradient: ComplexArray) -> tuple[ComplexArray, bool]:
        """Return Newton's step, and whether it uses the exact second derivatives."""
        system = self._freedom.system
        for clamped in (0.0, *_TUNING.clamped):
            if 0 < clamped < self._clamped:
                continue
            system.assemble(self._energy.curvature_of(self._deformation, negative=1.0 - clamped))
            if system.diagonal.min(initial=0.0) < 0:
                continue
            found = system.descent(gradient, (0.0,) if clamped < 1 else (1e-12, 1e-6))
            if found is not None:
                self._clamped = clamped / 4
                return found[0], clamped == 0
        return system.solve_diagonal(-gradient), False

    def _strain(self, step: ComplexArray) -> float:
        """The maximum relative change of a triangle under a step."""
        energy, moved = self._energy, self._freedom.spread(step)[self._energy.F.T]
        dp, dq = np.sum(energy.g.conj() * moved, axis=0), np.sum(energy.g * moved, axis=0)
        return float(np.max((np.abs(dp) + np.abs(dq)) / np.abs(self._deformation.p)))

    def _take_step(self, step: ComplexArray) -> bool:
        """Take the longest acceptable part of a step; return False if there is none."""
        before = self._energy.value_of(self._deformation) + self._freedom.extra()

        def evaluate_step(t: float, bound: float) -> tuple[float, ComplexArray | None]:
            there = self._freedom.advance(self.w, t * step)
            if there is None:
                return np.inf, None
            value = self._energy.value(there) + self._freedom.extra()
            accepted = value <= bound and is_injective(self._energy.F, to_points(there))
            return value, there if accepted else None

        # Near the stationary point only rounding changes the energy, so no decrease is required.
        taken = backtrack(evaluate_step, before + _TUNING.rounding * abs(before), 0.0, tries=40)
        if taken is None:
            return False
        self.w = taken.state
        self._freedom.keep()
        return True

    def _check_numbers(self) -> None:
        """Raise a ValueError where the energy or a derivative of it is NaN or infinite."""
        forces = self.forces
        value = self._energy.value_of(self._deformation)
        parts = value, forces.by_p, forces.by_q, *forces.form
        if all(np.isfinite(part).all() for part in parts):
            return
        self._energy.check_numbers(self._deformation)
        raise ValueError(
            "the energy or its derivatives leave the range of doubles at uv: its triangles are too large or too small, "
            "compared with those of the surface"
        )

    def _factor_by_lu(self) -> None:
        """Factor the exact second derivatives by LU although they have a negative direction."""
        from scipy.sparse import dia_array
        from scipy.sparse.linalg import splu

        system = self._freedom.system
        system.assemble(self._energy.curvature_of(self._deformation, negative=1.0))
        matrix = system.matrix()
        # Unused unknowns, across the line of a sliding vertex, have empty rows.
        empty = (abs(matrix) @ np.ones(matrix.shape[0])) == 0
        filled = matrix + dia_array((empty[None].astype(np.float64), [0]), shape=matrix.shape)
        try:
            self._lu = splu(filled.tocsc())
        except RuntimeError:  # as SciPy reports a singular matrix
            raise ValueError(
                "there is no derivative: the second derivative of the energy at uv is singular, so that other maps "
                "have the same energy; choose another energy, or fix more vertices"
            ) from None
        self.doubts.append(Doubt.NOT_LEAST)

    def _record_doubts(self, left: float) -> None:
        """Record the doubts."""
        if not left <= _TUNING.converged:
            self.doubts.append(Doubt.NOT_AT_REST)
        if self._least_eigenvalue() < _TUNING.singular:
            self.doubts.append(Doubt.NEAR_SINGULAR)
        p, q = np.abs(self._deformation.p), np.abs(self._deformation.q)
        if np.any(p - q < _TUNING.collapsed_ratio * (p + q)):
            self.doubts.append(Doubt.NEAR_COLLAPSE)
        if self._freedom.resting:
            self.doubts.append(Doubt.SLIDING)

    def _least_eigenvalue(self) -> float:
        """Estimate the smallest modulus of an eigenvalue, with a unit diagonal, from above."""
        system = self._freedom.system
        if not system.free.size:
            return 1.0
        scale = np.sqrt(np.abs(system.diagonal))
        x = np.random.default_rng(0).standard_normal(scale.size)
        growth = 0.0
        for _ in range(2):
            x *= scale / np.linalg.norm(x)
            try:
                x = scale * self._solve_unknowns(x.view(np.complex128)).view(np.float64)
            except NotPositiveDefinite:
                return 0.0
            growth = float(np.linalg.norm(x))
        return 1 / growth if growth > 0 else 1.0
