"""A sequence of targets → a sequence of maps: the road.

targets ──▶ each frame from the map before it ──▶ none? told why, or bridged ──▶ lowered without leaps ──▶ certified
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.animation.following import Following
from quasiharmonic.apps.animation.frames import Animation, FrameStep, checked_targets
from quasiharmonic.apps.animation.smoothing import Smoothing
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import energy_named
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import FloatArray, check_callback, kind_of, true_or_false, whole_number
from quasiharmonic.util.progress import reports_progress

# How many times as far as the boundary vertices may move, unless the caller says so.
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
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[FrameStep], object] | None = None,
) -> Animation:
    """Map a surface to a sequence of targets, each frame certified and near to the one before.

    Parameters
    ----------
    problem : Problem
        The surface and its held vertices; its own target does not matter.
    targets : iterable of (k, 2) array
        Where these go, frame by frame.
    polish : str or Energy, optional
        Lower this distortion energy in every frame, as `quasiharmonic.polish` has it, without leaps from one local
        minimum to another.
    max_motion_ratio : float, optional
        For ``polish``: as many times as far as the boundary moves at most, a vertex may; 3 by default. 1 at the least,
        where no more is possible in general; the result says what was reached.
    fill_gaps : bool
        Where a target allows no map, or none is found, have the boundary halfway between the frames around it, or
        however many there are to go past. Frames at the ends stay without.
    start : (n, 2) array, optional
        A map to begin the first frame with.
    max_iterations : int
        Linear solves to spend at most on finding a frame's map, where the few from the map before it do not do.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `FrameStep` for every frame, and with the last one again at least every half second in between,
        but not within a single factorisation.

    Returns
    -------
    Animation
        Ctrl-C ends it with the frames so far, lowered or not.

    Raises
    ------
    TypeError
        When ``problem`` is no `Problem`, or there is no going through ``targets``.
    ValueError
        When a target has another size, or what is no finite number (the message names the frame), when an option has no
        such value, or ``max_motion_ratio`` is given and nothing to polish with.

    Examples
    --------
    A disk whose outline becomes a star:

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
    energy = None if polish is None else energy_named(polish)
    if not isinstance(problem, Problem):
        raise TypeError(f"animate takes a Problem, not {kind_of(problem)}")
    if max_motion_ratio is not None and (not isinstance(max_motion_ratio, Real) or not max_motion_ratio >= 1):
        raise ValueError(
            f"max_motion_ratio must be a number of at least 1, not {max_motion_ratio!r}: "
            "the boundary itself has ratio 1"
        )
    if max_motion_ratio is not None and energy is None:
        raise ValueError("max_motion_ratio applies only to polished frames: give an energy as well")
    whole_number("max_iterations", max_iterations, least=1)
    true_or_false("fill_gaps", fill_gaps)
    check_callback(callback)
    places = checked_targets(targets, len(problem.fixed))
    following = Following(problem, places, max_iterations, linear_solver, callback)
    frames = following.follow(start)
    asked, bridged = places[: len(frames)], np.zeros(len(frames), dtype=bool)
    if fill_gaps and not following.interrupted:
        asked, bridged = following.fill_gaps()
    interrupted = following.interrupted
    if energy is None:
        return Animation(frames, asked, bridged, np.full(len(frames), np.nan), interrupted=interrupted)
    max_motion_ratio = _LIMIT if max_motion_ratio is None else float(max_motion_ratio)
    energies = np.full(len(frames), np.nan)
    if not interrupted:
        smoothing = Smoothing(problem.domain, energy, max_motion_ratio, linear_solver)
        energies, interrupted = _smoothed(smoothing, following, asked, callback)
    return Animation(frames, asked, bridged, energies, max_motion_ratio, interrupted)


def _smoothed(
    smoothing: Smoothing, following: Following, targets: FloatArray, callback: Callable[[FrameStep], object] | None
) -> tuple[FloatArray, bool]:
    """Lower the distortion of the frames that have a map, in place.

    Returns
    -------
    energies : (t,) float64
        Their mean energies, NaN of the others.
    interrupted : bool
    """
    began = time.perf_counter()
    frames = following.frames
    # Frames with one target after another are one.
    of = np.full(len(frames), -1)
    which: list[int] = []

    def told(sweep: int, t: int) -> None:
        if callback is not None:
            callback(FrameStep(which[t], len(frames), sweep, smoothing.largest_move()))

    status = Status.NEARBY
    try:
        for t in range(len(frames)):
            if not frames[t].injective:
                continue
            if not which or not np.array_equal(targets[t], targets[which[-1]]):
                # The last map is another than when this frame was searched for, since it has been lowered.
                uv = frames[t].uv
                if which:
                    near = following.found(targets[t], smoothing.maps[-1], targets[which[-1]])
                    uv = near.uv if near.injective else uv
                smoothing.append(uv)
                which.append(t)
                told(0, len(which) - 1)
            of[t] = len(which) - 1
        smoothing.sweep(told)
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    energies = np.full(len(frames), np.nan)
    seconds = (time.perf_counter() - began) / max(len(which), 1)
    try:
        for t in np.flatnonzero(of >= 0).tolist():
            uv = smoothing.maps[of[t]]
            certificate = certify(smoothing.domain.F, uv, loops=smoothing.domain.loops)
            frames[t] = replace(
                frames[t], uv=uv, status=status, certificate=certificate, seconds=frames[t].seconds + seconds, mu=None
            )
            energies[t] = smoothing.energies[of[t]]
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    return energies, status is Status.INTERRUPTED
