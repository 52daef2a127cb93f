"""Symmetric Dirichlet with the second derivatives of reweighted rigid proxies, for maps far from the minimum.

On a collapsed triangle, ``σ ≪ 1``, the energy is ``σ⁻²`` and Newton's step increases σ only to 4/3 σ. The proxy
``k/2 (σ − 1)²`` has the same first derivative with ``k = φ'(σ)/(σ − 1)``. Its minimum is at the triangle's rest size,
and a step goes as far in its direction as other triangles allow [1]_. Newton's method lowers the energy by a factor of
two or three per step, the proxies by a factor of a hundred. Near the minimum the proxies ignore the resistance to
shear, so Newton's second derivatives are better.

Where sizes span many orders of magnitude, as along a limb shrunk by a disk map, the smallest triangles would end the
step before others move. So each triangle aims at a limited multiple of its size. The proxy is ``k/2 (σ − σ*)²`` with
``σ*`` between ``σ/aim`` and ``aim · σ``, and the whole limb grows at once.

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

#: Lower bound of the aim, in multiples of a triangle's size.
MIN_AIM = 5.0
#: Upper bound of the aim, in multiples of a triangle's size.
MAX_AIM = 1000.0


class ReweightedDirichlet(SymmetricDirichlet):
    """Values and first derivatives of `SymmetricDirichlet`, second derivatives of its rigid proxies.

    ``aim`` > 1 is the maximum factor by which singular values should grow or shrink towards 1.
    """

    def __init__(self, aim: float = MAX_AIM) -> None:
        self.aim = aim

    @classmethod
    def at(cls, mean: float) -> ReweightedDirichlet:
        """Return the energy whose aim is ``√mean``, that of a triangle with the mean energy, within bounds."""
        return cls(min(max(mean**0.5, MIN_AIM), MAX_AIM))

    def curvature(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivative of ``½ Σ kᵢ ‖uᵢᵀ (J − σᵢ* R)‖²`` with constant uᵢ, σᵢ* and R.

        Here uᵢ are the left singular vectors, σᵢ* the goals and R the rotation. The form is positive definite, so
        ``negative`` is ignored.
        """
        both, mixed, none = np.empty(d.det.size), np.empty_like(d.p), np.zeros_like(d.p)
        rigid_proxies(d.p, d.q, d.det, self.aim, both, mixed)
        return QuadraticForm(pp=both, qq=both, p2=none, q2=none, pq=mixed, pqc=none)


@compiled
def rigid_proxies(
    p: ComplexArray, q: ComplexArray, det: FloatArray, aim: float, both: FloatArray, mixed: ComplexArray
) -> None:
    """Fill ``both`` with ``k₁ + k₂`` and ``mixed`` with ``2 (k₁ − k₂)`` times the conjugate of p q / |p q|, (f,)."""
    for part in blocks(det.size):
        size_p, size_q = np.abs(p[part]), np.abs(q[part])
        larger = size_p + size_q
        k1, k2 = _factor(larger, aim), _factor(det[part] / larger, aim)
        # The angle of u₁ is half that of p q. A triangle without shear has no u₁, but then k₁ = k₂.
        both[part] = k1 + k2
        mixed[part] = 2 * (k1 - k2) * (p[part] * q[part]).conj() * inverse(size_p) * inverse(size_q)


def _factor(sigma: FloatArray, aim: float) -> FloatArray:
    """``(2σ − 2σ⁻³)/(σ − σ*)``, positive at ``σ = σ* = 1`` too."""
    rigid = 2 * (sigma + 1) * (sigma**2 + 1) / sigma**3
    # |σ − 1| exceeds |σ − σ*| where the aim limits σ*.
    limit = np.where(sigma < 1, (aim - 1) * sigma, (1 - 1 / aim) * sigma)
    return rigid * np.maximum(1, np.abs(sigma - 1) / limit)
