"""Regularisers: functions of the tensor field alone, descended along with an injectivity functional (§11.1.4)."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.reference import Derivatives
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray, FloatArray


class Conformal:
    """R₁, the MIPS energy that the tensors' own map would have (§11.1.4, eq. 35 to 37).

    ::

        R₁(ξ) = Σ sⱼ ℛ(μⱼ),   ℛ(μ) = (1 − |μ|)/(1 + |μ|) + (1 + |μ|)/(1 − |μ|) − 2 = 4 |μ|²/(1 − |μ|²)

    which is ``4 sinh²|ξ|`` for tanh. Where V₃ vanishes a triangle's σ₁/σ₂ is ``(1 + |μ|)/(1 − |μ|)``, so this is MIPS
    there, measured in the reference triangles: those of the rest mesh, if the surface's angles are meant. Elsewhere,
    and unlike MIPS itself, it is finite and smooth whatever the map does.

    Parameters
    ----------
    share : (f,) float64
        Factors sⱼ; for the mean over the surface, areas over the surface's area.
    """

    def __init__(self, share: FloatArray) -> None:
        self.share = share

    def value(self, field: TensorField) -> float:
        """R₁ of a tensor field.

        Parameters
        ----------
        field : TensorField

        Returns
        -------
        float
            The mean over the rest area, without unit.
        """
        square = field.mu.real**2 + field.mu.imag**2
        return 4.0 * float(np.sum(self.share * square / field.defect))

    def of_map(self, dw: Derivatives) -> float:
        """R₁ at the own tensors of a map, where V₃ vanishes: its MIPS energy.

        Parameters
        ----------
        dw : Derivatives
            Of the map.

        Returns
        -------
        float
            ``inf`` if a triangle is inverted.
        """
        p, q = np.abs(dw.p), np.abs(dw.q)
        if not np.all(q < p):
            return np.inf
        return 4.0 * float(np.sum(self.share * q * q / ((p - q) * (p + q))))

    def gradient(self, field: TensorField) -> ComplexArray:
        """Gradient of R₁ by ξ.

        Parameters
        ----------
        field : TensorField

        Returns
        -------
        (f,) complex128
            ``∂R₁/∂Re ξ + i ∂R₁/∂Im ξ``.
        """
        return field.pull(8.0 * (self.share / field.defect**2) * field.mu)
