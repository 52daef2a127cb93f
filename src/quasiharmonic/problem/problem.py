"""The mapping problem: a surface, its fixed vertices and their target positions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, get_args, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.accepts_mesh import init_accepts_mesh
from quasiharmonic.io.objects import MeshLike
from quasiharmonic.problem.domain import Domain
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    ReadOnly,
    check_choice,
    count_of,
    describe,
    target_positions,
    to_complex,
    to_points,
)
from quasiharmonic.util.outcome import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def check_problem(function: str, problem: object, remedy: str = "") -> None:
    """Raise a TypeError unless a function of the given name was passed a Problem."""
    if not isinstance(problem, Problem):
        raise TypeError(f"{function} takes a Problem, not {describe(problem)}{remedy}")


class Problem(ReadOnly, Displayable):
    """A mesh with target positions for its boundary and any pinned interior vertices.

    Malformed input raises an error. Targets that cross themselves, have the wrong orientation or admit no map are
    accepted; the result then reports the failure.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions, planar or curved; any real dtype.
    F : (f, 3) array of int
        Triangles, 0-based and consistently oriented. Their order is kept. The target needs the orientation of the mesh:
        counterclockwise around a mesh of counterclockwise triangles.
    fixed : (k,) array of int
        Fixed vertices: the whole boundary, and any interior vertices.
    target : (k, 2) array
        Their target positions, in the order of ``fixed``; any real dtype.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (see `ReferenceMesh`). It overrides the choice of the
        strategy.

    Raises
    ------
    ValueError
        With the first offending elements: for the conditions that `Domain` checks, boundary vertices that are not
        fixed, and triangles of zero area in the rest mesh. With an explicit reference ``"equilateral"`` or
        ``"corrected"``, triangles of zero area are accepted.

    Attributes
    ----------
    domain : Domain
        The surface and its fixed vertices. Problems that `with_target` returns share it.
    target : (k, 2) float64
        Target positions as given; not writeable.

    See Also
    --------
    solve : Searches for a map.
    diagnose : Checks whether a map can exist.
    refine_problem : Splits edges that prevent a map.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> problem = Problem(V, F, rim, V[rim])
    >>> problem.with_target(2 * V[rim]).domain is problem.domain
    True
    """

    domain: Domain
    target: FloatArray
    reference: Reference | None

    @overload
    def __init__(
        self, V: ArrayLike, F: ArrayLike, fixed: ArrayLike, target: ArrayLike, *, reference: Reference | None = None
    ) -> None: ...
    @overload
    def __init__(
        self, V: MeshLike, fixed: ArrayLike, target: ArrayLike, *, reference: Reference | None = None
    ) -> None: ...
    @init_accepts_mesh
    def __init__(
        self, V: ArrayLike, F: ArrayLike, fixed: ArrayLike, target: ArrayLike, *, reference: Reference | None = None
    ) -> None:
        if fixed is None:
            raise ValueError("fixed must list the vertices with target positions, not None")
        domain = Domain(V, F, fixed)
        domain.check_boundary_fixed()
        if reference is not None:
            check_choice("reference", reference, get_args(Reference))
        if reference is None or reference == "rest":
            domain.check_areas()
        self._initialise(domain, target, reference)

    @classmethod
    def on(cls, domain: Domain, target: ArrayLike, *, reference: Reference | None = None) -> Problem:
        """Return a problem on an existing domain, sharing its topology and symbolic factorisation.

        Parameters
        ----------
        domain : Domain
            A domain whose whole boundary is fixed.
        target : (k, 2) array
            Target positions of ``domain.fixed``.
        reference : {"equilateral", "rest", "corrected"}, optional
            As in `Problem`. Rest areas are not checked.

        Raises
        ------
        ValueError
            If the number of target positions differs from the number of fixed vertices, or one is not finite.
        """
        problem = object.__new__(cls)
        problem._initialise(domain, target, reference)
        return problem

    def _initialise(self, domain: Domain, target: ArrayLike, reference: Reference | None) -> None:
        self.domain = domain
        self.target = target_positions(target, len(domain.fixed))
        self.reference = reference
        self._seal()

    def _read_only(self) -> tuple[FloatArray]:
        return (self.target,)

    def with_target(self, target: ArrayLike) -> Problem:
        """Return the same problem with other target positions.

        Parameters
        ----------
        target : (k, 2) array
            New positions of ``fixed``.

        Returns
        -------
        Problem
            A new problem on the same domain; this problem is not modified.

        Raises
        ------
        ValueError
            If the number of target positions differs from the number of fixed vertices, or one is not finite.
        """
        return Problem.on(self.domain, target, reference=self.reference)

    @contextmanager
    def exclusive(self) -> Iterator[Problem]:
        """Yield this problem, or an equal problem on an unused copy of its domain; see `Domain.exclusive`."""
        with self.domain.exclusive() as domain:
            yield self if domain is self.domain else Problem.on(domain, self.target, reference=self.reference)

    @property
    def V(self) -> FloatArray:
        """The domain's rest positions (n, 2) or (n, 3) float64."""
        return self.domain.V

    @property
    def F(self) -> IntArray:
        """The domain's triangles (f, 3) int64."""
        return self.domain.F

    @property
    def n(self) -> int:
        """Number of vertices."""
        return self.domain.n

    @property
    def fixed(self) -> IntArray:
        """The domain's fixed vertices (k,) int64."""
        return self.domain.fixed

    def short_repr(self) -> str:
        loops = count_of("boundary loop", "boundary loops", len(self.domain.loops))
        return f"{self.n:,} vertices, {len(self.F):,} triangles, {loops}, {len(self.fixed):,} fixed"

    def summary(self) -> str:
        """Return a few lines of text about the mesh and the extent of its target positions."""
        (left, lower), (right, upper) = self.target.min(axis=0), self.target.max(axis=0)
        curved = self.V.shape[1] == 3 and np.ptp(self.V[:, 2]) > 0
        loops = count_of("boundary loop", "boundary loops", len(self.domain.loops))
        lengths = ", ".join(f"{len(loop):,}" for loop in self.domain.loops)
        return "\n".join(
            (
                f"{'A curved surface' if curved else 'A planar mesh'}: {self.n:,} vertices, {len(self.F):,} triangles.",
                f"{loops}, of {lengths} vertices; {count_of('pin', 'pins', len(self.domain.pins))} inside.",
                f"The targets of its fixed vertices span [{left:.4g}, {right:.4g}] × [{lower:.4g}, {upper:.4g}].",
            )
        )

    def plot(self) -> Figure:
        """Draw the surface beside the target positions of its boundary and pins; return a matplotlib Figure."""
        return self._draw("problem")

    @cached_property
    def frame(self) -> Frame:
        """The `Frame`, the coordinates in which the problem is solved."""
        return Frame(self.target)

    def place_fixed(self, other: float = 0.0) -> FloatArray:
        """Return positions (n, 2) with fixed vertices at their targets and both coordinates of the others ``other``."""
        uv = np.full((self.n, 2), other)
        uv[self.fixed] = self.target
        return uv

    def positions(self, w: ComplexArray) -> FloatArray:
        """Return the positions of a map in the target's units, with fixed vertices exactly at their targets.

        Parameters
        ----------
        w : (n,) complex128
            Positions u + iv in the coordinates of `frame`.

        Returns
        -------
        (n, 2) float64
            Positions in the target's units.
        """
        uv = self.frame.outward(w)
        uv[self.fixed] = self.target
        return uv

    @cached_property
    def fixed_positions(self) -> ComplexArray:
        """Target positions of the fixed vertices in the frame, zero elsewhere (n,) complex128; do not write to it."""
        w = np.zeros(self.n, dtype=np.complex128)
        w[self.fixed] = self.frame.inward(self.target)
        return w

    @cached_property
    def encloses_area(self) -> bool:
        """Whether the target's boundary may enclose a positive area, which an injective map requires.

        False is certain: all positions are equal, or the boundary has the wrong orientation.
        """
        area = 0.0
        for loop in self.domain.loops:
            x, y = to_points(self.fixed_positions[loop]).T
            area += 0.5 * float((x[:-1] * y[1:] - y[:-1] * x[1:]).sum() + (x[-1] * y[0] - y[-1] * x[0]))
        # The frame has unit size, so rounding errors are far below this tolerance.
        return area > -1e-12 and bool(np.any(self.target != self.target[0]))


class Frame:
    """Coordinates of unit size around target positions (k, 2), and the conversion back.

    The scale is a power of two, so scaling loses no digits. `Problem.positions` then sets the fixed vertices to their
    exact target positions.
    """

    def __init__(self, target: FloatArray) -> None:
        # Halving first avoids overflow in the extent of coordinates near the largest double.
        low, high = target.min(axis=0) / 2, target.max(axis=0) / 2
        self.centre = low + high
        self._exponent = math.frexp((high - low).max())[1]

    def inward(self, uv: FloatArray) -> ComplexArray:
        """Return positions (n, 2) as complex numbers in the frame; (n,) complex128."""
        return to_complex(np.ldexp(uv - self.centre, -self._exponent))

    def lengths(self, x: FloatArray) -> FloatArray:
        """Return lengths or displacements in the frame's unit, without translation; an array of the same shape."""
        return np.ldexp(x, -self._exponent)

    def outward(self, w: ComplexArray) -> FloatArray:
        """Return complex numbers of the frame (n,) as positions; (n, 2) float64."""
        return np.ldexp(to_points(w), self._exponent) + self.centre
