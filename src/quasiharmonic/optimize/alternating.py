"""The greedy alternation of §9.2: the best tensor for the map, the best map for the tensor, and again.

With the map held, the energy ``2m |q − μp|² / (1 − |μ|²)`` of a triangle is least at its own Beltrami
coefficient ``μ = q/p`` where it is positive, and at ``conj(p/q)`` where it is inverted; the least values are
0 and twice the inverted area. This is the total unsigned area of Xu et al. (2011) in another dress.

It gets stuck at once from afar (§7.1), and often rights the last few tiny triangles.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.mesh.reference import Derivatives
from quasiharmonic.objective import Iterate, Objective

ComplexArray = NDArray[np.complex128]


def alternating(
    objective: Objective,
    start: Iterate,
    visit: Callable[[Iterate], None],
    *,
    iterations: int,
) -> None:
    """Descend V₃ by alternation.

    Parameters
    ----------
    objective : Objective
        Its functional is not looked at: each half step lowers V₃.
    start : Iterate
    visit : callable
        Called with every iterate; raises `Stop` to end.
    iterations : int
        Steps to take at most.

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        When even short steps leave no positive definite Laplacian.
    """
    here = start
    for _ in range(iterations):
        here = objective.step(here, objective.parameterization.invert(own_tensor(here.dw)) - here.xi)
        visit(here)


def own_tensor(dw: Derivatives) -> ComplexArray:
    """The μ that makes V₃ least with the map held (eq. 39).

    Parameters
    ----------
    dw : Derivatives
        Of the map.

    Returns
    -------
    (f,) complex128
        Of modulus 1 where a triangle has no area.
    """
    p, q, _ = dw
    inverted = np.abs(q) > np.abs(p)
    small, large = np.where(inverted, p.conj(), q), np.where(inverted, q.conj(), p)
    return np.divide(small, large, out=np.zeros_like(p), where=large != 0)
