"""Where a map lives: a surface, and which of its vertices are held. Where they go is another question (`Problem`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.reference import Reference, ReferenceMesh, flat_triangles
from quasiharmonic.geometry.mesh.surface import surface_edges
from quasiharmonic.geometry.mesh.topology import trace_loops
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    ReadOnly,
    held_vertices,
    named,
    triangle_array,
    unchangeable,
    vertex_array,
)


class Domain(ReadOnly):
    """A surface with some of its vertices held: all that does not change while they move.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions, planar or curved; any real dtype.
    F : (f, 3) array of int
        Triangles, 0-based and consistently oriented. Never reordered.
    fixed : (k,) array of int
        Vertices whose positions are given.

    Raises
    ------
    ValueError
        With the first offending elements: wrong shapes or dtypes, indices out of range, numbers that
        are not finite, repeated or non-manifold elements, mixed winding, several components, isolated
        vertices, a closed surface, a vertex held twice.

    Attributes
    ----------
    V, F, fixed : arrays
        As given, as float64 and int64; not writeable.
    edges : Edges
        The surface's, by kind.
    loops : list of (l,) int64
        Boundary loops, the surface to their left; not writeable.

    Notes
    -----
    Factorisations are shared by all that is asked of a domain, in any thread. Answers do not depend on that; to save
    the refactoring, see `exclusive`.
    """

    def __init__(self, V: ArrayLike, F: ArrayLike, fixed: ArrayLike) -> None:
        self.V = vertex_array(V)
        self.F = unchangeable(triangle_array(F, len(self.V)))
        self.edges = surface_edges(self.F, len(self.V))
        self.loops = trace_loops(self.edges.boundary)
        self.fixed = held_vertices(fixed, len(self.V))
        self._seal()
        self._empty_caches()

    def _read_only(self) -> tuple[FloatArray | IntArray, ...]:
        return self.V, self.F, self.fixed, *vars(self.edges).values(), *self.loops

    def _empty_caches(self) -> None:
        """Nothing made yet of what is made when it is first asked for, and kept."""
        self._lock = Lock()
        self._laplacians: dict[str, Laplacian] = {}
        self._meshes: dict[Reference, ReferenceMesh] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Factorisations live in a library's memory and stay behind when a domain is pickled or copied.
        return {name: getattr(self, name) for name in ("V", "F", "edges", "loops", "fixed")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._empty_caches()

    @contextmanager
    def exclusive(self) -> Iterator[Domain]:
        """Give this domain, or a twin with factorisations of its own while somebody else is using this one's.

        Two threads, or a solve within another's callback, would otherwise take turns at refactoring.
        """
        if not self._lock.acquire(blocking=False):
            twin = object.__new__(Domain)
            twin.__setstate__(self.__getstate__())
            yield twin
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
    def pins(self) -> IntArray:
        """Fixed vertices that are not on the boundary, ascending."""
        marked = np.zeros(self.n, dtype=bool)
        marked[self.fixed] = True
        marked[self.edges.boundary] = False
        return np.flatnonzero(marked)

    def check_boundary_fixed(self) -> None:
        """Raise a ValueError that names boundary vertices which are not held, for methods that need all of them."""
        marked = np.zeros(self.n, dtype=bool)
        marked[self.edges.boundary] = True
        marked[self.fixed] = False
        missing = np.flatnonzero(marked)
        if missing.size:
            raise ValueError(
                f"the boundary {named('vertex', 'vertices', missing)} not in fixed: "
                "every boundary vertex needs a target position"
            )

    def check_areas(self) -> None:
        """Raise a ValueError that names triangles without area at rest, for methods that look at their shapes."""
        flat = flat_triangles(self.V, self.F)
        if flat.size:
            raise ValueError(
                f"{named('triangle', 'triangles', flat)} of zero area in the rest mesh; "
                "choose the reference 'equilateral', or repair the mesh"
            )

    def laplacian(self, linear_solver: str = "auto") -> Laplacian:
        """The Laplacian of this mesh and these fixed vertices, analysed once and kept (§6.2, eq. 12).

        Parameters
        ----------
        linear_solver : str
            ``"auto"`` or one of `quasiharmonic.linsolve.available`.

        Returns
        -------
        Laplacian
            Shared by all that ask for it.

        Raises
        ------
        ValueError
            When there is no such solver.
        ImportError
            When its library is not installed.
        """
        if linear_solver not in self._laplacians:
            made = Laplacian(self.F, self.n, self.fixed, linear_solver, self.V)
            # "auto" and the name it stands for share one analysis.
            self._laplacians[linear_solver] = self._laplacians.setdefault(made.solver.name, made)
        return self._laplacians[linear_solver]

    def mesh(self, kind: Reference) -> ReferenceMesh:
        """The mesh with reference triangles of some kind, built once and kept (§9.3).

        Parameters
        ----------
        kind : {"equilateral", "rest", "corrected"}

        Returns
        -------
        ReferenceMesh

        Notes
        -----
        In units near the rest mesh's size, a power of two, so that no area leaves the numbers' range; the
        functionals have no scale.
        """
        if kind not in self._meshes:
            V = self.V
            if kind != "equilateral":
                V = np.ldexp(V, -int(np.frexp(np.max(np.abs(V)))[1]))
            self._meshes[kind] = ReferenceMesh(V, self.F, kind)
        return self._meshes[kind]
