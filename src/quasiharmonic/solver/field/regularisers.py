"""Regularisers: functions of the tensor field that are added to an injectivity functional (§11.1.4)."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.reference import Derivatives
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray, FloatArray


class Conformal:
    """R₁, the MIPS energy that the tensors' own map would have (§11.1.4, eq. 35 to 37).

    ::

        R₁(ξ) = Σ sⱼ ℛ(μⱼ),   ℛ(μ) = (1 − |μ|)/(1 + |μ|) + (1 + |μ|)/(1 − |μ|) − 2 = 4 |μ|²/(1 − |μ|²)

    For tanh this is ``4 sinh²|ξ|``. If V₃ vanishes, a triangle's σ₁/σ₂ is ``(1 + |μ|)/(1 − |μ|)``, so R₁ equals MIPS,
    measured in the reference triangles. For the surface's angles, use those of the rest mesh. Unlike MIPS, R₁ is finite
    and smooth for every map.

    Parameters
    ----------
    share : (f,) float64
        Weights sⱼ; for the mean over the surface, each triangle's share of the surface's area.
    """

    def __init__(self, share: FloatArray) -> None:
        self.share = share

    def value(self, field: TensorField) -> float:
        """Return R₁ of a tensor field, the mean over the rest area; dimensionless."""
        square = field.mu.real**2 + field.mu.imag**2
        return 4.0 * float(np.sum(self.share * square / field.defect))

    def of_map(self, dw: Derivatives) -> float:
        """Return R₁ at a map's own tensors, where V₃ vanishes: its MIPS energy, ``inf`` if a triangle is inverted."""
        p, q = np.abs(dw.p), np.abs(dw.q)
        if not np.all(q < p):
            return np.inf
        return 4.0 * float(np.sum(self.share * q * q / ((p - q) * (p + q))))

    def gradient(self, field: TensorField) -> ComplexArray:
        """Return the gradient of R₁ in ξ (f,), ``∂R₁/∂Re ξ + i ∂R₁/∂Im ξ``."""
        return field.pull(8.0 * (self.share / field.defect**2) * field.mu)
