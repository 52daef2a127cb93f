"""Compute the final map after a drag: solve from scratch, then smooth.

The command does the same, so the map can be reproduced.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from quasiharmonic.energies.polishing import LARGEST_SMOOTHED, SMOOTHING_STEPS, PolishOptions, polish_map, smooth
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import diagnose
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.mapping import solve

#: Time limit in seconds for a search from scratch if an injective map from the drag exists.
PATIENCE = 10.0


class FinalMap(NamedTuple):
    """Final map."""

    result: MapResult
    anew: bool  # Whether it was solved from scratch, as the command does; otherwise it comes from the previous map


def compute_final_map(
    problem: Problem,
    before: MapResult | None = None,
    *,
    energy: str | None = None,
    slide: bool | BoundaryCurves = False,
    callback: Callable[[Step], object] | None = None,
) -> FinalMap:
    """Compute the map of a problem, and lower its worst distortion.

    ``before`` is an injective map of the same problem; it is used if the search from scratch fails. ``energy`` is
    lowered until it converges; by default a few steps of ``"blend"`` run. ``slide`` is as for `solve`, with ``energy``.
    The callback may raise KeyboardInterrupt. The result has a diagnosis if no bijective map was found.
    """
    until = time.monotonic() + PATIENCE

    def interrupt_late(step: Step) -> None:
        if callback is not None:
            callback(step)
        if before is not None and energy is None and time.monotonic() > until:
            raise KeyboardInterrupt

    result = solve(problem, polish=energy, slide=slide, callback=interrupt_late)
    if result.status is Status.INJECTIVE and energy is None:
        result = smooth(problem, result, callback=callback)
    anew = result.injective
    if not anew and before is not None:
        result = before
        if len(problem.F) <= LARGEST_SMOOTHED:
            further = polish_map(
                problem.domain,
                before.uv,
                PolishOptions(energy="blend", max_iterations=SMOOTHING_STEPS, callback=callback),
            )
            result = replace(further, status=before.status)
    if not result.certificate.bijective and result.diagnosis is None and result.status is not Status.INTERRUPTED:
        result = replace(result, diagnosis=diagnose(problem))
    return FinalMap(result, anew)
