"""Sparse Cholesky solvers behind one protocol: analyse a pattern once, factor, solve, release.

The package builds on `geometry.mesh`. Start reading in `base`, then `laplacian`.

>>> import numpy as np
>>> from quasiharmonic.linsolve import make_solver
>>> indptr, indices = [0, 2, 3], [0, 1, 1]  # upper triangle of [[2, -1], [-1, 2]]
>>> with make_solver(indptr, indices, name="superlu") as solver:
...     solver.factor([2.0, -1.0, 2.0])
...     solver.solve(np.array([1.0, 1.0])).round(12).tolist()
[1.0, 1.0]
"""

from __future__ import annotations

from functools import cache
from importlib import import_module

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.linsolve.base import LinearSolver, NotPositiveDefinite
from quasiharmonic.util.arrays import check_choice

__all__ = ["LinearSolver", "NotPositiveDefinite", "available", "make_solver", "takes_order"]

# Fastest first: the order in which "auto" tries the backends. Each entry is the module and the class in it.
BACKENDS = {
    "mkl": ("mkl", "MKL"),
    "cholmod": ("packages", "Cholmod"),
    "rslab": ("rslab", "Rslab"),
    "qdldl": ("packages", "Qdldl"),
    "superlu": ("packages", "SuperLU"),
}
# Number of entries in the upper triangle up to which QDLDL is tried before rslab, whose supernodes have an overhead.
# Analysis and ten factorisations take the same time at 40,000 entries of a Laplacian (10,000 unknowns). For Newton
# systems (2,500 unknowns), whose rows are twice as long, this is at 15,000 to 20,000 entries.
QDLDL_UP_TO = 25_000


@cache
def _backend(name: str) -> type[LinearSolver]:
    module, attribute = BACKENDS[name]
    backend: type[LinearSolver] = getattr(import_module(f".{module}", __name__), attribute)
    return backend


def available(entries: int | None = None) -> tuple[str, ...]:
    """Return the names of the installed backends, best first, without loading them.

    The order is for upper triangles with this number of entries, by default for large ones.
    """
    present = [name for name in BACKENDS if _backend(name).is_installed()]
    if entries is not None and entries <= QDLDL_UP_TO and {"qdldl", "rslab"} <= set(present):
        rslab = present.index("rslab")
        present[rslab : rslab + 2] = "qdldl", "rslab"
    return tuple(present)


def check_name(name: object) -> None:
    """Raise a ValueError that lists the names of the linear solvers, unless this is one of them, installed or not."""
    check_choice("linear_solver", name, ("auto", *BACKENDS))


def takes_order(name: str = "auto") -> bool:
    """Return whether the solver of this name accepts an elimination order for large systems (`make_solver`)."""
    check_name(name)
    chosen = available()[0] if name == "auto" else name
    return _backend(chosen).takes_order


def make_solver(
    indptr: ArrayLike,
    indices: ArrayLike,
    *,
    name: str = "auto",
    ordered: bool = False,
    semidefinite: bool = False,
) -> LinearSolver:
    """Analyse the pattern of a symmetric matrix with the best backend present, or with the one named.

    Parameters
    ----------
    indptr, indices : (n+1,) and (nnz,) integer arrays
        Upper triangle of the pattern in compressed sparse rows: columns ascending within each row, every row starting
        with its diagonal entry.
    name : {"auto", "mkl", "cholmod", "rslab", "qdldl", "superlu"}
        Backend to use. "auto" uses the first of `available` for this number of entries that can be loaded.
    ordered : bool
        Whether the unknowns are numbered such that elimination in this order gives a sparse factor, as
        by `quasiharmonic.linsolve.dissection`. If so, a backend that accepts an order does not compute its own.
    semidefinite : bool
        Whether the matrices are sums of positive semidefinite ones. Then a backend may leave out a slow test of pivots.

    Returns
    -------
    LinearSolver
        Its ``name`` gives the backend.

    Raises
    ------
    ValueError
        If the name is unknown or the pattern is not valid.
    ImportError
        If the named backend is not installed or its library does not load.
    """
    check_name(name)
    if name == "auto":
        for candidate in available(np.size(indices)):
            try:
                return _backend(candidate)(indptr, indices, ordered=ordered, semidefinite=semidefinite)
            except ImportError:
                continue  # installed but broken; the last candidate is part of SciPy and always loads
    backend = _backend(name)
    if not backend.is_installed():
        raise ImportError(
            f"linear solver {name!r} is not installed; available: {', '.join(available())}. "
            f"To install it: {backend.requirement}"
        )
    return backend(indptr, indices, ordered=ordered, semidefinite=semidefinite)
