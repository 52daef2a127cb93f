"""Test whether the construction applies to a problem."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.problem import Problem
from quasiharmonic.util.arrays import FloatArray, IntArray


def is_simple(problem: Problem) -> bool:
    """Whether a surface can be mapped bijectively onto its target if its mesh is fine enough, determined exactly.

    True if the surface has no handles and the target is simple. Its loops must be simple, disjoint, nested as an outer
    one around all others, and wound as the mesh's. Pins must be distinct and strictly inside.
    """
    domain = problem.domain
    edges = len(domain.edges.interior) + len(domain.edges.boundary)
    if problem.n - edges + len(problem.F) != 2 - len(domain.loops):
        return False
    if len(np.unique(problem.target, axis=0)) < len(problem.target):
        return False
    uv = np.zeros((problem.n, 2))
    uv[problem.fixed] = problem.target
    if check_loops(domain.loops, uv)[1]:
        return False
    return all(_strictly_inside(uv[pin], uv, domain.edges.boundary) for pin in domain.pins.tolist())


def _strictly_inside(point: FloatArray, uv: FloatArray, rim: IntArray) -> bool:
    """Whether a point is strictly inside simple, nested loops, given by their edges."""
    tail, head = uv[rim[:, 0]], uv[rim[:, 1]]
    up = tail[:, 1] <= head[:, 1]
    low, high = np.where(up[:, None], tail, head), np.where(up[:, None], head, tail)
    level = (low[:, 1] <= point[1]) & (point[1] <= high[:, 1])
    low, high = low[level], high[level]
    side = orientation(low, high, point)
    across = (np.minimum(low[:, 0], high[:, 0]) <= point[0]) & (point[0] <= np.maximum(low[:, 0], high[:, 0]))
    if np.any((side == 0) & across):
        return False
    # A ray to the left intersects edges with the point to their right; an endpoint counts for the edge above it.
    return bool(np.count_nonzero((side < 0) & (high[:, 1] > point[1])) % 2)
