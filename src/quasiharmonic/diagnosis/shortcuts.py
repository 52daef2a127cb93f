"""Paths through the mesh with fewer edges than the target leaves room for.

A path from one boundary vertex to another becomes a path of as many segments inside the target, so
two vertices cannot be fewer edges apart than their link distance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..problem import Problem
from .links import Polygon
from .local import Fixture
from .obstruction import Forbids, Kind, Obstruction, named_vertices

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Pairs this many edges apart and more are not looked at.
LONGEST = 8
# Steps in the triangulated target, about a microsecond each, after which the search ends: so many at
# least, and more by so many for each boundary vertex.
_WORK, _WORK_PER_VERTEX = 100_000, 300
# Places from which the target is overlooked, to spare most pairs an exact path.
_HUBS = 8
# Beyond this size, hubs cost more than they spare.
_MOST_FOR_HUBS = 2000


class Shortcuts:
    """Looks for boundary vertices that are closer in the mesh than inside the target.

    Parameters
    ----------
    problem : Problem
        With a single boundary loop, simple and counterclockwise in the target.
    fixture : Fixture

    Attributes
    ----------
    unchecked : int
        Pairs so many edges apart or more were not, or not all, looked at. Known after `find`.
    """

    def __init__(self, problem: Problem, fixture: Fixture) -> None:
        self._loop = problem.loops[0]
        free = ~fixture.fixed
        interior = problem.edges.interior
        inner = interior[free[interior].all(axis=1)]
        mixed = interior[free[interior[:, 0]] != free[interior[:, 1]]]
        mixed = np.where(free[mixed[:, :1]], mixed[:, ::-1], mixed)  # fixed, free
        place = np.full(problem.n, -1)
        place[self._loop] = np.arange(len(self._loop))
        mixed = mixed[place[mixed[:, 0]] >= 0]
        both = np.concatenate([inner, inner[:, ::-1]])
        self._inner = csr_array((np.ones(len(both)), both.T), shape=(problem.n, problem.n))
        self._ends = csr_array(
            (np.ones(len(mixed)), (place[mixed[:, 0]], mixed[:, 1])), shape=(len(self._loop), problem.n)
        )
        rows = fixture.row[self._loop]
        self._near = fixture.lattice.near[rows]
        self._polygon = Polygon([fixture.lattice.points[k] for k in rows.tolist()], self._near)
        self.unchecked = LONGEST + 1
