"""Progressive references: minimise symmetric Dirichlet from a distant start through intermediate rest shapes.

Where a map has shrunk a limb to ``σ = 1e-8``, the energy is ``σ⁻² = 1e16`` and the contribution of other triangles is
lost in rounding. A Newton step increases σ only to 4/3 σ. So distortion is measured against *references* [1]_ instead
of the rest shapes. A triangle whose map is ``U diag(σ₁, σ₂) Vᵀ`` gets the reference ``V diag(σ₁, σ₂)^(1 − t) Vᵀ``.
Against this its singular values are ``σ₁ᵗ, σ₂ᵗ``. One t is chosen for all triangles, so that every triangle is within
`REACH` of its reference. Then a whole limb grows at once, and one step on the reweighted proxies of this energy
(`quasiharmonic.energies.newton.reweighted`) brings it there. t grows from step to step; at t = 1 the references are the
rest shapes.

::

    map ──▶ largest |log σ| ──▶ t ──▶ references ──▶ one step ──▶ less than half the energy? ──▶ next
                                                                         no: Newton's steps ◀──┘ yes

Triangles are weighted by rest area, as in the energy, with a slightly higher weight if they are far from rest.

References
----------
.. [1] L. Liu, C. Ye, R. Ni, X.-M. Fu, Progressive parameterizations. ACM Transactions on Graphics 37 (2018).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, QuadraticForm, SymmetricDirichlet, inverse
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.reweighted import ReweightedDirichlet
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray

#: Singular values against the references are between this and its inverse.
REACH = 30.0
# Weights of triangles are multiplied by this power of one plus their density.
_POWER = 0.25
# The approach continues while each step leaves less than this share of the energy.
_WORTH = 0.5


class RelativeDirichlet(DeformationEnergy):
    """Symmetric Dirichlet energy against references between rest and a map, for one step from that map.

    Parameters
    ----------
    energy : DeformationEnergy
        Against rest; its density is `SymmetricDirichlet`.
    at : Deformation
        Deformation of the map, from ``energy``.
    share : float
        t, in (0, 1): the exponent of the singular values at the map.
    """

    def __init__(self, energy: DeformationEnergy, at: Deformation, share: float) -> None:
        self.energy, self.F, self._least_places = energy.energy, energy.F, energy._least_places
        a, b = (sigma ** (1 - share) for sigma in _singular_values(at))
        det = a * b
        # The reference is the image of z under s z + c z̄, and is stretched in the same direction as the map.
        s, c = 0.5 * (a + b), 0.5 * (a - b) * at.q * at.p.conj() * inverse(np.abs(at.p) * np.abs(at.q))
        self.g: ComplexArray = (s * energy.g - c * energy.g.conj()) / det
        self.share: FloatArray = energy.share * (1 + energy.energy.density(at)) ** _POWER
        self._det_per_area = energy._det_per_area / det
        self._proxies = ReweightedDirichlet(np.inf)

    def curvature_of(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives of the proxies, which are positive definite; ``negative`` is ignored."""
        return self._proxies.curvature(d).scaled(self.share)


def _singular_values(d: Deformation) -> tuple[FloatArray, FloatArray]:
    """Larger and smaller singular value of every triangle; (f,) float64 each."""
    larger = np.abs(d.p) + np.abs(d.q)
    return larger, d.det / larger


def relative(energy: DeformationEnergy, at: Deformation) -> RelativeDirichlet | None:
    """Return the energy against references within reach of a map, or None if rest itself is within reach."""
    larger, smaller = _singular_values(at)
    farthest = max(float(np.log(larger.max())), -float(np.log(smaller.min())))
    # None also if the distance is not finite in double precision.
    return RelativeDirichlet(energy, at, np.log(REACH) / farthest) if np.log(REACH) < farthest < np.inf else None


def descend(descent: NewtonDescent, steps: int, tolerance: float) -> Iterator[Status | None]:
    """Descend like `NewtonDescent.descend`, after a progressive approach for symmetric Dirichlet from distant maps.

    Parameters
    ----------
    descent : NewtonDescent
        Without sliding boundary vertices; these have no approach.
    steps, tolerance
        As in `NewtonDescent.descend`.

    Yields
    ------
    Status or None
        After every step; a status ends the descent. The energy also decreases at every step of the approach.
    """
    taken = 0
    energy = descent.energy
    if isinstance(energy, DeformationEnergy) and type(energy.energy) is SymmetricDirichlet:
        while taken < steps:
            before = descent.value
            with np.errstate(all="ignore"):
                closer = _approached(descent, energy)
            if not closer:
                break
            taken += 1
            yield None
            if descent.value > _WORTH * before:
                break
    yield from descent.descend(steps - taken, tolerance)


def _approached(descent: NewtonDescent, energy: DeformationEnergy) -> bool:
    """Take one step towards references.

    Return False, with the map unchanged, if rest is within reach or the energy does not decrease.
    """
    start, value = descent.w, descent.value
    towards = relative(energy, energy.deform(start))
    if towards is None:
        return False
    closer = False
    try:
        descent.lower(towards)
        descent.step(0.0)
        closer = energy.value(descent.w) < value
    finally:
        # Restore the map even if the user interrupts the step.
        if not closer:
            descent.w = start
        descent.lower(energy)
    return closer
