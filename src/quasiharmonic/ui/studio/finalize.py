"""Compute the final map after a drag: solve from scratch, then smooth.

The command does the same, so the map can be reproduced.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.energies.smoothing import LARGEST, STEPS, smoothed
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import diagnose
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.search.solving import solve

#: Time limit in seconds for a search from scratch if an injective map from the drag exists.
PATIENCE = 10.0


class Settled(NamedTuple):
    """Final map.

    Attributes
    ----------
    result : MapResult
    anew : bool
        Whether it was solved from scratch, as the command does; otherwise it comes from the previous map.
    """

    result: MapResult
    anew: bool


def settle(
    problem: Problem,
    before: MapResult | None = None,
    *,
    energy: str | None = None,
    slide: bool | BoundaryCurves = False,
    callback: Callable[[Step], object] | None = None,
) -> Settled:
    """Compute the map of a problem, and lower its worst distortion.

    Parameters
    ----------
    problem : Problem
    before : MapResult, optional
        An injective map of the same problem; used if the search from scratch fails.
    energy : str, optional
        Lower this energy until it converges; by default a few steps of ``"blend"``.
    slide : bool or BoundaryCurves
        As for `solve`, with ``energy``.
    callback : callable, optional
        Called with every `Step`; may raise `KeyboardInterrupt`.

    Returns
    -------
    Settled
        Its result has a diagnosis if no bijective map was found.
    """
    until = time.monotonic() + PATIENCE

    def hurry(step: Step) -> None:
        if callback is not None:
            callback(step)
        if before is not None and energy is None and time.monotonic() > until:
            raise KeyboardInterrupt

    result = solve(problem, polish=energy, slide=slide, callback=hurry)
    if result.status is Status.INJECTIVE and energy is None:
        result = smoothed(problem, result, callback=callback)
    anew = result.injective
    if not anew and before is not None:
        result = before
        if len(problem.F) <= LARGEST:
            further = polish_map(problem.domain, before.uv, energy="blend", max_iterations=STEPS, callback=callback)
            result = replace(further, status=before.status)
    if not result.certificate.bijective and result.diagnosis is None and result.status is not Status.INTERRUPTED:
        result = replace(result, diagnosis=diagnose(problem))
    return Settled(result, anew)
