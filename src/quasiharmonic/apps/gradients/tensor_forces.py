"""The change of a quasi-harmonic map's forces with its tensors, and its transpose."""

from __future__ import annotations

from dataclasses import dataclass

from quasiharmonic.apps.gradients.forces import Felt, Forces
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray


@dataclass(frozen=True, eq=False)
class TensorForces:
    """The tensors of a map with the energy density ``φ = c (|p|² + |q|²) − 2 Re (ω p q̄)`` on each triangle.

    Attributes
    ----------
    field : TensorField
    """

    field: TensorField

    def by_mu(self, forces: Forces, dmu: ComplexArray) -> ComplexArray:
        """The change of the forces (n,) for a change of the Beltrami coefficients (f,)."""
        double = 2.0 / self.field.defect
        dc = double**2 * (self.field.mu.conj() * dmu).real
        dtwist: ComplexArray = double * dmu + dc * self.field.mu
        p, q = forces.p, forces.q
        return forces.gathered(2 * (dc * p - dtwist.conj() * q), 2 * (dc * q - dtwist * p))

    def of(self, forces: Forces, felt: Felt) -> ComplexArray:
        """The transpose of `by_mu`: the gradient (f,) by the coefficients of the work along a displacement."""
        dp, dq = felt.dp, felt.dq
        by_c = 2 * forces.share * (forces.p.conj() * dp + forces.q.conj() * dq).real
        by_twist: ComplexArray = -2 * forces.share * (forces.q * dp.conj() + forces.p.conj() * dq)
        return self.field.pull_twist(by_c, by_twist)
