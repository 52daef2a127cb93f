"""Compute a sequence of maps for a sequence of targets.

targets ──▶ each frame from the previous map ──▶ no map: report why, or bridge ──▶ smooth polishing ──▶ certify
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.animation.frame_search import FrameSearch
from quasiharmonic.apps.animation.frames import Animation, FrameStep, check_targets
from quasiharmonic.apps.animation.motion_smoothing import MotionSmoothing
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.problem.result import Status
from quasiharmonic.problem.run import Run
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.options import AnimationOptions, takes
from quasiharmonic.util.progress import reports_progress

# Default maximum vertex displacement, relative to the maximum boundary displacement.
_LIMIT = 3.0


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
        default 3. The limit may not be reached; the result has the value that was.
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
    energy = None if checked.polish is None else find_energy(checked.polish)
    check_problem("animate", problem)
    limit = checked.max_motion_ratio
    if limit is not None and energy is None:
        raise ValueError("max_motion_ratio applies only to polished frames: give an energy as well")
    positions = check_targets(targets, len(problem.fixed))
    following = FrameSearch(problem, positions, checked)
    frames = following.run()
    asked, bridged = positions[: len(frames)], np.zeros(len(frames), dtype=bool)
    if checked.fill_gaps and not following.work.interrupted:
        asked, bridged = following.fill_gaps()
    energies = np.full(len(frames), np.nan)
    if energy is not None:
        limit = _LIMIT if limit is None else float(limit)
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
