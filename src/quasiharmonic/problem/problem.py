"""The question: a surface with some of its vertices held, and where these go."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, get_args, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.adapters.accepts_mesh import init_accepts_mesh
from quasiharmonic.io.adapters.objects import MeshLike
from quasiharmonic.problem.domain import Domain
from quasiharmonic.problem.frame import Frame
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, ReadOnly, check_choice, counted, held_places
from quasiharmonic.util.display import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Problem(ReadOnly, Displayable):
    """A mesh with positions in the plane for its boundary and any pinned interior vertices.

    What is malformed raises; what is merely hard or hopeless (a target that crosses itself, is wound
    the wrong way or admits no map) is accepted and ends in a result that says so.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
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
        With the first offending elements: what `Domain` refuses, boundary vertices without a position, and
        triangles of zero area in the rest mesh. Those last are accepted when the reference is
        ``"equilateral"`` or ``"corrected"`` by the caller's own word: that says that their shapes, and
        the distortion that nobody could measure, do not matter.

    Attributes
    ----------
    domain : Domain
        The surface and its held vertices, shared with all problems that `moved` makes of this one.
    target : (k, 2) float64
        As given; not writeable.
    """

    domain: Domain
    target: FloatArray
    reference: Reference | None

    @overload
    def __init__(
        self,
        V: ArrayLike,
        F: ArrayLike,
        fixed: ArrayLike,
        target: ArrayLike,
        *,
        reference: Reference | None = None,
    ) -> None: ...
    @overload
    def __init__(
        self, V: MeshLike, fixed: ArrayLike, target: ArrayLike, *, reference: Reference | None = None
    ) -> None: ...
    @init_accepts_mesh
    def __init__(
        self,
        V: ArrayLike,
        F: ArrayLike,
        fixed: ArrayLike,
        target: ArrayLike,
        *,
        reference: Reference | None = None,
    ) -> None:
        domain = Domain(V, F, fixed)
        domain.check_boundary_fixed()
        if reference is not None:
            check_choice("reference", reference, get_args(Reference))
        if reference is None or reference == "rest":
            domain.check_areas()
        self._pose(domain, target, reference)

    @classmethod
    def on(cls, domain: Domain, target: ArrayLike, *, reference: Reference | None = None) -> Problem:
        """A problem on a domain at hand, whose topology and symbolic factorisation it shares.

        Parameters
        ----------
        domain : Domain
            With its whole boundary held.
        target : (k, 2) array
            Where ``domain.fixed`` go.
        reference : {"equilateral", "rest", "corrected"}, optional
            As of `Problem`; rest areas are not looked at.

        Raises
        ------
        ValueError
            When there are not as many places as fixed vertices, or one is not finite.
        """
        problem = object.__new__(cls)
        problem._pose(domain, target, reference)
        return problem

    def _pose(self, domain: Domain, target: ArrayLike, reference: Reference | None) -> None:
        self.domain = domain
        self.target = held_places(target, len(domain.fixed))
        self.reference = reference
        self._seal()

    def _read_only(self) -> tuple[FloatArray]:
        return (self.target,)

    def with_target(self, target: ArrayLike) -> Problem:
        """The same problem with its fixed vertices elsewhere.

        Parameters
        ----------
        target : (k, 2) array
            New positions of ``fixed``.

        Returns
        -------
        Problem
            A new one on the same domain; this one stays as it is.

        Raises
        ------
        ValueError
            When there are not as many places as fixed vertices, or one is not finite.
        """
        return Problem.on(self.domain, target, reference=self.reference)

    @contextmanager
    def exclusive(self) -> Iterator[Problem]:
        """Give this problem, or a twin on a domain that nobody else is using; see `Domain.exclusive`."""
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
        """The domain's held vertices (k,) int64."""
        return self.domain.fixed

    def short_repr(self) -> str:
        loops = counted("boundary loop", "boundary loops", len(self.domain.loops))
        return f"{self.n:,} vertices, {len(self.F):,} triangles, {loops}, {len(self.fixed):,} fixed"

    def summary(self) -> str:
        """Say in a few lines what is to be mapped and where its fixed vertices go."""
        (left, lower), (right, upper) = self.target.min(axis=0), self.target.max(axis=0)
        curved = self.V.shape[1] == 3 and np.ptp(self.V[:, 2]) > 0
        loops = counted("boundary loop", "boundary loops", len(self.domain.loops))
        lengths = ", ".join(f"{len(loop):,}" for loop in self.domain.loops)
        return "\n".join(
            (
                f"{'A curved surface' if curved else 'A planar mesh'}: {self.n:,} vertices, {len(self.F):,} triangles.",
                f"{loops}, of {lengths} vertices; {counted('pin', 'pins', len(self.domain.pins))} inside.",
                f"The targets of its fixed vertices span [{left:.4g}, {right:.4g}] × [{lower:.4g}, {upper:.4g}].",
            )
        )

    def plot(self) -> Figure:
        """Draw the surface beside where its boundary and its pins go; a matplotlib Figure."""
        figure: Figure = self._draw("problem")
        return figure

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

    @cached_property
    def held(self) -> ComplexArray:
        """The fixed vertices' places in the frame, zero elsewhere (n,) complex128; not to be written to."""
        w = np.zeros(self.n, dtype=np.complex128)
        w[self.fixed] = self.frame.inward(self.target)
        return w

    @cached_property
    def encloses_area(self) -> bool:
        """Whether the target's boundary may enclose a positive area, as the triangles of an injective map add up to.

        False only where it certainly does not: all positions are equal, or the boundary is wound the wrong way.
        """
        area = 0.0
        for loop in self.domain.loops:
            x, y = self.held[loop].view(np.float64).reshape(-1, 2).T
            area += 0.5 * float((x[:-1] * y[1:] - y[:-1] * x[1:]).sum() + (x[-1] * y[0] - y[-1] * x[0]))
        # The frame is of unit size, so rounding stays far below this.
        return area > -1e-12 and bool(np.any(self.target != self.target[0]))
