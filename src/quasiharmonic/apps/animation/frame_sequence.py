"""Compute a sequence of maps for a sequence of targets.

targets ──▶ each frame from the previous map ──▶ no map: report why, or bridge ──▶ smooth polishing ──▶ certify
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from numbers import Real

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
from quasiharmonic.util.arrays import FloatArray, check_bool, check_callback, check_integer
from quasiharmonic.util.options import MAX_ITERATIONS
from quasiharmonic.util.progress import reports_progress

# Default maximum vertex displacement, relative to the maximum boundary displacement.
_LIMIT = 3.0


@reports_progress
def animate(
    problem: Problem,
    targets: Iterable[ArrayLike],
    *,
    polish: str | Energy | None = None,
    max_motion_ratio: float | None = None,
    fill_gaps: bool = False,
    start: ArrayLike | None = None,
    max_iterations: int = MAX_ITERATIONS,
    linear_solver: str = "auto",
    callback: Callable[[FrameStep], object] | None = None,
) -> Animation:
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
    energy = None if polish is None else find_energy(polish)
    check_problem("animate", problem)
    if max_motion_ratio is not None and (not isinstance(max_motion_ratio, Real) or not max_motion_ratio >= 1):
        raise ValueError(
            f"max_motion_ratio must be a number of at least 1, not {max_motion_ratio!r}: "
            "the boundary itself has ratio 1"
        )
    if max_motion_ratio is not None and energy is None:
        raise ValueError("max_motion_ratio applies only to polished frames: give an energy as well")
    check_integer("max_iterations", max_iterations, minimum=1)
    check_bool("fill_gaps", fill_gaps)
    check_callback(callback)
    positions = check_targets(targets, len(problem.fixed))
    following = FrameSearch(problem, positions, max_iterations, linear_solver, callback)
    frames = following.run(start)
    asked, bridged = positions[: len(frames)], np.zeros(len(frames), dtype=bool)
    if fill_gaps and not following.work.interrupted:
        asked, bridged = following.fill_gaps()
    energies = np.full(len(frames), np.nan)
    if energy is not None:
        max_motion_ratio = _LIMIT if max_motion_ratio is None else float(max_motion_ratio)
        if not following.work.interrupted:
            smoothing = MotionSmoothing(problem.domain, energy, max_motion_ratio, linear_solver)
            energies = _smooth_frames(smoothing, following, asked, callback)
    return Animation(frames, asked, bridged, energies, max_motion_ratio, following.work.interrupted)


def _smooth_frames(
    smoothing: MotionSmoothing,
    following: FrameSearch,
    targets: FloatArray,
    callback: Callable[[FrameStep], object] | None,
) -> FloatArray:
    """Lower the distortion of the frames that have a map, in place; return mean energies (t,), NaN for other frames."""
    run = Run()
    frames = following.frames
    # Consecutive frames with the same target share one map.
    of = np.full(len(frames), -1)
    which: list[int] = []

    def report(sweep: int, t: int) -> None:
        if callback is not None:
            callback(FrameStep(which[t], len(frames), sweep, smoothing.largest_move()))

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
