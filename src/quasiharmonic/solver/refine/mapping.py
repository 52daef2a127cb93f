"""Map arrays into the plane without inverted triangles in one call, with optional refinement."""

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
    """Map a triangle mesh into the plane without inverted triangles.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions of a planar or curved mesh, a disk with or without holes.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    fixed : (k,) array of int
        Fixed vertices: the whole boundary and any pinned interior vertices.
    target : (k, 2) array
        Target positions of the fixed vertices, in the same order.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (§9.3). It overrides the strategy's choice.
    strategy : {"speed", "paper"} or sequence of Descent
        ``"speed"`` finds a map fastest; ``"paper"`` is the pipeline of the paper, with si-log first. A sequence gives
        the stages directly.
    polish : str or Energy, optional
        Distortion energy to lower after an injective map is found; see `quasiharmonic.polish` for the names.
    start : (n, 2) array, optional
        Initial map, for instance the map of the same mesh for a similar target. The search starts from its tensors. If
        that fails, later stages start from scratch.
    max_iterations : int
        Maximum number of iterations of the search; each is one linear solve on the whole mesh. Successful repairs of
        small patches count as iterations. Failed repairs may take as long as 16 times ``max_iterations`` in total.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration. During longer work, such as patch repairs or a diagnosis, it is called
        with the last `Step` again at least every half second, but not within a single factorisation. It may raise
        `KeyboardInterrupt`, for instance after a time limit, which ends the search as Ctrl-C does.
    record_every : int
        Keep every ``record_every``-th map in the result's ``path``. Default: 0, keep no maps.
    slide : bool or BoundaryCurves
        Let boundary vertices slide along their outline during polishing, with fixed corners; see
        `quasiharmonic.polish`. If the boundary of ``target`` is off the curves by a chord, it is moved onto them first.
    refine : bool
        If the given mesh has no injective map, split as few interior edges as possible. The edges are those that the
        diagnosis names, then edges around inverted triangles, then those that a construction with a proof needs. The
        construction requires a connected surface without handles. The target's loops must be simple, disjoint, nested
        and wound as the mesh's; pins must be distinct and strictly inside. The result is then a bijective map or has
        status ``PRECISION_LIMIT``. With dozens of pins far from their mesh positions it may be ``TOO_MANY_SPLITS``.

    Returns
    -------
    MapResult
        The certified map. If no injective map was found, the result is the best map, and ``status`` gives the reason.
        The best map has the fewest inverted triangles; if the diagnosis proves that no injective map exists, it is the
        map of least area. Failure to find a map does not raise an exception. Ctrl-C ends the search and returns the
        best map so far. If edges were split, ``refined`` has the mesh of the map: old vertices keep their indices, new
        ones follow. ``refinement_attempts`` lists the attempts.

    Raises
    ------
    ValueError
        If the input is malformed; see `Problem`.

    Examples
    --------
    Map a square annulus onto itself with its hole turned by 90°:

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
        # Import on demand: refinement also imports the construction and the diagnosis, which most maps do not need.
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
