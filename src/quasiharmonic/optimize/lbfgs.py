"""L-BFGS, SciPy's (§9.1): surer steps than Adam's, at the price of a line search."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.objective import Iterate, Objective


def lbfgs(
    objective: Objective,
    start: Iterate,
    visit: Callable[[Iterate], None],
    *,
    iterations: int,
) -> None:
    """Descend by limited-memory BFGS.

    Parameters
    ----------
    objective : Objective
    start : Iterate
    visit : callable
        Called with every evaluation, those of the line search included; raises `Stop` to end.
    iterations : int
        Evaluations at most.

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        When rounding leaves no positive definite Laplacian.
    """
    from scipy.optimize import minimize

    # The objective's own scale is that of the target's area; SciPy's first step is of the gradient's length.
    scale = 1.0 / abs(start.value) if start.value else 1.0
    known, left = start, iterations

    def evaluate(x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """The objective after ξ is clipped to its bound, which no path that leads anywhere reaches."""
        nonlocal known, left
        xi = x.view(np.complex128)
        inside = objective.bounded(xi)
        if not np.array_equal(inside, known.xi):
            known = objective.evaluate(inside.copy())
            visit(known)
            left -= 1
            if left <= 0:
                raise _Spent
        gradient = known.gradient
        if inside is not xi:
            # Beyond the bound only the direction of ξ counts.
            beyond = np.flatnonzero(inside != xi)
            unit = xi[beyond] / np.abs(xi[beyond])
            gradient = gradient.copy()
            gradient[beyond] -= unit * (unit.conj() * gradient[beyond]).real
            gradient[beyond] *= np.abs(inside[beyond]) / np.abs(xi[beyond])
        return scale * known.value, scale * gradient.view(np.float64)

    # SciPy looks at its own limits only between one line search and the next.
    with suppress(_Spent):
        minimize(
            evaluate,
            start.xi.view(np.float64),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": iterations, "maxfun": iterations, "maxcor": 10, "ftol": 0.0, "gtol": 0.0},
        )


class _Spent(Exception):  # noqa: N818 - a signal, not an error
    """As many evaluations as were allowed are done."""
