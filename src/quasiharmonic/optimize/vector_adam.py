"""VectorAdam (Ling et al. 2022): Adam whose step is normalised by each triangle's complex modulus (§9.4, §F.1).

The normalisation makes every triangle move at the same pace in ξ, however small its area, and makes
the path independent of the frames in which the triangles' ξ are expressed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from quasiharmonic.mesh.reference import blocks
from quasiharmonic.objective import Iterate, Objective

# Less momentum than Adam's usual 0.9 / 0.999 is the largest single gain: the landscape changes as fast as
# the map unfolds, and old gradients point to where the folds were.
MOMENTUM = 0.6, 0.9


def vector_adam(
    objective: Objective,
    start: Iterate,
    visit: Callable[[Iterate], None],
    *,
    iterations: int,
    schedule: Sequence[tuple[int, float]],
) -> None:
    """Descend by VectorAdam.

    Parameters
    ----------
    objective : Objective
    start : Iterate
    visit : callable
        Called with every iterate; raises `Stop` to end.
    iterations : int
        Steps to take at most.
    schedule : sequence of (int, float)
        Step lengths at given iterations, linear in between and constant after the last.

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        When even short steps leave no positive definite Laplacian.
    """
    first, second = MOMENTUM
    times, lengths = zip(*schedule, strict=True)
    mean = np.zeros_like(start.xi)
    square = np.zeros(start.xi.shape)
    here = start
    for k in range(1, iterations + 1):
        gradient, step = here.gradient, np.empty_like(mean)
        length = float(np.interp(k - 1, times, lengths)) * np.sqrt(1 - second**k) / (1 - first**k)
        for part in blocks(mean.size):
            g, average, squares = gradient[part], mean[part], square[part]
            average *= first
            average += (1 - first) * g
            squares *= second
            squares += (1 - second) * (g.real**2 + g.imag**2)
            root = np.sqrt(squares)
            # A triangle whose gradient has never differed from zero stays where it is.
            root[root == 0] = np.inf
            np.multiply(average, -length / root, out=step[part])
        here = objective.step(here, step)
        visit(here)
