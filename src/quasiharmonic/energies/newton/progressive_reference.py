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

Polishing uses references, and flattening the proxies alone, because neither is better in both: 16 contracted disks with
fixed boundary take 17 steps with references and 38 with proxies (medians), but 20 distant maps with free boundary take
5.2 CPU seconds with references and 3.1 with proxies.

References
----------
.. [1] L. Liu, C. Ye, R. Ni, X.-M. Fu, Progressive parameterizations. ACM Transactions on Graphics 37 (2018).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, SymmetricDirichlet, inverse
from quasiharmonic.energies.newton.map_model import MapModel
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.reweighted import ReweightedDirichlet
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import FloatArray

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
