"""Test whether the construction applies to a problem."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.loops import check_loops, winding
from quasiharmonic.problem import Problem


def is_simple(problem: Problem) -> bool:
    """Whether a surface can be mapped bijectively onto its target if its mesh is fine enough, determined exactly.

    True if the surface has no handles and the target is simple. Its loops must be simple, disjoint, nested as an outer
    one around all others, and wound as the mesh's. Pins must be distinct and strictly inside.
    """
    domain = problem.domain
    if domain.euler != 2 - len(domain.loops):
        return False
    if len(np.unique(problem.target, axis=0)) < len(problem.target):
        return False
    uv = problem.place_fixed()
    if check_loops(domain.loops, uv)[1]:
        return False
    turns, on = winding(uv[domain.pins], *uv[domain.edges.boundary.T])
    return bool(np.all(~on & (turns == 1)))
