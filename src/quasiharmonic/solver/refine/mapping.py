"""The one-shot call: from arrays to a map without inverted triangles, on a finer mesh if that is allowed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Step
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.util.arrays import true_or_false
from quasiharmonic.util.progress import reports_progress


@accepts_mesh
@reports_progress
def injective_map(
    V: ArrayLike,
    F: ArrayLike,
    fixed: ArrayLike,
    target: ArrayLike,
    *,
    reference: Reference | None = None,
    strategy: str | Stages = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record_every: int = 0,
    slide: bool | BoundaryCurves = False,
    refine: bool = False,
) -> MapResult:
    """Map a triangle mesh into the plane with no triangle inverted.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions of a planar or curved mesh, disk-like or with holes.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    fixed : (k,) array of int
        Vertices with given positions: the whole boundary and any pinned interior vertices.
    target : (k, 2) array
        Where they go.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (§9.3), whatever the strategy would choose.
    strategy : {"speed", "paper"} or sequence of Descent
        ``"speed"`` finds a map soonest; ``"paper"`` is the paper's own pipeline, si-log first; or stages of one's own.
    polish : str or Energy, optional
        Once injective, lower this distortion energy; see `quasiharmonic.polish` for the names.
    start : (n, 2) array, optional
        A map to begin with, for instance that of the same mesh for a target near this one: the search starts at
        its tensors, and afresh where that leads nowhere.
    max_iterations : int
        Iterations to spend at most on finding the map: one linear solve each on the whole mesh. RetrySchedule at
        repairing a small patch are counted where they succeed; those in vain may together take as long as 16 times so
        many.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between:
        while patches are tried, say, or a diagnosis is made, but not within a single factorisation. It may raise
        `KeyboardInterrupt`, on a clock of its own for instance, which ends the search as Ctrl-C does.
    record_every : int
        Keep the map of every ``record_every``-th iteration in the result's ``path``; none of them by default.
    slide : bool or BoundaryCurves
        While polishing let boundary vertices glide along their outline, its corners held; see `quasiharmonic.polish`.
        The boundary of ``target`` is put onto the curves first, if it is off them by a chord.
    refine : bool
        Where no map of the mesh as given is found, split inner edges, as few as need be: those that the diagnosis
        names; more around what stays inverted; or, for a connected surface without handles and a target whose loops
        are simple, disjoint, nested and wound as the mesh's, pins distinct and strictly inside, as many as a
        construction with a proof needs. Such a problem ends with a bijective map, with ``PRECISION_LIMIT``,
        or, where dozens of pins lie elsewhere than in the mesh, with ``TOO_MANY_SPLITS``.

    Returns
    -------
    MapResult
        With the certified map, or with the best map found and a status that says why it is not injective: of the
        maps met, the one with the fewest inverted triangles; where the diagnosis proves that none is injective,
        the one of least area. Failure to find a map is not an exception. Ctrl-C ends the search and returns the
        best map so far. Where edges were split, ``refined`` has the mesh that it is a map of: old vertices keep their
        numbers, new ones follow. ``refinement_attempts`` tells what was tried.

    Raises
    ------
    ValueError
        When the input is malformed; see `Problem`.

    Examples
    --------
    A square annulus whose hole is turned by a quarter:

    >>> import numpy as np
    >>> from quasiharmonic import injective_map
    >>> from quasiharmonic.surfaces import annulus
    >>> from quasiharmonic.geometry.mesh.topology import boundary_loops
    >>> V, F = annulus()
    >>> outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    >>> target = np.concatenate([V[outer], V[inner] @ [[0, 1], [-1, 0]]])
    >>> result = injective_map(V, F, np.concatenate([outer, inner]), target)
    >>> result.injective, bool(result.certificate.bijective)
    (True, True)
    """
    began = time.perf_counter()
    true_or_false("refine", refine)
    problem = Problem(V, F, fixed, target, reference=reference)
    way = solve
    if refine:
        # Only here: it brings the construction and the diagnosis along, which most maps do without.
        from quasiharmonic.solver.refine.attempts import solve_refining

        way = solve_refining
    result = way(
        problem,
        strategy=strategy,
        polish=polish,
        start=start,
        max_iterations=max_iterations,
        linear_solver=linear_solver,
        callback=callback,
        record_every=record_every,
        slide=slide,
    )
    return replace(result, seconds=time.perf_counter() - began)
