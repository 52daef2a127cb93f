"""Search for the map of each frame, starting from the previous frame's map, and fill gaps.

A long search finds a map far from the previous one, and vertices jump although the boundary hardly moves. Each frame is
therefore first tried with a few short steps from the tensors of the previous map. If that fails, intermediate
boundaries are tried, and only then a general search (`quasiharmonic.solve`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.animation.frames import FrameStep, find_longest
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.mapping import solve
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.util.arrays import BoolArray, FloatArray
from quasiharmonic.util.options import AnimationOptions

# Maximum number of short steps. A frame close to the previous one hardly ever needs more; if they fail, a diagnosis
# follows.
_SOON = 6
# Step length, a fifth of the usual first steps: if these fail, short ones lead less far away.
_SHORT_STEPS = ((0, 0.1),)
# Maximum number of halvings of the way from the last boundary to the next.
_HALVINGS = 3


class FrameSearch:
    """Search for the frames in order, each from the last injective map.

    ``frames`` are the results so far. ``work`` says whether Ctrl-C ended the work early.
    """

    def __init__(self, problem: Problem, targets: FloatArray, options: AnimationOptions) -> None:
        self._problem, self._targets, self._options = problem, targets, options
        self.frames: list[MapResult] = []
        self.work = Run()

    def run(self) -> list[MapResult]:
        """Search for the map of every frame and return the results."""
        last = self._options.start
        move = 0.0
        before: int | None = None
        with self.work.until_interrupted():
            for t, target in enumerate(self._targets):
                if before is not None and np.array_equal(target, self._targets[before]):
                    self.frames.append(self.frames[before])
                    continue
                frame = self.search(target, last, None if before is None else self._targets[before])
                self.frames.append(frame)
                if frame.injective:
                    if before is not None:
                        boundary = find_longest(target - self._targets[before])
                        move = max(move, find_longest(frame.uv - self.frames[before].uv) / boundary)
                    before, last = t, frame.uv
                self.report(t, 0, move)
        return self.frames

    def report(self, frame: int, sweep: int, move: float) -> None:
        """Pass a `FrameStep` to the callback."""
        if self._options.callback is not None:
            self._options.callback(FrameStep(frame, len(self._targets), sweep, move))

    def search(self, target: FloatArray, start: ArrayLike | None, last: FloatArray | None = None) -> MapResult:
        """Search for the map of a target (k, 2), from an initial map.

        ``last`` (k, 2) is the target of ``start`` if that is an injective map. Ctrl-C raises KeyboardInterrupt.
        """
        problem = self._problem.with_target(target)
        if start is not None:
            near = self._search_nearby(problem, start)
            if near.injective:
                return near
            if near.diagnosis is not None and near.diagnosis.forbids_injective:
                return replace(near, status=Status.IMPOSSIBLE)
            by_halves = None if last is None else self._search_by_halves(target, start, last, _HALVINGS)
            if by_halves is not None:
                return by_halves
        return self._solve(problem, start, self._options.max_iterations)

    def _search_by_halves(self, target: FloatArray, start: ArrayLike, last: FloatArray, times: int) -> MapResult | None:
        """Search for the map of a target via the boundary halfway from the last, by short steps; None if that fails."""
        if times == 0:
            return None
        between = target / 2 + last / 2
        here = self._search_nearby(self._problem.with_target(between), start)
        middle = here if here.injective else self._search_by_halves(between, start, last, times - 1)
        if middle is None:
            return None
        end = self._search_nearby(self._problem.with_target(target), middle.uv)
        return end if end.injective else self._search_by_halves(target, middle.uv, between, times - 1)

    def _search_nearby(self, problem: Problem, start: ArrayLike) -> MapResult:
        """Return the result of a few short steps from a map."""
        few = min(_SOON, self._options.max_iterations)
        # As in the default strategy, pins need si-log.
        parameterisation = "si-log" if problem.domain.pins.size else "tanh"
        short = VectorAdam(parameterisation=parameterisation, schedule=_SHORT_STEPS, iterations=few)
        return self._solve(problem, start, few, [short])

    def _solve(
        self, problem: Problem, start: ArrayLike | None, iterations: int, strategy: str | Stages = "speed"
    ) -> MapResult:
        solver = self._options.linear_solver
        result = solve(problem, strategy=strategy, start=start, max_iterations=iterations, linear_solver=solver)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return result

    def fill_gaps(self) -> tuple[FloatArray, BoolArray]:
        """Interpolate the targets of frames without a map; return the targets and which have changed."""
        targets = self._targets.copy()
        found = np.array([frame.injective for frame in self.frames])
        bridged = np.zeros(len(found), dtype=bool)
        have = np.flatnonzero(found)
        with self.work.until_interrupted():
            for t in np.flatnonzero(~found).tolist():
                after = int(np.searchsorted(have, t))
                if not 0 < after < have.size:
                    continue
                first, last = have[after - 1], have[after]
                share = (t - first) / (last - first)
                between = (1 - share) * self._targets[first] + share * self._targets[last]
                near = t - 1 if self.frames[t - 1].injective else first
                frame = self.search(between, self.frames[near].uv, targets[near])
                if frame.injective:
                    self.frames[t], targets[t], bridged[t] = frame, between, True
        return targets, bridged
