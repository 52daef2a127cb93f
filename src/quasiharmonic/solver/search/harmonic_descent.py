"""Quasi-harmonised energies (§11): any distortion energy, kept within the injective maps by V₃; and their descent.

``Q(ξ) = V₃(ξ)/|Ω| + η (E(w(ξ)) + κ R₁(ξ))`` for the quasi-harmonic map w of the tensors of ξ. The first term is zero
exactly if that map is injective, so E may be finite for inverted triangles. Every injective map is the map of some
tensors (Theorem 6.4), so the descent over ξ can reach every injective map.

The paper's Q is this Q times the target's area |Ω|, and the paper scales the target to the surface's area. In this
implementation all three terms are dimensionless, η has the same meaning, and no map is scaled.

R₁ is a *regulariser*, a function of the tensor field that is added to an injectivity functional (§11.1.4).

The descent has rounds::

    map ──▶ ξ of its own tensors ──▶ VectorAdam, a few steps ──▶ L-BFGS in units learnt from it ──▶ map
     ▲                                                                                              │
     └───────────────────────────────── next round with the next η ─────────────────────────────────┤
                                                                                                    ▼
                              the injective map of least energy found ◀── last inverted triangles untangled by V₃

A large η moves far and leaves a few triangles inverted where the energy favours that; a smaller η untangles them. Each
round begins at the map's own tensors, where V₃ vanishes if the map is injective. The descent therefore converges to a
minimum of E among the injective maps and not to a compromise with V₃.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.reference import Derivatives, ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.problem import Problem
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.field.functionals import Functional, QuasiHarmonicMap, twist
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.solver.methods import LBFGS, LocalRepair, Newton, VectorAdam
from quasiharmonic.solver.methods.base import Steps
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


class HarmonicDescentTuning(NamedTuple):
    """Numbers that tune the rounds of `HarmonicDescent`."""

    # Fraction of a round's evaluations for VectorAdam.
    probing: float = 0.4
    # Its step length, halved when a step leaves the energy's domain.
    length: float = 0.1
    # Decay rate of its mean squares.
    memory: float = 0.9
    # Smallest stiffness of a triangle, as a fraction of the mean stiffness.
    softest: float = 1e-3


_TUNING = HarmonicDescentTuning()

# Newton steps, and local repairs, for the last inverted triangles.
UNTANGLING_STEPS = 40


class HarmonicDescent:
    """The current map, the best map so far, and the rounds that improve them.

    Two things pass from one round to the next: the last iterate, where the next round starts, and the mean squares of
    each triangle's gradient, which tell its stiffness.

    Parameters
    ----------
    objective : Objective
        V₃ of the problem in the tanh parameterisation, with fixed vertices at their positions in ``uv``.
    energy : callable
        Function from η to the functional of a round.
    uv : (n, 2) float64
        Initial map.
    run : Run
        Records every map and every round. The caller records the initial map, whose state is ``best``.

    Attributes
    ----------
    uv : (n, 2) float64
        The map with the fewest inverted triangles so far, and among those of least distortion.
    best : (int, float)
        Its number of inverted triangles and its ``E + κR₁``.
    """

    def __init__(
        self,
        objective: Objective,
        energy: Callable[[float], Harmonised],
        uv: FloatArray,
        run: Run,
    ) -> None:
        self.uv = uv
        self._objective, self._energy = objective, energy
        self._problem, self._run = objective.problem, run
        self._measure = energy(1.0)
        self._squares = np.zeros(len(self._problem.F))
        self.return_to_best()
        inverted = inverted_triangles(self._problem.F, uv).size
        distortion = self._measure.distortion if inverted else self._measure.distortion_of_map
        self.best = inverted, distortion(self._last)

    def return_to_best(self) -> None:
        """Return to the best map."""
        self._last = self._objective.of_map(self._problem.frame.inward(self.uv))

    def run(self, name: str, eta: float, iterations: int, tol: float) -> bool:
        """Run one round; return whether it converged."""
        objective = self._objective.with_functional(self._energy(eta))
        with self._stage(name):
            start = self._restart(objective)
            self._measure.check_numbers(start)
            if not np.isfinite(start.value):
                return False
            lowest, left = self._probe(objective, start, iterations)
            if not self._squares.any():
                return True
            if not np.isfinite(self._squares).all():
                return False  # non-finite gradients give no units for L-BFGS
            stiffness = np.sqrt(self._squares)
            stiffness += _TUNING.softest * stiffness.mean()
            self._last = lowest
            if left < 1:
                return False
            method = LBFGS(iterations=left, stiffness=stiffness, tol=tol)
            steps = Steps(method.iterates(objective, lowest))
            for at in steps:
                self._visit(at)
            return steps.converged
        return False

    def untangle(self) -> bool:
        """Untangle the last inverted triangles by descending V₃ alone; return whether none is left."""
        if self._run.history[-1].inverted == 0:
            return True
        for method in (Newton(iterations=UNTANGLING_STEPS), LocalRepair(tries=UNTANGLING_STEPS)):
            with self._stage(f"{method.label}, tanh"):
                self._last = self._objective.evaluate(self._last.xi)
                for at in method.iterates(self._objective, self._last):
                    self._visit(at)
                    if self._run.history[-1].inverted == 0:
                        return True
        return False

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Record a stage. It ends silently, as if its block were left, if the Laplacian is not positive definite."""
        run, done, best = self._run, len(self._run.history), self.best
        try:
            yield
        except NotPositiveDefinite:
            pass
        finally:
            first, last = run.history[done - 1], run.history[-1]
            run.add_stage(
                name,
                n_iterations=len(run.history) - done,
                inverted=(first.inverted, last.inverted),
                energy=(first.energy, last.energy),
                kept=self.best < best,
            )

    def _restart(self, objective: Objective) -> Iterate:
        """Evaluate the current map at its own tensors, or at its present ones if those have no factorisation."""
        try:
            return objective.near_map(self._last.w)
        except NotPositiveDefinite:
            return objective.evaluate(self._last.xi)

    def _probe(self, objective: Objective, start: Iterate, iterations: int) -> tuple[Iterate, int]:
        """Learn each triangle's stiffness by VectorAdam, which moves all triangles by steps of similar length.

        Return the lowest iterate and the number of evaluations left.
        """
        lowest = here = start
        count = left = int(np.ceil(_TUNING.probing * iterations))
        length = _TUNING.length
        while left > 0:
            for at in VectorAdam(iterations=left, schedule=((0, length),)).iterates(objective, here):
                left -= 1
                if not np.isfinite(at.value):
                    length *= 0.5
                    break
                gradient = at.gradient
                self._squares *= _TUNING.memory
                self._squares += (1 - _TUNING.memory) * (gradient.real**2 + gradient.imag**2)
                here = at
                self._visit(at)
                if at.value < lowest.value:
                    lowest = at
        return lowest, iterations - count

    def _visit(self, at: Iterate) -> None:
        """Record a map and update the best one."""
        self._last = at
        inverted, distortion = at.inverted, self._measure.distortion(at)
        if inverted == 0:
            # Check the returned coordinates, not those of the solver.
            uv = self._problem.positions(at.w)
            inverted = inverted_triangles(self._problem.F, uv).size
            self._compare((inverted, self._measure.distortion_of_map(at)), uv)
        elif inverted <= self.best[0]:
            self._compare((inverted, distortion), self._problem.positions(at.w))
        self._run.record(inverted, distortion)

    def _compare(self, state: tuple[int, float], uv: FloatArray) -> None:
        if state < self.best:
            self.best, self.uv = state, uv
