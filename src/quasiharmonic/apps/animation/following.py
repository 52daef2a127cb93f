"""Frames, each searched for from the map of the one before, and what becomes of those that have none.

A search that goes far finds a map far from the last one: vertices leap though the boundary has hardly moved. So each
frame is first tried by a few short steps of the tensors from those of the last map, then by way of boundaries halfway
to it, and only then by whatever finds a map (`quasiharmonic.solve`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.animation.frames import FrameStep, farthest
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.util.arrays import BoolArray, FloatArray

# Iterations that a frame near to the last hardly ever needs: if they do not do, it is asked first whether any could.
_SOON = 6
# How long steps are, a fifth of those with which a search begins: where these do not do, short ones lead less far away.
_SHORT = ((0, 0.1),)
# How often the way from the last boundary to the next is halved.
_HALVINGS = 3


class Following:
    """Frames, each from the map of the last that has one.

    Parameters
    ----------
    problem : Problem
    targets : (t, k, 2) float64
    max_iterations, linear_solver, callback
        As of `animate`.

    Attributes
    ----------
    frames : list of MapResult
        As far as they are found.
    interrupted : bool
        Whether that has ended early.
    """

    def __init__(
        self,
        problem: Problem,
        targets: FloatArray,
        max_iterations: int,
        linear_solver: str,
        callback: Callable[[FrameStep], object] | None,
    ) -> None:
        self._problem, self._targets = problem, targets
        self._max_iterations, self._linear_solver, self._callback = max_iterations, linear_solver, callback
        self.frames: list[MapResult] = []
        self.interrupted = False

    def follow(self, start: ArrayLike | None) -> list[MapResult]:
        """Find every frame's map, as far as there is one."""
        last = start
        move = 0.0
        before: int | None = None
        try:
            for t, target in enumerate(self._targets):
                if before is not None and np.array_equal(target, self._targets[before]):
                    self.frames.append(self.frames[before])
                    continue
                frame = self.found(target, last, None if before is None else self._targets[before])
                self.frames.append(frame)
                if frame.injective:
                    if before is not None:
                        boundary = farthest(target - self._targets[before])
                        move = max(move, farthest(frame.uv - self.frames[before].uv) / boundary)
                    before, last = t, frame.uv
                if self._callback is not None:
                    self._callback(FrameStep(t, len(self._targets), 0, move))
        except KeyboardInterrupt:
            self.interrupted = True
        return self.frames

    def found(self, target: FloatArray, start: ArrayLike | None, last: FloatArray | None = None) -> MapResult:
        """The map for a target.

        Parameters
        ----------
        target : (k, 2) float64
        start : (n, 2) array, optional
            A map to begin with.
        last : (k, 2) float64, optional
            The target whose map, an injective one, ``start`` is.

        Raises
        ------
        KeyboardInterrupt
            When the search is interrupted.
        """
        problem = self._problem.with_target(target)
        if start is not None:
            near = self._nearby(problem, start)
            if near.injective:
                return near
            if near.diagnosis is not None and near.diagnosis.forbids_injective:
                return replace(near, status=Status.IMPOSSIBLE)
            by_halves = None if last is None else self._by_halves(target, start, last, _HALVINGS)
            if by_halves is not None:
                return by_halves
        return self._solve(problem, start, self._max_iterations)

    def _by_halves(self, target: FloatArray, start: ArrayLike, last: FloatArray, times: int) -> MapResult | None:
        """The map for a target by way of that for the boundary halfway from the last, if short steps find both."""
        if times == 0:
            return None
        between = target / 2 + last / 2
        here = self._nearby(self._problem.with_target(between), start)
        middle = here if here.injective else self._by_halves(between, start, last, times - 1)
        if middle is None:
            return None
        end = self._nearby(self._problem.with_target(target), middle.uv)
        return end if end.injective else self._by_halves(target, middle.uv, between, times - 1)

    def _nearby(self, problem: Problem, start: ArrayLike) -> MapResult:
        """What a few short steps from a map come to."""
        few = min(_SOON, self._max_iterations)
        # As in any search, pins want si-log.
        parameterisation = "si-log" if problem.domain.pins.size else "tanh"
        short = VectorAdam(parameterisation=parameterisation, schedule=_SHORT, iterations=few)
        return self._solve(problem, start, few, [short])

    def _solve(
        self, problem: Problem, start: ArrayLike | None, iterations: int, strategy: str | Stages = "speed"
    ) -> MapResult:
        result = solve(
            problem, strategy=strategy, start=start, max_iterations=iterations, linear_solver=self._linear_solver
        )
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return result

    def fill_gaps(self) -> tuple[FloatArray, BoolArray]:
        """Give frames without a map a target between those around them; the targets, and which have changed."""
        targets = self._targets.copy()
        found = np.array([frame.injective for frame in self.frames])
        bridged = np.zeros(len(found), dtype=bool)
        have = np.flatnonzero(found)
        try:
            for t in np.flatnonzero(~found).tolist():
                after = int(np.searchsorted(have, t))
                if not 0 < after < have.size:
                    continue
                first, last = have[after - 1], have[after]
                share = (t - first) / (last - first)
                between = (1 - share) * self._targets[first] + share * self._targets[last]
                near = t - 1 if self.frames[t - 1].injective else first
                frame = self.found(between, self.frames[near].uv, targets[near])
                if frame.injective:
                    self.frames[t], targets[t], bridged[t] = frame, between, True
        except KeyboardInterrupt:
            self.interrupted = True
        return targets, bridged
