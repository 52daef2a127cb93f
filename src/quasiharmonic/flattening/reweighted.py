"""Symmetric Dirichlet with the second derivatives of reweighted rigid proxies, for maps far from their best.

Where a triangle has collapsed to ``σ ≪ 1`` the energy is ``σ⁻²``, and Newton's step takes it to 4/3 σ. The proxy
``k/2 (σ − 1)²`` with the energy's own slope, ``k = φ'(σ)/(σ − 1)``, has its minimum where the triangle is as large as
at rest, and a step goes as far in its direction as other triangles allow [1]_: a map that Newton's method brings down
by a factor of two or three a step falls by a factor of a hundred. Near the minimum the proxies forget how triangles
resist shear, and Newton's own second derivatives are better.

References
----------
.. [1] M. Rabinovich, R. Poranne, D. Panozzo, O. Sorkine-Hornung, Scalable locally injective mappings. ACM Transactions
   on Graphics 36 (2017).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import FloatArray
from quasiharmonic.energy.energies import Deformation, QuadraticForm, SymmetricDirichlet, inverse


class ReweightedDirichlet(SymmetricDirichlet):
    """Values and first derivatives of `SymmetricDirichlet`, second derivatives of its rigid proxies."""

    def curvature(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """That of ``½ Σ kᵢ ‖uᵢᵀ (J − R)‖²`` with the left singular vectors uᵢ and the rotation R held.

        ``negative`` plays no part: the form is positive definite.
        """
        size_p, size_q = np.abs(d.p), np.abs(d.q)
        larger = size_p + size_q
        k1, k2 = _factor(larger), _factor(d.det / larger)
        # Twice the angle of u₁ is that of p q; a triangle that is not sheared has no u₁, and k₁ = k₂.
        turn = (d.p * d.q).conj() * inverse(size_p) * inverse(size_q)
        none = np.zeros(turn.shape, dtype=np.complex128)
        return QuadraticForm(pp=k1 + k2, qq=k1 + k2, p2=none, q2=none, pq=2 * (k1 - k2) * turn, pqc=none)


def _factor(sigma: FloatArray) -> FloatArray:
    """``(2σ − 2σ⁻³)/(σ − 1)``."""
    return 2 * (sigma + 1) * (sigma**2 + 1) / sigma**3
