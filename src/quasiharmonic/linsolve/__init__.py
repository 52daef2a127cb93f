"""Sparse Cholesky behind one small protocol: analyse a pattern once, factor, solve, release.

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

from quasiharmonic.linsolve.base import LinearSolver
from quasiharmonic.linsolve.errors import NotPositiveDefinite

__all__ = ["LinearSolver", "NotPositiveDefinite", "available", "make_solver", "takes_order"]

# Fastest first: the order in which "auto" tries them. Each entry is the module and the class in it.
BACKENDS = {
    "pardiso": ("mkl", "Pardiso"),
    "cholmod": ("cholmod", "Cholmod"),
    "rslab": ("rslab", "Rslab"),
    "qdldl": ("qdldl", "Qdldl"),
    "superlu": ("superlu", "SuperLU"),
}
# Up to this many entries in the upper triangle QDLDL is tried before rslab, whose supernodes then cost more than they
# save: analysis and ten factorisations take the same at 40,000 entries of a Laplacian (10,000 unknowns), and at 15,000
# to 20,000 of a Newton system (2,500), whose rows are twice as long.
QDLDL_UP_TO = 25_000


@cache
def _backend(name: str) -> type[LinearSolver]:
    module, attribute = BACKENDS[name]
    backend: type[LinearSolver] = getattr(import_module(f".{module}", __name__), attribute)
    return backend


def available(entries: int | None = None) -> tuple[str, ...]:
    """Names of the backends whose libraries are installed, best first; none of them is loaded.

    Best for upper triangles of so many entries, or by default for large ones.
    """
    present = [name for name in BACKENDS if _backend(name).present()]
    if entries is not None and entries <= QDLDL_UP_TO and {"qdldl", "rslab"} <= set(present):
        young = present.index("rslab")
        present[young : young + 2] = "qdldl", "rslab"
    return tuple(present)


def takes_order(name: str = "auto") -> bool:
    """Whether the backend that `make_solver` takes by this name for a large system has a use for a good order."""
    chosen = available()[0] if name == "auto" else name
    return chosen in BACKENDS and _backend(chosen).takes_order


def make_solver(indptr: ArrayLike, indices: ArrayLike, *, name: str = "auto", ordered: bool = False) -> LinearSolver:
    """Analyse the pattern of a symmetric matrix with the best backend present, or with the one named.

    Parameters
    ----------
    indptr, indices : (n+1,) and (nnz,) integer arrays
        Upper triangle of the pattern in compressed sparse rows: columns ascending within each row, every row starting
        with its diagonal entry.
    name : {"auto", "pardiso", "cholmod", "rslab", "qdldl", "superlu"}
        Which backend to use. "auto" takes the first of `available` for so many entries that loads.
    ordered : bool
        The unknowns are numbered such that eliminating them in turn leaves a sparse factor, as
        `quasiharmonic.linsolve.dissection` numbers them. A backend then looks for no order of its own, if it can be
        told.

    Returns
    -------
    LinearSolver
        Its ``name`` says which backend it is.

    Raises
    ------
    ValueError
        No backend has this name, or the pattern is not as described.
    ImportError
        The backend named is not installed, or its library does not load.
    """
    if name == "auto":
        for candidate in available(np.size(indices)):
            try:
                return _backend(candidate)(indptr, indices, ordered=ordered)
            except ImportError:
                continue  # installed but broken; the last candidate comes with SciPy and always loads
    if name not in BACKENDS:
        raise ValueError(
            f"unknown linear solver {name!r}; the names are 'auto', {', '.join(map(repr, BACKENDS))}; "
            f"available: {', '.join(available())}"
        )
    backend = _backend(name)
    if not backend.present():
        raise ImportError(
            f"linear solver {name!r} is not installed; available: {', '.join(available())}. "
            f"To install it: {backend.requirement}"
        )
    return backend(indptr, indices, ordered=ordered)
