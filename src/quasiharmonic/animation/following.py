"""Frames, each searched for from the map of the one before, and what becomes of those that have none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.animation.frames import FrameStep, farthest
from quasiharmonic.arrays import BoolArray, FloatArray
from quasiharmonic.problem import Problem
from quasiharmonic.result import MapResult, Status
from quasiharmonic.search.solving import solve

# Iterations that a frame near to the last hardly ever needs: if they do not do, it is asked first whether any could.
_SOON = 6


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
                frame = self.found(target, last)
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

    def found(self, target: FloatArray, start: ArrayLike | None) -> MapResult:
        """The map for a target, beginning with another.

        Raises
        ------
        KeyboardInterrupt
            When the search is interrupted.
        """
        problem = self._problem.moved(target)
        if start is not None:
            soon = self._solve(problem, start, min(_SOON, self._max_iterations))
            forbidden = soon.diagnosis is not None and soon.diagnosis.forbids_injective
            if soon.injective:
                return soon
            if forbidden:
                return replace(soon, status=Status.IMPOSSIBLE)
        return self._solve(problem, start, self._max_iterations)

    def _solve(self, problem: Problem, start: ArrayLike | None, iterations: int) -> MapResult:
        result = solve(problem, start=start, max_iterations=iterations, linear_solver=self._linear_solver)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return result

    def bridge(self) -> tuple[FloatArray, BoolArray]:
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
                frame = self.found(between, self.frames[near].uv)
                if frame.injective:
                    self.frames[t], targets[t], bridged[t] = frame, between, True
        except KeyboardInterrupt:
            self.interrupted = True
        return targets, bridged
