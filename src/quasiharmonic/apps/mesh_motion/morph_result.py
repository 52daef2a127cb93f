"""Result of a morph: the nodes of the mesh, its inverted elements, and the drift of a chain of steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.apps.tetrahedra.result import describe_qualities, summarise_qualities
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.exact.triangles import find_overlapping
from quasiharmonic.geometry.mesh.elements import (
    corner_triangles,
    covering_triangles,
    jacobian_coefficients,
    name_elements,
)
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import FloatArray, IntArray, count_of, mark
from quasiharmonic.util.outcome import Displayable, OutcomeOf, SummarisedOutcome, as_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class MorphResult(SummarisedOutcome, OutcomeOf, Displayable):
    """A planar mesh after its boundary has moved.

    Attributes
    ----------
    points : (n, 2) float64
        All nodes; those in no element keep their positions.
    F : (f, 3), (f, 4) or (f, 6) int64
        The elements in the given order, counterclockwise at rest.
    inverted : (k,) int64
        Elements that are inverted or degenerate somewhere, verified exactly on ``points``; see
        `quasiharmonic.geometry.exact.jacobian_signs`.
    forbidden : (k,) int64
        Inverted elements that are inverted by nodes with given positions alone; no placement of the other nodes can
        untangle them.
    result : MapResult
        The search: status, certificate, stages, seconds. Its ``uv`` has the nodes of the triangles that were searched,
        in their order. There are two triangles per quadrilateral. A six-node triangle is searched by its corners, and
        its mid-side nodes are placed afterwards; if that fails, as four triangles with all nodes. The certificate is
        that of these triangles; curved elements can be valid although one of these triangles is inverted.
    quality_before, quality_after : (f,) float64
        `quasiharmonic.apps.mesh_motion.quality.element_quality` of every element: 1 for an equilateral triangle or a
        square, 0 without area, negative if inverted.
    points_before : (n, 2) float64
        All nodes before the morph.

    See Also
    --------
    morph : Makes it.
    TetrahedraResult : The result for tetrahedra.

    Examples
    --------
    >>> from quasiharmonic import morph
    >>> from quasiharmonic.surfaces import grid
    >>> points, F = grid(4, 4)
    >>> morphed = morph(points, F, [24], [[1.2, 1.3]])
    >>> morphed.success, morphed.points[24].tolist(), morphed.inverted.tolist()
    (True, [1.2, 1.3], [])
    """

    points: FloatArray
    F: IntArray
    inverted: IntArray
    forbidden: IntArray
    result: MapResult
    quality_before: FloatArray
    quality_after: FloatArray
    points_before: FloatArray
    _one_step: Callable[[], FloatArray] = field(repr=False)

    @property
    def valid(self) -> bool:
        """Whether no element is inverted or degenerate anywhere, verified exactly."""
        return not self.inverted.size

    @property
    def success(self) -> bool:
        """Whether the mesh is valid and the call was not interrupted."""
        return self.valid and self.status.acceptable

    def drift(self) -> float:
        """Return the maximum distance of a node from its position after one step from the rest mesh.

        The boundary and pins of that step are those of this mesh.

        Each call computes such a step; NaN if it finds no valid mesh. For a chain of steps that all use the first mesh
        as ``rest``, the drift is small and falls with ``tol``. It is large if the energy has several minima and
        the chain has reached another one.
        """
        used = np.unique(self.F)
        return float(np.hypot(*(self.points[used] - self._one_step()[used]).T).max())

    def summary(self) -> str:
        """Return a text that says whether the mesh is valid, and otherwise what is wrong."""
        qualities = self.describe_quality()
        ended_early = self.status in (Status.INTERRUPTED, Status.OUT_OF_ITERATIONS)
        lines = [self.status.value] if ended_early else []
        if self.valid:
            lines += [f"None of {count_of('element', 'elements', len(self.F))} is inverted anywhere.", qualities]
            return "\n".join([*lines, *describe_overlap(self.F, self.points)[1]])
        where = f"Inverted or degenerate somewhere: {name_elements(self.F, self.inverted)}."
        advice = " Move the boundary less or in several steps, and keep inner loops inside the outer loop."
        lines.append(where if ended_early else where + advice)
        if self.forbidden.size:
            lines.append(
                f"Inverted for every position of the free nodes: {name_elements(self.F, self.forbidden)}. Split "
                "these elements, or move their nodes less."
            )
        if not self.result.injective:
            if not ended_early:
                lines.append(self.status.value)
            if self.result.diagnosis is not None and self.result.diagnosis.obstructions:
                lines.append(self.result.diagnosis.summary())
        return "\n".join([*lines, qualities])

    def short_repr(self) -> str:
        """Return the first line of `summary`."""
        return self.message

    def plot(self) -> Figure:
        """Draw the mesh before and after, coloured by element quality, and histograms of the quality.

        Returns
        -------
        matplotlib Figure
            Inverted elements are red. Notebooks display the figure directly.
        """
        return self._draw("quality")

    def describe_quality(self) -> str:
        """Return a sentence on the quality before and after, and where to remesh if it has become poor."""
        return describe_qualities("element", self.F, self.points, self.quality_before, self.quality_after)

    def to_dict(self) -> dict[str, Any]:
        """Return the result for JSON."""
        return {
            **self.result.to_dict(),
            **as_plain(self, "success", "message", "valid", "inverted", "forbidden"),
            **summarise_qualities(self.quality_before, self.quality_after),
        }


def describe_overlap(F: IntArray, points: FloatArray) -> tuple[IntArray, list[str]]:
    """Return the elements (k,) that overlap others, and a sentence on them, if no element is inverted.

    Elements that only touch do not overlap. Six-node elements are judged by straight triangles between their nodes.
    """
    triangles, of = covering_triangles(F)
    certificate = certify(triangles, points)
    if certificate.bijective:
        return np.empty(0, dtype=np.int64), []
    found = np.unique(of[find_overlapping(triangles, points)])
    if F.shape[1] == 6 and (found.size or not certificate.injective):
        return found, ["The straight triangles between the nodes overlap, so the mesh may overlap itself."]
    return found, [f"The mesh overlaps itself: {name_elements(F, found)}."] if found.size else []


def find_forbidden(F: IntArray, points: FloatArray, given: IntArray) -> IntArray:
    """Return elements that are inverted at a corner whose relevant nodes all have given positions; ascending.

    Elements with straight sides that are degenerate there are returned, too; those with mid-side nodes are judged in
    floating point.
    """
    known = mark(len(points), given)
    if F.shape[1] == 6:
        x, y = (points[F] - points[F[:, :1]]).transpose(2, 0, 1)
        # At a corner the derivatives depend on the corners and on the midpoints of its two sides.
        nodes = np.array([(0, 1, 2, 3, 5), (0, 1, 2, 3, 4), (0, 1, 2, 4, 5)])
        return np.flatnonzero((known[F[:, nodes]].all(axis=2) & (jacobian_coefficients(x, y)[:, :3] < 0)).any(axis=1))
    triangles, of = (F, np.arange(len(F))) if F.shape[1] == 3 else corner_triangles(F)
    sign = orientation(*(points[triangles[:, k]] for k in range(3)))
    return np.unique(of[(sign <= 0) & known[triangles].all(axis=1)])
