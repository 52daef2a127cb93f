"""Steps from afar: down the symmetric Dirichlet energy by way of references between rest and the map.

Where a map has shrunk a limb to ``σ = 1e-8`` the energy is ``σ⁻² = 1e16``, and of what other triangles want nothing is
left in it. Newton's step takes σ to 4/3 σ. So distortion is not measured against rest but against *references* [1]_.
A triangle whose map is ``U diag(σ₁, σ₂) Vᵀ`` gets the reference ``V diag(σ₁, σ₂)^(1 − t) Vᵀ``, and against that its
singular values are ``σ₁ᵗ, σ₂ᵗ``. With one t for all triangles none of them is further than `REACH` from its reference,
all of a limb wants to grow by its part of the way, and a step down the reweighted proxies of this energy
(`quasiharmonic.energies.newton.reweighted`) brings it there: t grows from step to step, and with t = 1 the references
are at rest.

::

    map ──▶ largest |log σ| ──▶ t ──▶ references ──▶ one step ──▶ less than half the energy? ──▶ next
                                                                         no: Newton's steps ◀──┘ yes

In the sum triangles count by their area at rest, as in the energy, and those that are far a little more.

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
# Triangles count by this power of one plus their density.
_POWER = 0.25
# The approach goes on as long as each step leaves less than this share of the energy.
_WORTH = 0.5


class RelativeDirichlet(DeformationEnergy):
    """Symmetric Dirichlet against references between rest and a map, for one step from that map.

    Parameters
    ----------
    energy : DeformationEnergy
        Against rest; its density is `SymmetricDirichlet`.
    at : Deformation
        Of the map, by that energy.
    share : float
        t, in (0, 1): the singular values at the map become their powers with this exponent.
    """

    def __init__(self, energy: DeformationEnergy, at: Deformation, share: float) -> None:
        self.energy, self.F, self._least_places = energy.energy, energy.F, energy._least_places
        a, b = (sigma ** (1 - share) for sigma in _singular_values(at))
        det = a * b
        # The reference is the image of z by s z + c z̄, and stretches where the map does.
        s, c = 0.5 * (a + b), 0.5 * (a - b) * at.q * at.p.conj() * inverse(np.abs(at.p) * np.abs(at.q))
        self.g: ComplexArray = (s * energy.g - c * energy.g.conj()) / det
        self.share: FloatArray = energy.share * (1 + energy.energy.density(at)) ** _POWER
        self._det_per_area = energy._det_per_area / det
        self._proxies = ReweightedDirichlet(np.inf)

    def curvature_of(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives of the proxies, which are positive definite; ``negative`` plays no part."""
        return self._proxies.curvature(d).scaled(self.share)


def _singular_values(d: Deformation) -> tuple[FloatArray, FloatArray]:
    """The larger and the smaller one on every triangle; (f,) float64 each."""
    larger = np.abs(d.p) + np.abs(d.q)
    return larger, d.det / larger


def relative(energy: DeformationEnergy, at: Deformation) -> RelativeDirichlet | None:
    """The energy against references within reach of a map; None where rest itself is."""
    larger, smaller = _singular_values(at)
    farthest = max(float(np.log(larger.max())), -float(np.log(smaller.min())))
    # Also where doubles do not tell how far it is.
    return RelativeDirichlet(energy, at, np.log(REACH) / farthest) if np.log(REACH) < farthest < np.inf else None


def descend(descent: NewtonDescent, steps: int, tolerance: float) -> Iterator[Status | None]:
    """As `NewtonDescent.descend`, beginning with an approach where the energy is symmetric Dirichlet and the map far.

    Parameters
    ----------
    descent : NewtonDescent
        Whose vertices move as they will: with boundaries that slide there is no approach.
    steps, tolerance
        As of `NewtonDescent.descend`.

    Yields
    ------
    Status or None
        After every step; a status after the last that there is. The energy falls at every step of the approach too.
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
    """Take one step towards references; False, the map as it was, where rest is near or the energy does not fall."""
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
        # Also when the user has interrupted the step.
        if not closer:
            descent.w = start
        descent.lower(energy)
    return closer
