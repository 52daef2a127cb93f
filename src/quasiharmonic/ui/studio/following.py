"""A map that follows the hand: the boundary's displacement extended harmonically in the last map's own tensors.

An injective map is the harmonic map of its own tensors (`quasiharmonic.solver.field.objective`), so where the boundary
moves by d the map of the same tensors moves by the harmonic extension of d: one solve with a factor that is at hand, a
tenth of a search. Whether that is injective is decided exactly, every time. Where it is not, a map is searched for from
the last one on, and if there is no time for that, part of the way is gone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.util.arrays import FloatArray

#: Seconds that may go by until a hand gets its map, or is told that it will not.
PATIENCE = 0.4
# Shares of the way that are tried where the whole of it cannot be gone at once.
_SHARES = 0.5, 0.25, 0.1


class Followed(NamedTuple):
    """Where the hand has led.

    Attributes
    ----------
    uv : (n, 2) float64
        An injective map.
    certificate : Certificate
        The exact verdict on it.
    reached : bool
        Whether its boundary is where the hand wants it; else it is as far as was got in time.
    """

    uv: FloatArray
    certificate: Certificate
    reached: bool


class Follower:
    """Follows the target of a problem from an injective map on.

    Parameters
    ----------
    problem : Problem
        Its domain is shared, its target is where the map is.
    uv : (n, 2) float64
        An injective map of it.
    certificate : Certificate
        The verdict on it.
    """

    def __init__(self, problem: Problem, uv: FloatArray, certificate: Certificate) -> None:
        self.problem = problem
        self._uv, self._certificate = uv, certificate
        self._take(uv)

    def _take(self, uv: FloatArray) -> None:
        """Go on from an injective map."""
        problem = self.problem.with_target(uv[self.problem.fixed])
        self._operator = Objective(problem).of_map(problem.frame.inward(uv)).operator
        self._base = uv

    def to(self, target: FloatArray, waiting: Callable[[], bool] = lambda: False) -> Followed:
        """Lead the boundary to ``target`` (k, 2), or as far as patience goes.

        Parameters
        ----------
        target : (k, 2) float64
        waiting : callable
            Whether the hand is elsewhere already, so that nobody waits for this map.
        """
        until = time.monotonic() + PATIENCE
        if self._try(target) or self._search(target, until, waiting):
            return Followed(self._uv, self._certificate, True)
        here = self._uv[self.problem.fixed]
        for share in _SHARES:
            if time.monotonic() > until or waiting():
                break
            if self._try(here + share * (target - here)):
                self._take(self._uv)
                break
        return Followed(self._uv, self._certificate, False)

    def _try(self, target: FloatArray) -> bool:
        """Extend the boundary's displacement; whether that is an injective map, which is then the last one."""
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
        """Search for a map from the last one on, as long as there is time; whether it is found."""

        def hurry(_: object) -> None:
            if time.monotonic() > until or waiting():
                raise KeyboardInterrupt

        result = solve(self.problem.with_target(target), start=self._uv, callback=hurry)
        if result.injective:
            self._uv, self._certificate = result.uv, result.certificate
            self._take(self._uv)
        return result.injective
