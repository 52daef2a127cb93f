"""Rounds of descent of a quasi-harmonised energy (§11).

    map ──▶ ξ of its own tensors ──▶ VectorAdam, a few steps ──▶ L-BFGS in the units it has learnt ──▶ map
     ▲                                                                                               │
     └───────────────────────────────── next round, η as the schedule has it ────────────────────────┤
                                                                                                     ▼
                                        the injective map of least energy on the way ◀── last flips righted by V₃

A large η moves far and leaves a few triangles inverted where the energy wants them so; a smaller one rights them. Each
round begins at the map's own tensors, at which V₃ vanishes if the map is injective: what V₃ has come to cost is waived,
and the descent converges to a minimum of E among the injective maps and not to a compromise with V₃.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.certificate import flipped_triangles
from quasiharmonic.functionals import Dirichlet
from quasiharmonic.harmonised import Harmonised
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.mesh.reference import Derivatives
from quasiharmonic.objective import Iterate, Objective
from quasiharmonic.optimize import Stop
from quasiharmonic.optimize.alternating import own_tensor
from quasiharmonic.optimize.newton import newton
from quasiharmonic.optimize.patches import patches
from quasiharmonic.optimize.scaled_lbfgs import scaled_lbfgs
from quasiharmonic.optimize.vector_adam import vector_adam
from quasiharmonic.result import Stage, Status, Step
from quasiharmonic.tensor import TANH

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Of a round's evaluations, this part goes to VectorAdam; the length of its steps, halved where they leave the energy's
# domain; and how much of its mean squares a gradient leaves.
_PROBING, _LENGTH, _MEMORY = 0.4, 0.1, 0.9
# Of the mean stiffness that VectorAdam has learnt, the least that a triangle is given.
_SOFTEST = 1e-3
# Newton steps and local repairs for the last flips.
RIGHTING = 40


def own_xi(dw: Derivatives) -> ComplexArray:
    """The ξ of a map's own tensors, at which V₃ is least with the map held; (f,) complex128."""
    return TANH.invert(own_tensor(dw))


class _Lost(Exception):  # noqa: N818 - a signal, not an error
    """VectorAdam has stepped to where the objective is infinite."""


class HarmonicDescent:
    """The map at hand, the best on the way, and how to get to the next.

    Parameters
    ----------
    objective : Objective
        Of the problem with its fixed vertices where ``uv`` has them, in the tanh parameterisation.
    q : Harmonised
        What is descended; its η is that of the round.
    uv : (n, 2) float64
        The map to begin with.
    callback : callable or None
        Called with a `Step` at every map.

    Attributes
    ----------
    uv : (n, 2) float64
        The map of fewest inversions so far, of least distortion among those.
    best : (int, float)
        Its inverted triangles, and ``E + κR₁``.
    history : list of Step
    stages : list of Stage
    """

    def __init__(
        self, objective: Objective, q: Harmonised, uv: FloatArray, callback: Callable[[Step], object] | None
    ) -> None:
        self.objective, self.q, self.uv = objective, q, uv
        self._problem, self._callback = objective.problem, callback
        self.history: list[Step] = []
        self.stages: list[Stage] = []
        self._squares = np.zeros(len(self._problem.F))
        self.back()
        flipped = flipped_triangles(self._problem.F, uv).size
        self.best = flipped, q.distortion(self._last) if flipped else q.distortion_of_map(self._last)
        self._report(self.best)

    def back(self) -> None:
        """Go back to the best map."""
        w = self._problem.frame.inward(self.uv)
        self._last = Iterate(self.objective, TANH.field(own_xi(self.objective.mesh.derivatives(w))), w)

    def run(self, name: str, eta: float, iterations: int, tolerance: float) -> bool:
        """One round; whether it came to rest."""
        self.q.eta, self.objective.functional = eta, self.q
        with self._stage(name):
            start = self._restart()
            if not np.isfinite(start.value):
                return False
            lowest, left = self._probe(start, iterations)
            if not self._squares.any():
                return True
            if not np.isfinite(self._squares).all():
                return False  # gradients that leave the numbers' range give no units to go on in
            stiffness = np.sqrt(self._squares)
            stiffness += _SOFTEST * stiffness.mean()
            self._last = self.objective.evaluate(lowest.xi)
            return scaled_lbfgs(
                self.objective, self._last, self._visit, iterations=left, stiffness=stiffness, tolerance=tolerance
            )
        return False

    def right(self) -> bool:
        """Right the last inverted triangles by descending V₃ alone, close to where the rounds have ended.

        Whether there are none in the end.
        """
        if self.history[-1].flipped == 0:
            return True
        self.objective.functional = Dirichlet(self._problem, self.objective.mesh, self.objective.laplacian)
        for name, method in (("newton", newton), ("patches", patches)):
            try:
                with self._stage(f"{name}, tanh"):
                    self._last = self.objective.evaluate(self._last.xi)
                    method(self.objective, self._last, self._visit_to_right, iterations=RIGHTING)
            except Stop as stop:
                if stop.status is Status.INJECTIVE:
                    return True
        return False

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Write down what runs; where rounding leaves no Laplacian, it is over."""
        began, done, best = time.perf_counter(), len(self.history), self.best
        try:
            yield
        except NotPositiveDefinite:
            pass
        finally:
            first, last = self.history[done - 1], self.history[-1]
            self.stages.append(
                Stage(
                    name=name,
                    iterations=len(self.history) - done,
                    seconds=time.perf_counter() - began,
                    flipped=(first.flipped, last.flipped),
                    energy=(first.energy, last.energy),
                    kept=self.best < best,
                )
            )

    def _restart(self) -> Iterate:
        """The map at hand by its own tensors, or as it is where these have no factorisation."""
        try:
            return self.objective.evaluate(self.objective.bounded(own_xi(self._last.dw)))
        except NotPositiveDefinite:
            return self.objective.evaluate(self._last.xi)

    def _probe(self, start: Iterate, iterations: int) -> tuple[Iterate, int]:
        """Learn each triangle's stiffness by VectorAdam, which moves all of them at one pace.

        Returns the lowest iterate and the evaluations left.
        """
        lowest = here = start
        count = left = int(np.ceil(_PROBING * iterations))
        length = _LENGTH

        def learn(at: Iterate) -> None:
            nonlocal lowest, here, left
            left -= 1
            if not np.isfinite(at.value):
                raise _Lost
            gradient = at.gradient
            self._squares *= _MEMORY
            self._squares += (1 - _MEMORY) * (gradient.real**2 + gradient.imag**2)
            here = at
            self._visit(at)
            if at.value < lowest.value:
                lowest = at

        while left > 0:
            try:
                vector_adam(self.objective, here, learn, iterations=left, schedule=((0, length),))
            except _Lost:
                here = self.objective.evaluate(here.xi)
                length *= 0.5
        return lowest, iterations - count

    def _visit(self, at: Iterate) -> None:
        """Take note of a map."""
        self._last = at
        flipped, distortion = at.flipped, self.q.distortion(at)
        if flipped == 0:
            # Decided on the coordinates that are handed back, not on the solver's own.
            uv = self._problem.positions(at.w)
            flipped = flipped_triangles(self._problem.F, uv).size
            self._compare((flipped, self.q.distortion_of_map(at)), uv)
        elif flipped <= self.best[0]:
            self._compare((flipped, distortion), self._problem.positions(at.w))
        self._report((flipped, distortion))

    def _compare(self, state: tuple[int, float], uv: FloatArray) -> None:
        if state < self.best:
            self.best, self.uv = state, uv

    def _visit_to_right(self, at: Iterate) -> None:
        """Take note of a map, and stop at an injective one."""
        self._visit(at)
        if self.history[-1].flipped == 0:
            raise Stop(Status.INJECTIVE)

    def _report(self, state: tuple[int, float]) -> None:
        self.history.append(Step(len(self.history), *state))
        if self._callback is not None:
            self._callback(self.history[-1])
