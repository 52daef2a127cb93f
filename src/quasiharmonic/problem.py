"""The question: a mesh, and where its boundary and its pins go. Every check on what a user gives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from threading import Lock
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.arrays import check_finite, check_range, index_array, real_array
from quasiharmonic.laplacian import Laplacian
from quasiharmonic.mesh.reference import Reference, ReferenceMesh, rest_frames
from quasiharmonic.mesh.topology import Edges, components, edges, named, named_edges, trace_loops

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]


class Problem:
    """A mesh with positions in the plane for its boundary and any pinned interior vertices.

    What is malformed raises; what is merely hard or hopeless (a target that crosses itself, is wound
    the wrong way or admits no map) is accepted and ends in a result that says so.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions, planar or curved; any real dtype.
    F : (f, 3) array of int
        Triangles, 0-based and consistently oriented. Never reordered. A planar target is wound as the
        mesh is: counterclockwise around a mesh whose triangles are counterclockwise.
    fixed : (k,) array of int
        Vertices with given positions: at least the whole boundary, and any interior vertices.
    target : (k, 2) array
        Their positions, in the order of ``fixed``; any real dtype.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (see `ReferenceMesh`), whatever the strategy
        would choose.

    Raises
    ------
    ValueError
        With the first offending elements: wrong shapes or dtypes, indices out of range, numbers that
        are not finite, repeated or non-manifold elements, mixed winding, several components, isolated
        vertices, a closed surface, boundary vertices without a position, a vertex fixed twice, and
        triangles of zero area in the rest mesh. Those last are accepted when the reference is
        ``"equilateral"`` or ``"corrected"`` by the caller's own word: that says that their shapes, and
        the distortion that nobody could measure, do not matter.

    Attributes
    ----------
    V, F, fixed, target : arrays
        As given, as float64 and int64.
    loops : list of (l,) int64
        Boundary loops, the surface to their left.
    derived : dict
        What other modules make of the mesh and the choice of fixed vertices and keep here by a name, for this
        problem and those that `moved` makes of it.
    """

    def __init__(
        self,
        V: ArrayLike,
        F: ArrayLike,
        fixed: ArrayLike,
        target: ArrayLike,
        *,
        reference: Reference | None = None,
    ) -> None:
        self.V = _vertices(V)
        self.F = _triangles(F, len(self.V))
        self.edges = _surface(self.F, len(self.V))
        self.loops = trace_loops(self.edges.boundary)
        if reference is not None and reference not in get_args(Reference):
            raise ValueError(f"reference must be one of {', '.join(get_args(Reference))}, not {reference!r}")
        self.reference = reference
        if reference is None or reference == "rest":
            _positive_areas(self.V, self.F)
        self.fixed = _fixed(fixed, len(self.V), self.edges)
        self.target = _target(target, len(self.fixed))
        for array in (self.V, self.F, self.fixed, self.target):
            array.flags.writeable = False
        self._lock = Lock()
        self._laplacians: dict[str, Laplacian] = {}
        self._meshes: dict[Reference, ReferenceMesh] = {}
        self.derived: dict[str, object] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Factorisations live in a library's memory and stay behind when a problem is pickled.
        return {name: value for name, value in self.__dict__.items() if name not in ("_laplacians", "_lock", "derived")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _laplacians={}, _lock=Lock(), derived={})

    @contextmanager
    def exclusive(self) -> Iterator[Problem]:
        """Give this problem, or a twin with factorisations of its own while another solve is using this one's.

        Problems that `moved` made share them, and two threads, or a solve within another's callback, must not
        overwrite each other's.
        """
        if not self._lock.acquire(blocking=False):
            twin = object.__new__(Problem)
            twin.__setstate__(self.__getstate__())
            yield twin
            return
        try:
            yield self
        finally:
            self._lock.release()

    def moved(self, target: ArrayLike) -> Problem:
        """The same problem with its fixed vertices elsewhere.

        Topology, pattern and symbolic factorisation are shared with this one.

        Parameters
        ----------
        target : (k, 2) array
            New positions of ``fixed``.

        Returns
        -------
        Problem
            A new one; this one stays as it is.

        Raises
        ------
        ValueError
            When there are not as many places as fixed vertices, or one is not finite.
        """
        other = object.__new__(Problem)
        other.__dict__.update(self.__dict__)
        for of_target in ("frame", "encloses_area"):
            other.__dict__.pop(of_target, None)
        other.target = _target(target, len(self.fixed))
        other.target.flags.writeable = False
        return other

    def laplacian(self, linear_solver: str = "auto") -> Laplacian:
        """The Laplacian of this mesh and these fixed vertices, analysed once and kept (§6.2, eq. 12).

        Parameters
        ----------
        linear_solver : str
            ``"auto"`` or one of `quasiharmonic.linsolve.available`.

        Returns
        -------
        Laplacian
            Shared by all problems that `moved` made of this one.

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
            exponent = int(np.frexp(np.max(np.abs(self.V)))[1])
            self._meshes[kind] = ReferenceMesh(np.ldexp(self.V, -exponent), self.F, kind)
        return self._meshes[kind]

    @cached_property
    def frame(self) -> Frame:
        """The coordinates in which the problem is solved."""
        return Frame(self.target)

    def positions(self, w: ComplexArray) -> FloatArray:
        """A map of the frame as the caller gets it, the fixed vertices to the last bit.

        Parameters
        ----------
        w : (n,) complex128
            Places u + iv in the frame that is solved in.

        Returns
        -------
        (n, 2) float64
            In the target's units.
        """
        uv = self.frame.outward(w)
        uv[self.fixed] = self.target
        return uv

    @property
    def pins(self) -> IntArray:
        """Fixed vertices that are not on the boundary, ascending."""
        return np.setdiff1d(self.fixed, self.edges.boundary)

    @cached_property
    def encloses_area(self) -> bool:
        """Whether the target's boundary may enclose a positive area, as the triangles of an injective map add up to.

        False only where it certainly does not: all positions are equal, or the boundary is wound the wrong way.
        """
        w = np.zeros(self.n, dtype=np.complex128)
        w[self.fixed] = self.frame.inward(self.target)
        area = sum(0.5 * float((w[loop].conj() * np.roll(w[loop], -1)).imag.sum()) for loop in self.loops)
        # The frame is of unit size, so rounding stays far below this.
        return area > -1e-12 and bool(np.any(self.target != self.target[0]))

    @property
    def n(self) -> int:
        """Number of vertices."""
        return len(self.V)


class Frame:
    """Coordinates of unit size around the target, and back.

    The scale is a power of two, so going there and back costs no digits; positions at the fixed
    vertices are put back as they were given, to the last bit.

    Parameters
    ----------
    target : (k, 2) float64
        Positions of the fixed vertices.
    """

    def __init__(self, target: FloatArray) -> None:
        # Halved first: the extent of numbers near the largest double must not overflow.
        low, high = target.min(axis=0) / 2, target.max(axis=0) / 2
        self.centre = low + high
        self._exponent = int(np.frexp(np.max(high - low))[1])

    def inward(self, uv: FloatArray) -> ComplexArray:
        """Positions (n, 2) as complex numbers in the frame; (n,) complex128."""
        return np.ldexp(uv - self.centre, -self._exponent).view(np.complex128).ravel()

    def outward(self, w: ComplexArray) -> FloatArray:
        """Complex numbers of the frame (n,) as positions; (n, 2) float64."""
        return np.ldexp(w.view(np.float64).reshape(-1, 2), self._exponent) + self.centre


def _vertices(V: ArrayLike) -> FloatArray:
    array = real_array("V", V)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"V must have shape (n, 2) or (n, 3), not {array.shape}")
    check_finite("V", "vertex", "vertices", array)
    return array


def _triangles(F: ArrayLike, n: int) -> IntArray:
    array = index_array("F", F)
    if array.size == 0:
        raise ValueError("the mesh has no triangles")
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"F must have shape (f, 3), triangles only, not {array.shape}")
    check_range("F", array, n)
    return array


def _surface(F: IntArray, n: int) -> Edges:
    collapsed = np.flatnonzero((F[:, 0] == F[:, 1]) | (F[:, 1] == F[:, 2]) | (F[:, 2] == F[:, 0]))
    if collapsed.size:
        raise ValueError(f"{named('triangle', 'triangles', collapsed)}: a vertex is used twice in a triangle")
    used = np.zeros(n, dtype=bool)
    used[F] = True
    if not used.all():
        raise ValueError(f"{named('vertex', 'vertices', np.flatnonzero(~used))}: no triangle uses them; remove them")
    found = edges(F, n)
    if found.nonmanifold.size or found.inconsistent.size:
        _repeated(F)
    if found.nonmanifold.size:
        raise ValueError(f"{named_edges(found.nonmanifold)} in more than two triangles: not a surface")
    if found.inconsistent.size:
        raise ValueError(
            f"mixed winding: {named_edges(found.inconsistent)} traversed in the same direction by both triangles; "
            "orient all triangles alike"
        )
    if not found.boundary.size:
        raise ValueError(
            "the surface is closed: it has no boundary to place; cut it open first (cut_open; qhm map --cut)"
        )
    if components(F, n).any():
        first = np.unique(components(F, n))
        raise ValueError(
            f"the mesh has {first.size} components, the first ones around {named('vertex', 'vertices', first)}: "
            "map them one at a time"
        )
    return found


def _repeated(F: IntArray) -> None:
    corners = np.sort(F, axis=1)
    order = np.lexsort(corners.T)
    same = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    if same.any():
        repeats = np.sort(order[1:][same])
        raise ValueError(f"{named('triangle', 'triangles', repeats)} repeated: the same three vertices occur before")


def _positive_areas(V: FloatArray, F: IntArray) -> None:
    z1, z2 = rest_frames(V, F)
    flat = np.flatnonzero((z1 == 0) | (z2.imag == 0))
    if flat.size:
        raise ValueError(
            f"{named('triangle', 'triangles', flat)} of zero area in the rest mesh; "
            "choose the reference 'equilateral' to map it all the same"
        )


def _fixed(fixed: ArrayLike, n: int, found: Edges) -> IntArray:
    array = index_array("fixed", fixed)
    if array.ndim != 1:
        raise ValueError(f"fixed must have shape (k,), not {array.shape}")
    check_range("fixed", array, n)
    times = np.bincount(array, minlength=n)
    if times.max(initial=0) > 1:
        raise ValueError(f"{named('vertex', 'vertices', np.flatnonzero(times > 1))} fixed more than once")
    boundary = np.unique(found.boundary)
    missing = boundary[times[boundary] == 0]
    if missing.size:
        raise ValueError(
            f"the boundary {named('vertex', 'vertices', missing)} not in fixed: every boundary vertex needs a position"
        )
    return array


def _target(target: ArrayLike, k: int) -> FloatArray:
    array = real_array("target", target)
    if array.shape != (k, 2):
        raise ValueError(f"target must have shape ({k}, 2), a position for every fixed vertex, not {array.shape}")
    check_finite("target", "row", "rows", array)
    return array
