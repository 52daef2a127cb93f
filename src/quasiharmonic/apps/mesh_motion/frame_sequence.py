"""Compute a sequence of maps for a sequence of targets.

targets ──▶ each frame from the previous map ──▶ no map: report why, or bridge ──▶ smooth polishing ──▶ certify

A long search finds a map far from the previous one, and vertices jump although the boundary hardly moves. Each frame is
therefore first tried with a few short steps from the tensors of the previous map. If that fails, intermediate
boundaries are tried, and only then a general search (`quasiharmonic.solve`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.mesh_motion.animation import Animation, FrameStep, check_targets, find_longest
from quasiharmonic.apps.mesh_motion.motion_smoothing import MotionSmoothing
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.mapping import solve
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.util.arrays import BoolArray, FloatArray
from quasiharmonic.util.options import AnimationOptions, takes
from quasiharmonic.util.progress import reports_progress


class FrameTuning(NamedTuple):
    """Numbers that tune the search for the map of a frame."""

    # Maximum number of short steps. A frame close to the previous one hardly ever needs more; if they fail, a diagnosis
    # follows.
    max_short_steps: int = 6
    # Step length, a fifth of the usual first steps: if these fail, short ones lead less far away.
    short_steps: tuple[tuple[int, float], ...] = ((0, 0.1),)
    # Default maximum vertex displacement, relative to the maximum boundary displacement.
    limit: float = 3.0


_TUNING = FrameTuning()


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
                    self.report(t, 0, move)
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
            by_halves = None if last is None else self._search_by_halves(target, start, last, times=3)
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
        few = min(_TUNING.max_short_steps, self._options.max_iterations)
        # As in the default strategy, pins need si-log.
        parameterisation = "si-log" if problem.domain.pins.size else "tanh"
        short = VectorAdam(parameterisation=parameterisation, schedule=_TUNING.short_steps, iterations=few)
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


class AnimationKeywords(TypedDict, total=False):
    """Types of the options of `animate`."""

    polish: str | Energy | None
    max_motion_ratio: float | None
    fill_gaps: bool
    start: ArrayLike | None
    max_iterations: int
    linear_solver: str
    callback: Callable[[FrameStep], object] | None


@reports_progress
@takes(AnimationOptions, AnimationKeywords)
def animate(problem: Problem, targets: Iterable[ArrayLike], **options: Unpack[AnimationKeywords]) -> Animation:
    """Map a surface to a sequence of targets; each map is certified and close to the previous one.

    Parameters
    ----------
    problem : Problem
        The surface and its fixed vertices; its own target is not used.
    targets : iterable of (k, 2) array
        Target positions of the fixed vertices, frame by frame.
    polish : str or Energy, optional
        Distortion energy to lower in every frame, without jumps between local minima; see `quasiharmonic.polish`.
    max_motion_ratio : float, optional
        Requires ``polish``. Maximum vertex displacement, relative to the maximum boundary displacement; at least 1,
        default 3. `Animation.largest_move` is the value that was reached, which may be larger.
    fill_gaps : bool
        If a target has no map, or none is found, interpolate its target between the neighbouring frames with a map.
        Frames at the ends stay without a map.
    start : (n, 2) array, optional
        Initial map for the first frame.
    max_iterations : int
        Maximum number of linear solves per frame, if the short steps from the previous map fail.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `FrameStep` for every frame, and with the last one again at least every half second in between,
        but not within a single factorisation.

    Returns
    -------
    Animation
        After Ctrl-C: the frames so far, polished or not.

    Raises
    ------
    TypeError
        If ``problem`` is not a `Problem` or ``targets`` is not iterable.
    ValueError
        If a target has another size or a non-finite value (the message names the frame), an option is invalid, or
        ``max_motion_ratio`` is given without ``polish``.

    See Also
    --------
    injective_map : One target.
    injective_maps : Targets that do not depend on each other.
    MovingMesh : Small steps of a simulation mesh.

    Examples
    --------
    Deform a disk into a star:

    >>> import numpy as np
    >>> from quasiharmonic import Problem, animate
    >>> from quasiharmonic.geometry.mesh.topology import boundary_loops
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(8)
    >>> (loop,) = boundary_loops(F, len(V))
    >>> angle = np.arctan2(*V[loop].T)
    >>> targets = [V[loop] * (1 - bump * np.cos(2.5 * angle) ** 2)[:, None] for bump in np.linspace(0, 0.6, 7)]
    >>> animation = animate(Problem(V, F, loop, V[loop]), targets, polish="symmetric-dirichlet")
    >>> bool(animation.found.all()), animation.largest_move <= 3
    (True, True)
    """
    checked = AnimationOptions(**options)
    energy = None if checked.polish is None else find_energy(checked.polish, "polish")
    check_problem("animate", problem)
    limit = checked.max_motion_ratio
    if limit is not None and energy is None:
        raise ValueError("max_motion_ratio applies only to polished frames: give an energy as well, by polish")
    positions = check_targets(targets, len(problem.fixed))
    following = FrameSearch(problem, positions, checked)
    frames = following.run()
    asked, bridged = positions[: len(frames)], np.zeros(len(frames), dtype=bool)
    if checked.fill_gaps and not following.work.interrupted:
        asked, bridged = following.fill_gaps()
    energies = np.full(len(frames), np.nan)
    if energy is not None:
        limit = _TUNING.limit if limit is None else float(limit)
        if not following.work.interrupted:
            smoothing = MotionSmoothing(problem.domain, energy, limit, checked.linear_solver)
            energies = _smooth_frames(smoothing, following, asked)
    return Animation(frames, asked, bridged, energies, limit, following.work.interrupted)


def _smooth_frames(smoothing: MotionSmoothing, following: FrameSearch, targets: FloatArray) -> FloatArray:
    """Lower the distortion of the frames that have a map, in place; return mean energies (t,), NaN for other frames."""
    run = Run()
    frames = following.frames
    # Consecutive frames with the same target share one map.
    of = np.full(len(frames), -1)
    which: list[int] = []

    def report(sweep: int, t: int) -> None:
        following.report(which[t], sweep, smoothing.largest_move())

    with following.work.until_interrupted():
        for t in range(len(frames)):
            if not frames[t].injective:
                continue
            if not which or not np.array_equal(targets[t], targets[which[-1]]):
                # The previous map has been polished since this frame was searched, so search again from the polished
                # map.
                uv = frames[t].uv
                if which:
                    near = following.search(targets[t], smoothing.maps[-1], targets[which[-1]])
                    uv = near.uv if near.injective else uv
                smoothing.append(uv)
                which.append(t)
                report(0, len(which) - 1)
            of[t] = len(which) - 1
        smoothing.sweep(report)
    status = Status.INTERRUPTED if following.work.interrupted else Status.NEARBY
    energies = np.full(len(frames), np.nan)
    seconds = run.seconds / max(len(which), 1)
    with following.work.until_interrupted():
        for t in np.flatnonzero(of >= 0).tolist():
            uv = smoothing.maps[of[t]]
            certificate = certify(smoothing.domain.F, uv, loops=smoothing.domain.loops)
            frames[t] = replace(
                frames[t], uv=uv, status=status, certificate=certificate, seconds=frames[t].seconds + seconds, mu=None
            )
            energies[t] = smoothing.energies[of[t]]
    return energies
