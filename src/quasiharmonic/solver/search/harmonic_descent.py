"""Rounds that lower a quasi-harmonised energy; see `quasiharmonic.solver.field.harmonised`.

::

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

from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.field.harmonised import Harmonised
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods import LBFGS, LocalRepair, Newton, VectorAdam
from quasiharmonic.solver.methods.base import Steps
from quasiharmonic.util.arrays import FloatArray


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
