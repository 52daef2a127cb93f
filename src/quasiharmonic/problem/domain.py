"""The domain of a map: a surface and its fixed vertices. `Problem` adds the target positions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.reference import Reference, ReferenceMesh, flat_triangles
from quasiharmonic.geometry.mesh.topology import Edges, surface_edges, trace_loops
from quasiharmonic.linsolve import check_name
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    ReadOnly,
    distinct_vertices,
    make_unchangeable,
    mark,
    reject,
    scale_to_unit,
    triangle_array,
    vertex_array,
)


class Domain(ReadOnly):
    """A surface and its fixed vertices: all data that does not depend on the target positions.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions, planar or curved; any real dtype.
    F : (f, 3) array of int
        Triangles, 0-based and consistently oriented. Their order is kept.
    fixed : (k,) array of int or None
        Vertices with prescribed positions; None for all vertices of the boundary, ascending.

    Raises
    ------
    ValueError
        With the first offending elements: wrong shapes or dtypes, indices out of range, numbers that are not finite,
        repeated or non-manifold elements, mixed orientation, several components, isolated vertices, a closed surface, a
        vertex fixed twice.

    Attributes
    ----------
    V, F, fixed : arrays
        The input as float64 and int64; not writeable.
    edges : Edges
        The edges of the surface, by kind.
    loops : list of (l,) int64
        Boundary loops, with the surface to their left; not writeable.

    Notes
    -----
    All solves on a domain share its factorisations, in any thread. Results do not depend on this sharing. To avoid
    repeated factorisations, see `exclusive`.
    """

    def __init__(self, V: ArrayLike, F: ArrayLike, fixed: ArrayLike | None) -> None:
        self.V: FloatArray = vertex_array(V)
        self.F: IntArray = make_unchangeable(triangle_array(F, self.n))
        self.edges: Edges = surface_edges(self.F, self.n)
        self.fixed: IntArray = distinct_vertices(
            "fixed", np.unique(self.edges.boundary) if fixed is None else fixed, self.n
        )
        self.loops: list[IntArray] = trace_loops(self.edges.boundary)
        self._seal()
        self._empty_caches()

    def _read_only(self) -> tuple[FloatArray | IntArray, ...]:
        return self.V, self.F, self.fixed, *vars(self.edges).values(), *self.loops

    def _empty_caches(self) -> None:
        """Reset the objects that are computed on first use."""
        self._lock = Lock()
        self._laplacians: dict[str, Laplacian] = {}
        self._meshes: dict[Reference, ReferenceMesh] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Factorisations belong to an external library's memory, so pickles and copies omit them.
        return {name: getattr(self, name) for name in ("V", "F", "edges", "loops", "fixed")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._empty_caches()

    @contextmanager
    def exclusive(self) -> Iterator[Domain]:
        """Yield this domain, or a copy with its own factorisations if this domain is already in use.

        Without the copy, two threads, or a solve inside another solve's callback, would refactor alternately.
        """
        if not self._lock.acquire(blocking=False):
            yield copy(self)
            return
        try:
            yield self
        finally:
            self._lock.release()

    @property
    def n(self) -> int:
        """Number of vertices."""
        return len(self.V)

    @property
    def euler(self) -> int:
        """Euler characteristic of the surface: vertices minus edges plus triangles."""
        return self.n - len(self.edges.interior) - len(self.edges.boundary) + len(self.F)

    @property
    def handles(self) -> int:
        """Number of handles of the surface, its genus."""
        return (2 - len(self.loops) - self.euler) // 2

    @property
    def pins(self) -> IntArray:
        """Fixed vertices that are not on the boundary, ascending."""
        return np.flatnonzero(mark(self.n, self.fixed) & ~mark(self.n, self.edges.boundary))

    def check_boundary_fixed(self) -> None:
        """Raise a ValueError with the boundary vertices that are not fixed, for methods that need all of them fixed."""
        missing = mark(self.n, self.edges.boundary) & ~mark(self.n, self.fixed)
        message = "the boundary {} not in fixed: every boundary vertex needs a target position"
        reject(missing, "vertex", "vertices", message)

    def check_areas(self) -> None:
        """Raise a ValueError with the triangles of zero rest area, for methods that use their shapes."""
        remedy = "choose the reference 'equilateral', or remove them with clean"
        flat = flat_triangles(self.V, self.F)
        reject(flat, "triangle", "triangles", f"{{}} of zero area in the rest mesh; {remedy}")

    def laplacian(self, linear_solver: str = "auto") -> Laplacian:
        """Return the Laplacian of this mesh and these fixed vertices; it is analysed once and cached (§6.2, eq. 12).

        All callers get the same object. Raise a ValueError if the solver is unknown, an ImportError if it is not
        installed.
        """
        check_name(linear_solver)
        if linear_solver not in self._laplacians:
            made = Laplacian(self.F, self.n, self.fixed, linear_solver, self.V)
            # "auto" and the solver that it selects share one analysis.
            self._laplacians[linear_solver] = self._laplacians.setdefault(made.solver.name, made)
        return self._laplacians[linear_solver]

    def mesh(self, kind: Reference) -> ReferenceMesh:
        """Return the mesh with reference triangles of one kind; it is built once and cached (§9.3).

        Positions are scaled by a power of two to magnitude one, so that no area overflows or underflows. The
        functionals are scale-invariant.
        """
        if kind not in self._meshes:
            V = self.V
            self._meshes[kind] = ReferenceMesh(V if kind == "equilateral" else scale_to_unit(V), self.F, kind)
        return self._meshes[kind]
