"""The worst distortion taken off a map by a few steps, where that is cheap: what is done unasked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from quasiharmonic.energies.polishing import polished
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.mesh.shapes import rest_shapes
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status, Step

# On some 10,000 triangles these steps take a few times as long as the first map, and go nearly as far as convergence: a
# fifth of the MIPS energy, a hundredth of the worst stretch. On larger meshes they are felt.
STEPS, LARGEST = 20, 100_000


def smoothed(
    problem: Problem,
    result: MapResult,
    *,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | BoundaryCurves = False,
) -> MapResult:
    """Lower the distortion of an injective map a little, if it is of moderate size.

    Parameters
    ----------
    problem : Problem
    result : MapResult
        An injective map of it.
    linear_solver, callback, slide
        As of `quasiharmonic.polish`. Maps whose boundary slides are smoothed whatever their size, or it would not have
        slid.

    Returns
    -------
    MapResult
        The map itself where it is too large, or a triangle has no area at rest.
    """
    if (len(problem.F) > LARGEST and slide is False) or rest_shapes(problem.V, problem.F).flat.size:
        return result
    smoother = polished(
        problem,
        result,
        energy="blend",
        max_iterations=STEPS,
        linear_solver=linear_solver,
        callback=callback,
        slide=slide,
    )
    # Nobody asked for convergence, so it is not missed.
    interrupted = smoother.status is Status.INTERRUPTED
    return smoother if interrupted else replace(smoother, status=Status.INJECTIVE)
