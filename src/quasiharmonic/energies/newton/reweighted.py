"""Symmetric Dirichlet with the second derivatives of reweighted rigid proxies, for maps far from their best.

Where a triangle has collapsed to ``σ ≪ 1`` the energy is ``σ⁻²``, and Newton's step takes it to 4/3 σ. The proxy
``k/2 (σ − 1)²`` with the energy's own slope, ``k = φ'(σ)/(σ − 1)``, has its minimum where the triangle is as large as
at rest, and a step goes as far in its direction as other triangles allow [1]_: a map that Newton's method brings down
by a factor of two or three a step falls by a factor of a hundred. Near the minimum the proxies forget how triangles
resist shear, and Newton's own second derivatives are better.

Where sizes span many orders of magnitude, as along a limb that a disk has shrunk to nothing, the smallest triangles
would be far ahead of all others: they end the step before anything else has moved. So no triangle aims at more than
so many times its own size: the proxy is ``k/2 (σ − σ*)²`` with ``σ*`` between ``σ/aim`` and ``aim · σ``, and all of the
limb grows at once.

References
----------
.. [1] M. Rabinovich, R. Poranne, D. Panozzo, O. Sorkine-Hornung, Scalable locally injective mappings. ACM Transactions
   on Graphics 36 (2017).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.energies import Deformation, QuadraticForm, SymmetricDirichlet, inverse
from quasiharmonic.geometry.mesh.reference import blocks
from quasiharmonic.util.arrays import ComplexArray, FloatArray
from quasiharmonic.util.kernels import compiled

#: How far a triangle aims at least and at most, in multiples of its size.
NEAREST, FARTHEST = 5.0, 1000.0


class ReweightedDirichlet(SymmetricDirichlet):
    """Values and first derivatives of `SymmetricDirichlet`, second derivatives of its rigid proxies.

    Parameters
    ----------
    aim : float
        Singular values are to become at most so many times as large or as small, and 1 where that is nearer; above 1.
    """

    def __init__(self, aim: float = FARTHEST) -> None:
        self.aim = aim

    @classmethod
    def at(cls, mean: float) -> ReweightedDirichlet:
        """For a map of this mean energy: it aims as far as an average triangle has to go, ``σ⁻² = mean``."""
        return cls(min(max(mean**0.5, NEAREST), FARTHEST))

    def curvature(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """That of ``½ Σ kᵢ ‖uᵢᵀ (J − σᵢ* R)‖²`` with left singular vectors uᵢ, goals σᵢ* and rotation R held.

        ``negative`` plays no part: the form is positive definite.
        """
        both, mixed, none = np.empty(d.det.size), np.empty_like(d.p), np.zeros_like(d.p)
        rigid_proxies(d.p, d.q, d.det, self.aim, both, mixed)
        return QuadraticForm(pp=both, qq=both, p2=none, q2=none, pq=mixed, pqc=none)


@compiled
def rigid_proxies(
    p: ComplexArray, q: ComplexArray, det: FloatArray, aim: float, both: FloatArray, mixed: ComplexArray
) -> None:
    """Fill in ``k₁ + k₂`` and ``2 (k₁ − k₂)`` times the conjugate of p q over its absolute value, (f,)."""
    for part in blocks(det.size):
        size_p, size_q = np.abs(p[part]), np.abs(q[part])
        larger = size_p + size_q
        k1, k2 = _factor(larger, aim), _factor(det[part] / larger, aim)
        # Twice the angle of u₁ is that of p q; a triangle that is not sheared has no u₁, and k₁ = k₂.
        both[part] = k1 + k2
        mixed[part] = 2 * (k1 - k2) * (p[part] * q[part]).conj() * inverse(size_p) * inverse(size_q)


def _factor(sigma: FloatArray, aim: float) -> FloatArray:
    """``(2σ − 2σ⁻³)/(σ − σ*)``, positive at ``σ = σ* = 1`` too."""
    rigid = 2 * (sigma + 1) * (sigma**2 + 1) / sigma**3
    # Of σ − 1 and σ − σ* the first is the longer way where σ* is held back.
    held = np.where(sigma < 1, (aim - 1) * sigma, (1 - 1 / aim) * sigma)
    return rigid * np.maximum(1, np.abs(sigma - 1) / held)
