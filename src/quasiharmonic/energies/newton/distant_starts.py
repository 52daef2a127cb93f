"""Symmetric Dirichlet from distant starts: reweighted rigid proxies, and progressive references.

On a collapsed triangle, ``σ ≪ 1``, the energy is ``σ⁻²`` and Newton's step increases σ only to 4/3 σ. The *proxy*
``k/2 (σ − 1)²`` has the same first derivative with ``k = φ'(σ)/(σ − 1)``. Its minimum is at the triangle's rest size,
and a step goes as far in its direction as other triangles allow [1]_. Newton's method lowers the energy by a factor of
two or three per step, the proxies by a factor of a hundred. Near the minimum the proxies ignore the resistance to
shear, so Newton's second derivatives are better.

Where sizes span many orders of magnitude, as along a limb shrunk by a disk map, the smallest triangles would end the
step before others move. So each triangle aims at a limited multiple of its size. The proxy is ``k/2 (σ − σ*)²`` with
``σ*`` between ``σ/aim`` and ``aim · σ``, and the whole limb grows at once.

Where a map has shrunk a limb to ``σ = 1e-8``, the contribution of other triangles to the energy ``σ⁻² = 1e16`` is lost
in rounding. So distortion is measured against *references* [2]_ instead of the rest shapes. A triangle whose map is
``U diag(σ₁, σ₂) Vᵀ`` gets the reference ``V diag(σ₁, σ₂)^(1 − t) Vᵀ``. Against this its singular values are
``σ₁ᵗ, σ₂ᵗ``. One t is chosen for all triangles, so that every triangle is within `REACH` of its reference. Then one
step on the proxies of this energy brings the whole limb there. t grows from step to step; at t = 1 the references are
the rest shapes.

::

    map ──▶ largest |log σ| ──▶ t ──▶ references ──▶ one step ──▶ less than half the energy? ──▶ next
                                                                         no: Newton's steps ◀──┘ yes

Triangles are weighted by rest area, as in the energy, with a slightly higher weight if they are far from rest.

Polishing uses references, and flattening the proxies alone, because neither is better in both: 16 contracted disks with
fixed boundary take 17 steps with references and 38 with proxies (medians), but 20 distant maps with free boundary take
5.2 CPU seconds with references and 3.1 with proxies.

References
----------
.. [1] M. Rabinovich, R. Poranne, D. Panozzo, O. Sorkine-Hornung, Scalable locally injective mappings. ACM Transactions
   on Graphics 36 (2017).
.. [2] L. Liu, C. Ye, R. Ni, X.-M. Fu, Progressive parameterizations. ACM Transactions on Graphics 37 (2018).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, QuadraticForm, SymmetricDirichlet, inverse
from quasiharmonic.energies.newton.map_model import MapModel
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.geometry.mesh.reference import blocks
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray
from quasiharmonic.util.kernels import compiled

# Bounds of the aim, in multiples of a triangle's size.
_MIN_AIM, _MAX_AIM = 5.0, 1000.0


class ReweightedDirichlet(SymmetricDirichlet):
    """Values and first derivatives of `SymmetricDirichlet`, second derivatives of its rigid proxies.

    ``aim`` > 1 is the maximum factor by which singular values should grow or shrink towards 1.
    """

    def __init__(self, aim: float = _MAX_AIM) -> None:
        self.aim = aim

    @classmethod
    def at(cls, mean: float) -> ReweightedDirichlet:
        """Return the energy whose aim is ``√mean``, that of a triangle with the mean energy, within bounds."""
        return cls(min(max(mean**0.5, _MIN_AIM), _MAX_AIM))

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


#: Singular values against the references are between this and its inverse.
REACH = 30.0
# Weights of triangles are multiplied by this power of one plus their density.
_POWER = 0.25
# The descent towards rest continues while each step leaves less than this share of the energy.
_WORTHWHILE = 0.5


def _singular_values(d: Deformation) -> tuple[FloatArray, FloatArray]:
    """Larger and smaller singular value of every triangle; (f,) float64 each."""
    larger = np.abs(d.p) + np.abs(d.q)
    return larger, d.det / larger


def reference_energy(energy: DeformationEnergy, at: Deformation) -> DeformationEnergy | None:
    """Return the energy against references within reach of a map, or None if rest itself is within reach.

    The references are between rest and the map, for one step from that map. The second derivatives are those of the
    reweighted proxies.
    """
    larger, smaller = _singular_values(at)
    farthest = max(float(np.log(larger.max())), -float(np.log(smaller.min())))
    # None also if the distance is not finite in double precision.
    if not np.log(REACH) < farthest < np.inf:
        return None
    # The exponent of the singular values at the map.
    t = np.log(REACH) / farthest
    a, b = larger ** (1 - t), smaller ** (1 - t)
    # The reference is the image of z under s z + c z̄, and is stretched in the same direction as the map.
    s, c = 0.5 * (a + b), 0.5 * (a - b) * at.q * at.p.conj() * inverse(np.abs(at.p) * np.abs(at.q))
    share = energy.share * (1 + energy.energy.density(at)) ** _POWER
    return energy.with_references(ReweightedDirichlet(np.inf), s, c, a * b, share)


def descend(descent: NewtonDescent, model: MapModel, steps: int, tol: float) -> Iterator[Status | None]:
    """Descend like `NewtonDescent.descend`, at first with progressive references if the energy is symmetric Dirichlet.

    The energy decreases at every step.
    """
    taken = 0
    if isinstance(model.energy, DeformationEnergy) and type(model.energy.energy) is SymmetricDirichlet:
        while taken < steps:
            before = descent.value
            with np.errstate(all="ignore"):
                decreased = _step_towards_rest(descent, model, model.energy)
            if not decreased:
                break
            taken += 1
            yield None
            if descent.value > _WORTHWHILE * before:
                break
    yield from descent.descend(steps - taken, tol)


def _step_towards_rest(descent: NewtonDescent, model: MapModel, energy: DeformationEnergy) -> bool:
    """Take one step towards references.

    Return False, with the map unchanged, if rest is within reach or the energy does not decrease.
    """
    start = descent.state
    reference = reference_energy(energy, start.derivatives)
    if reference is None:
        return False
    end = start
    try:
        reference_model = model.with_energy(reference)
        descent.restart(reference_model, reference_model.evaluate(start.w))
        descent.step(0.0)
        there = model.evaluate(descent.w)
        if there.value < start.value:
            end = there
    finally:
        # Restore the map even if the user interrupts the step.
        model.system.take_gradients(energy.g)
        descent.restart(model, end)
    return end is not start
