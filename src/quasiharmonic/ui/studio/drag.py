"""Update the map during a drag: extend the boundary's displacement harmonically with the last map's tensors.

An injective map is the harmonic map of its own tensors (`quasiharmonic.solver.field.objective`). If the boundary moves
by d, the map of the same tensors moves by the harmonic extension of d. This takes one solve with an existing factor,
about a tenth of the time of a search. Every map is certified exactly. If it is not injective, a search starts from the
last map. If time runs out, the boundary moves only part of the way.

Boundary vertices around the dragged vertex share its motion, the less the further away they are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.mapping import solve
from quasiharmonic.util.arrays import FloatArray, IntArray

#: Maximum seconds until a drag gets its map, or the report that there is none yet.
PATIENCE = 0.4
# Shares of the displacement to try if the whole displacement fails.
_FRACTIONS = 0.5, 0.25, 0.1
#: Reach of the falloff around a vertex that is not a corner, as a share of the loop's length.
REACH = 0.08


class DragMap(NamedTuple):
    """The map that a page shows during a drag."""

    uv: FloatArray  # (n, 2): an injective map
    certificate: Certificate  # Its exact certificate
    reached: bool  # Whether its boundary reached the target; otherwise it went as far as time allowed


class Follower:
    """Follows a moving target of a problem's boundary, starting from an injective map (n, 2) with its certificate."""

    def __init__(self, problem: Problem, uv: FloatArray, certificate: Certificate) -> None:
        self.problem = problem
        self._uv, self._certificate = uv, certificate
        self._take(uv)

    def _take(self, uv: FloatArray) -> None:
        """Continue from an injective map."""
        problem = self.problem.with_target(uv[self.problem.fixed])
        self._operator = Objective(problem).of_map(problem.frame.inward(uv)).operator
        self._base = uv

    def move_to(self, target: FloatArray, waiting: Callable[[], bool] = lambda: False) -> DragMap:
        """Move the boundary to ``target`` (k, 2), or as far as possible within `PATIENCE`.

        ``waiting`` returns whether a newer target exists, so that this map is not needed.
        """
        until = time.monotonic() + PATIENCE
        if self._try(target) or self._search(target, until, waiting):
            return DragMap(self._uv, self._certificate, True)
        here = self._uv[self.problem.fixed]
        for share in _FRACTIONS:
            if time.monotonic() > until or waiting():
                break
            if self._try(here + share * (target - here)):
                self._take(self._uv)
                break
        return DragMap(self._uv, self._certificate, False)

    def _try(self, target: FloatArray) -> bool:
        """Extend the boundary's displacement; keep the map and return True if it is injective."""
        fixed = self.problem.fixed
        way = np.zeros(self.problem.n, dtype=np.complex128)
        way[fixed] = (target - self._base[fixed]).view(np.complex128).ravel()
        uv = self._base + self._operator.extend(way).view(np.float64).reshape(-1, 2)
        uv[fixed] = target
        certificate = certify(self.problem.F, uv, loops=self.problem.domain.loops)
        if certificate.injective:
            self._uv, self._certificate = uv, certificate
        return certificate.injective

    def _search(self, target: FloatArray, until: float, waiting: Callable[[], bool]) -> bool:
        """Search for a map from the last one until the deadline; return whether it was found."""

        def interrupt_late(_: object) -> None:
            if time.monotonic() > until or waiting():
                raise KeyboardInterrupt

        result = solve(self.problem.with_target(target), start=self._uv, callback=interrupt_late)
        if result.injective:
            self._uv, self._certificate = result.uv, result.certificate
            self._take(self._uv)
        return result.injective


def drag_weights(
    vertex: int, fixed: IntArray, target: FloatArray, loops: Sequence[IntArray], corners: Sequence[int]
) -> FloatArray:
    """Return the share of the pointer's motion for every fixed vertex, (k,) from 0 to 1, 1 at the dragged vertex.

    A pin moves alone. A corner moves its two adjacent sides linearly, so that straight sides stay straight. Any other
    boundary vertex bends its side smoothly, at most up to the ends of the side. Sides end at ``corners``. ``target``
    (k, 2) are the positions of ``fixed``. ValueError if the vertex is not fixed.
    """
    row = np.flatnonzero(fixed == vertex)
    if not row.size:
        raise ValueError(f"vertex {vertex} is not fixed: pin it first")
    share = np.zeros(len(fixed))
    share[row] = 1.0
    loop = next((loop for loop in loops if vertex in loop), None)
    if loop is None:
        return share
    loop = np.roll(loop, -int(np.flatnonzero(loop == vertex)[0]))
    rows = np.empty(int(fixed.max()) + 1, dtype=np.int64)
    rows[fixed] = np.arange(len(fixed))
    points = target[rows[loop]]
    lengths = np.hypot(*(np.roll(points, -1, axis=0) - points).T)
    ahead = np.concatenate([[0.0], np.cumsum(lengths)])
    loop_length, ahead = ahead[-1], ahead[:-1]
    others = np.flatnonzero(np.isin(loop, [c for c in corners if c != vertex]))
    is_corner = vertex in corners
    for way, last in ((ahead, others[:1]), (loop_length - ahead, others[-1:])):
        # On a side without end, a corner moves a quarter of the loop in each direction.
        end = float(way[last[0]]) if last.size else (0.25 if is_corner else 1.0) * loop_length
        if not is_corner:
            end = min(end, REACH * loop_length)
        if end <= 0:
            continue
        t = np.minimum(way / end, 1.0)
        share[rows[loop]] = np.maximum(share[rows[loop]], 1 - t if is_corner else (1 - t**2) ** 2)
    share[row] = 1.0
    return share
