"""Quasi-harmonised energies (§11): any distortion energy, kept within the injective maps by V₃.

``Q(ξ) = V₃(ξ)/|Ω| + η (E(w(ξ)) + κ R₁(ξ))`` for the quasi-harmonic map w of the tensors of ξ. The first term is zero
exactly if that map is injective, so E may be finite for inverted triangles. Every injective map is the map of some
tensors (Theorem 6.4), so the descent over ξ can reach every injective map.

The paper's Q is this Q times the target's area |Ω|, and the paper scales the target to the surface's area. In this
implementation all three terms are dimensionless, η has the same meaning, and no map is scaled.

R₁ is a *regulariser*, a function of the tensor field that is added to an injectivity functional (§11.1.4).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation
from quasiharmonic.geometry.mesh.reference import Derivatives, ReferenceMesh
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.functionals import Functional, QuasiHarmonicMap, twist
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


class Harmonised(Functional):
    """``V₃/|Ω| + η (E + κ R₁)``.

    The gradient of E passes through the solution of the Laplacian. With the adjoint ``L λ = ∂E/∂w`` (zero at fixed
    vertices), a change dA of the tensors changes E by ``−Re λᴴ dL w``. This takes one more solve with the existing
    factorisation.

    Parameters
    ----------
    problem : Problem
    mesh : ReferenceMesh
    area : float
        |Ω|, the area that the target encloses, in the problem's frame; positive.
    energy : DeformationEnergy or None
        E, for maps in the frame; None for zero.
    regulariser : Conformal
        R₁.
    eta, conformal : float
        η and κ.
    """

    name = "harmonised"

    def __init__(
        self,
        problem: Problem,
        mesh: ReferenceMesh,
        area: float,
        energy: DeformationEnergy | None,
        regulariser: Conformal,
        *,
        eta: float,
        conformal: float,
    ) -> None:
        super().__init__(problem, mesh)
        self.area = area
        self.energy = energy
        self.regulariser = regulariser
        self.eta = eta
        self.conformal = conformal
        self._cached: tuple[ComplexArray, Deformation] | None = None

    def value(self, at: QuasiHarmonicMap) -> float:
        return at.dirichlet / self.area + self.eta * self.distortion(at)

    def gradient(self, at: QuasiHarmonicMap) -> ComplexArray:
        gradient = at.dirichlet_gradient / self.area
        if self.energy is not None:
            pull = self.energy.gradient_of(self._deformation(self.energy, at), at.w.size)
            adjoint = self.mesh.derivatives(at.operator.respond(pull))
            by_mu = at.field.pull_twist(*twist(self.mesh, adjoint, at.dw))
            gradient = gradient - self.eta * at.field.pull(by_mu)
        return gradient + self.eta * self.conformal * self.regulariser.gradient(at.field)

    def distortion(self, at: QuasiHarmonicMap) -> float:
        """Return ``E + κ R₁``; ``inf`` if E is a barrier and a triangle is inverted."""
        return self._energy(at) + self.conformal * self.regulariser.value(at.field)

    def distortion_of_map(self, at: QuasiHarmonicMap) -> float:
        """Return ``E + κ R₁`` with R₁ at the map's own tensors; depends on the map alone.

        ``inf`` if a triangle is inverted.
        """
        return self._energy(at) + self.conformal * self.regulariser.of_map(at.dw)

    def check_numbers(self, at: QuasiHarmonicMap) -> None:
        """Raise a ValueError if E or its first derivative is NaN or infinite where stretch is not extreme."""
        if self.energy is not None:
            self.energy.check_numbers(self._deformation(self.energy, at), second=False)

    def _energy(self, at: QuasiHarmonicMap) -> float:
        return 0.0 if self.energy is None else self.energy.value_of(self._deformation(self.energy, at))

    def _deformation(self, energy: DeformationEnergy, at: QuasiHarmonicMap) -> Deformation:
        """The map's Jacobians, which value and gradient both need."""
        # Return a local variable, because another thread may overwrite the cache; see `Poisson.response`.
        cached = self._cached
        if cached is None or cached[0] is not at.w:
            cached = self._cached = at.w, energy.deform(at.w)
        return cached[1]
