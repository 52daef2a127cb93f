"""Methods in the joint space of map and tensor, for the last inverted triangles: Newton's, and the greedy alternation.

Newton's method (§F.2) has a trust region and no line search. Newton's method on positions, for distortion energies, is
`energies.newton`.

The energy ``P(u, v, ξ) = Σ m [c (|p|² + |q|²) − 2 Re(t p q̄)]`` with ``c(|ξ|)`` and ``t = s(|ξ|) ξ/|ξ|`` couples ξ and
the map triangle by triangle. In the directions along and across ξ, ``δξ = (α + iβ) ξ/|ξ|``:

    ⎡ H   B ⎤ ⎡ d ⎤      ⎡ 0 ⎤       H, B, K: one 4×4, 4×2 and 2×2 block per triangle; H is the Laplacian for u
    ⎣ Bᵀ  K ⎦ ⎣ δξ⎦ = −  ⎣ g ⎦       and v. The map is quasi-harmonic, so its own gradient vanishes.

K is eliminated on each triangle, which leaves ``H − B K⁻¹ Bᵀ`` with the size and sparsity of planar elasticity. After
the step the map is made quasi-harmonic again, which only lowers the energy. The method is therefore also Newton's
method for V₃ as a function of ξ alone.

With ``r = |μ|`` as a function of |ξ|, and its first two derivatives ``r'`` and ``r''``::

    c = (1 + r²) / (1 − r²)      c' = 4 r / (1 − r²)² r'           c'' = 4 (1 + 3 r²) / (1 − r²)³ r'² + c'/r' r''
    s = 2 r / (1 − r²)           s' = 2 (1 + r²) / (1 − r²)² r'    s'' = 4 r (3 + r²) / (1 − r²)³ r'² + s'/r' r''

Across ξ, quotients ``c'/|ξ|`` and ``(s' − s/|ξ|) / |ξ|`` occur. At ``ξ = 0``, where
``r' = 1``, they have the limits 4 and ``s''/2``.

The trust region has Levenberg's form: ``K + λ m (|p|² + |q|²) I``. As λ grows, the step shrinks towards the gradient's
direction, and ``H − B K⁻¹ Bᵀ`` tends to the positive definite H.

The alternation (§9.2) alternates between the best tensor for the map and the best map for the tensor. It is equivalent
to lowering the total unsigned area of Xu et al. (2011). Far from a solution it stalls at once (§7.1), but it often
untangles the last few tiny triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import own_tensor
from quasiharmonic.solver.methods.base import Iterates, TensorDescent
from quasiharmonic.util.arrays import ComplexArray, sum_at


class NewtonTuning(NamedTuple):
    """Numbers that tune the damping of Newton's method."""

    # First and largest damping λ.
    first_damping: float = 1e-2
    max_damping: float = 1e12
    # The damping grows by the factor if a step gains less than the first part of what the model predicts, and falls by
    # it if a step gains more than the second part.
    factor: float = 4.0
    poor_gain: float = 0.25
    good_gain: float = 0.75
    # A step is taken if it gains more than this part.
    least_gain: float = 1e-4
    # Least eigenvalue of a triangle's block K, as a fraction of the largest of the block, and of the largest of all.
    # The block of a triangle that has shrunk to a point is zero and not invertible.
    min_ratio: float = 1e-10
    min_eigenvalue: float = 1e-100


_TUNING = NewtonTuning()


@dataclass(frozen=True, kw_only=True)
class Newton(TensorDescent):
    """Descend V₃ by Newton steps in a trust region.

    Attributes
    ----------
    iterations : int
        Maximum number of steps tried; rejected steps yield nothing.
    """

    label: ClassVar[str] = "newton"
    #: Short: Newton steps are expensive, and if they succeed they do so early.
    patience: ClassVar[tuple[int, float] | None] = (40, 0.1)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; converged when no step lowers the energy."""
        mesh, problem = objective.mesh, objective.problem
        system = NewtonSystem(problem.F, 0.5 * mesh.gamma, problem.n, problem.fixed, objective.laplacian.solver.name)
        here, damping = start, _TUNING.first_damping
        model = SecondOrderModel(here)
        for _ in range(self.iterations):
            try:
                # If all curvatures underflow, a division by zero gives NaN, and matrices with NaN are rejected.
                with np.errstate(divide="ignore", invalid="ignore"):
                    step, predicted = model.step(system, damping)
                there = objective.evaluate(objective.clip_xi(here.xi + step))
            except NotPositiveDefinite:
                predicted, there = 0.0, None
            gain = (here.dirichlet - there.dirichlet) / predicted if there is not None and predicted > 0 else -np.inf
            if gain < _TUNING.poor_gain:
                damping *= _TUNING.factor
            elif gain > _TUNING.good_gain:
                damping /= _TUNING.factor
            if there is not None and gain > _TUNING.least_gain:
                here = there
                yield here
                model = SecondOrderModel(here)
            elif damping > _TUNING.max_damping:
                return True
        return False


class SecondOrderModel:
    """Second-order model of P around a quasi-harmonic map.

    Attributes
    ----------
    K : three of (f,) float64
        Entries 11, 12, 22 of each triangle's block, in the directions along and across ξ.
    B : two of two of (f,) complex128
        Mixed derivatives by p and by q, for the directions along and across ξ.
    g : two of (f,) float64
        The gradient along and across ξ.
    unit : (f,) complex128
        ``ξ/|ξ|``.
    """

    def __init__(self, here: Iterate) -> None:
        field, (p, q, _) = here.field, here.dw
        self.here = here
        self.size = p.real**2 + p.imag**2 + q.real**2 + q.imag**2
        m = here.objective.mesh.m
        unit = np.divide(field.xi, field.rho, out=np.ones_like(field.xi), where=field.rho > 0)
        self.unit = unit
        r = field.ratio * field.rho
        D, slope = field.defect, field.slope
        second_derivative = here.objective.parameterisation.second_derivative(field.rho)
        rho = np.where(field.rho > 0, field.rho, 1.0)
        # Derivatives of c and s by |ξ|, through r.
        c1 = 4 * r / D**2 * slope
        c2 = 4 * (1 + 3 * r**2) / D**3 * slope**2 + 4 * r / D**2 * second_derivative
        s1 = 2 * (1 + r**2) / D**2 * slope
        s2 = 4 * r * (3 + r**2) / D**3 * slope**2 + 2 * (1 + r**2) / D**2 * second_derivative
        s_over = 2 * field.ratio / D
        c1_over = np.where(field.rho > 0, c1 / rho, 4.0)
        twist = np.where(field.rho > 0, (s1 - s_over) / rho, 0.5 * s2)
        h = unit * p * q.conj()
        self.K = (
            m * (self.size * c2 - 2 * s2 * h.real),
            2 * m * twist * h.imag,
            m * (self.size * c1_over - 2 * twist * h.real),
        )
        self.g = m * (self.size * c1 - 2 * s1 * h.real), 2 * m * s_over * h.imag
        along = 2 * m * (c1 * p - s1 * unit.conj() * q), 2 * m * (c1 * q - s1 * unit * p)
        across = 2j * m * s_over * unit.conj() * q, -2j * m * s_over * unit * p
        self.B = along, across
        c, t = 2 / D - 1, 2 * field.mu / D
        zero = np.zeros_like(p)
        self.H = QuadraticForm(2 * m * c, 2 * m * c, zero, zero, zero, -4 * m * t)

    def step(self, system: NewtonSystem, damping: float) -> tuple[ComplexArray, float]:
        """Return the step in ξ and the decrease of the energy that the model predicts."""
        m = self.here.objective.mesh.m
        ridge = damping * m * self.size
        k11, k12, k22 = self.K[0] + ridge, self.K[1], self.K[2] + ridge
        # An inverted triangle may have a concave block: take absolute eigenvalues and bound them away from zero.
        mean, half = 0.5 * (k11 + k22), np.hypot(0.5 * (k11 - k22), k12)
        high, low = np.abs(mean + half), np.abs(mean - half)
        floor = _TUNING.min_ratio * np.maximum(high, low) + _TUNING.min_eigenvalue * high.max()
        high, low = np.maximum(high, floor), np.maximum(low, floor)
        # Keep the eigenvectors: scale the deviator to the new half difference, which may have either sign.
        swapped = np.abs(mean - half) > np.abs(mean + half)
        stretch = np.divide(
            np.where(swapped, -1, 1) * 0.5 * np.abs(high - low), half, out=np.zeros_like(half), where=half > 0
        )
        deviator, k12 = stretch * 0.5 * (k11 - k22), stretch * k12
        k11, k22, det = 0.5 * (high + low) + deviator, 0.5 * (high + low) - deviator, high * low

        # B K⁻¹ Bᵀ as two squares, by the Cholesky factor of K.
        l11 = np.sqrt(k11)
        l21, l22 = k12 / l11, np.sqrt(det / k11)
        along, across = self.B
        first = along[0] / l11, along[1] / l11
        second = (across[0] - l21 * first[0]) / l22, (across[1] - l21 * first[1]) / l22
        system.assemble(_less_squares(self.H, first, second))
        system.factor()

        g1 = self.g[0] / l11
        g2 = (self.g[1] - l21 * g1) / l22
        load = self.gather(first[0] * g1 + second[0] * g2, first[1] * g1 + second[1] * g2)
        d = np.zeros(self.here.w.shape, dtype=np.complex128)
        d[system.free] = system.solve(load[system.free])
        dp, dq, _ = self.here.objective.mesh.derivatives(d)
        # K δξ = −(g + Bᵀ d)
        y1 = -(self.g[0] + (along[0].conj() * dp + along[1].conj() * dq).real)
        y2 = -(self.g[1] + (across[0].conj() * dp + across[1].conj() * dq).real)
        alpha, beta = (k22 * y1 - k12 * y2) / det, (k11 * y2 - k12 * y1) / det
        predicted = -0.5 * float((self.g[0] * alpha + self.g[1] * beta).sum())
        return (alpha + 1j * beta) * self.unit, predicted

    def gather(self, by_p: ComplexArray, by_q: ComplexArray) -> ComplexArray:
        """Convert derivatives by p and q to derivatives by the vertices' positions; (n,) complex128."""
        mesh = self.here.objective.mesh
        g = 0.5 * mesh.gamma
        parts = (by_p * g + by_q * g.conj()).ravel()
        corner = mesh.F.T.ravel()
        return sum_at(corner, parts, mesh.n)


def _less_squares(form: QuadraticForm, *vectors: tuple[ComplexArray, ComplexArray]) -> QuadraticForm:
    """Return the form minus the squares ``Re(conj(b_p) dp + conj(b_q) dq)²``."""
    pp, qq, p2, q2, pq, pqc = form
    for bp, bq in vectors:
        cp, cq = bp.conj(), bq.conj()
        pp = pp - 0.5 * (bp * cp).real
        qq = qq - 0.5 * (bq * cq).real
        p2, q2 = p2 - 0.5 * cp**2, q2 - 0.5 * cq**2
        pq, pqc = pq - cp * cq, pqc - cp * bq
    return QuadraticForm(pp, qq, p2, q2, pq, pqc)


@dataclass(frozen=True, kw_only=True)
class Alternating(TensorDescent):
    """Descend V₃ by alternation; each half step lowers it."""

    label: ClassVar[str] = "alternating"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`."""
        here = start
        for _ in range(self.iterations):
            best = objective.parameterisation.invert(own_tensor(here.dw.p, here.dw.q))
            here = objective.step(here, best - here.xi)
            yield here
        return False
