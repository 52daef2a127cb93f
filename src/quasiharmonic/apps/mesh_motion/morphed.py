"""A planar mesh after its boundary has moved: where its nodes are, what is inverted, how far a chain has drifted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.elements import corner_triangles, name_elements
from quasiharmonic.geometry.mesh.second_order import jacobian_coefficients
from quasiharmonic.problem.result import MapResult
from quasiharmonic.util.arrays import FloatArray, IntArray, counted


@dataclass(frozen=True, eq=False)
class MorphResult:
    """A planar mesh after its boundary has moved.

    Attributes
    ----------
    points : (n, 2) float64
        All nodes, those in no element where they were.
    F : (f, 3), (f, 4) or (f, 6) int64
        The elements in their order, all of them counterclockwise at rest.
    inverted : (k,) int64
        Elements that are inverted, or have no area, somewhere, decided exactly on ``points``: see
        `quasiharmonic.geometry.exact.jacobian_signs`.
    forbidden : (k,) int64
        Those of them that nodes on the boundary, or others that were given, invert by themselves: no placing of the
        other nodes would right them.
    result : MapResult
        The search: status, certificate, stages, seconds. Its ``uv`` has the nodes that elements use, in their order,
        and its triangles are those that cover the elements: two of a quadrilateral, four of a six-node triangle, whose
        mid-side nodes are placed after that.
    quality_before, quality_after : (f,) float64
        `quasiharmonic.apps.mesh_motion.quality.element_quality` of every element: 1 for an equilateral triangle and a
        square, 0 without area, negative where it is inverted.
    """

    points: FloatArray
    F: IntArray
    inverted: IntArray
    forbidden: IntArray
    result: MapResult
    quality_before: FloatArray
    quality_after: FloatArray
    _one_step: Callable[[], FloatArray] = field(repr=False)

    @property
    def valid(self) -> bool:
        """Whether no element is inverted anywhere, decided exactly."""
        return not self.inverted.size

    def drift(self) -> float:
        """How far a node is, at most, from where one step from the mesh at rest puts it, boundary and pins as here.

        It takes such a step, anew each time it is called; NaN where that finds no valid mesh. At the end of a chain
        whose steps have the first mesh as ``rest`` this is what is left of the way: a trifle that falls with
        ``tolerance``, unless the energy has several minima and the chain has come to another one.
        """
        return float(np.hypot(*(self.points - self._one_step()).T).max())

    def summary(self) -> str:
        """Say in a sentence or two whether the mesh is valid, and what is wrong if it is not."""
        if self.valid:
            return f"None of {counted('element', 'elements', len(self.F))} is inverted anywhere."
        lines = [f"Inverted or degenerate somewhere: {name_elements(self.F, self.inverted)}."]
        if self.forbidden.size:
            lines.append(
                f"Inverted for every position of the free nodes: {name_elements(self.F, self.forbidden)}. Move the "
                "boundary less there, or split these elements."
            )
        if not self.result.injective:
            lines.append(self.result.status.value)
            if self.result.diagnosis is not None and self.result.diagnosis.obstructions:
                lines.append(self.result.diagnosis.summary())
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        both = (("quality_before", self.quality_before), ("quality_after", self.quality_after))
        return {
            **self.result.to_dict(),
            "valid": self.valid,
            "inverted": self.inverted.tolist(),
            "forbidden": self.forbidden.tolist(),
            **{
                name: {"minimum": float(quality.min()), "mean": float(quality.mean()), "worst": int(quality.argmin())}
                for name, quality in both
            },
        }


def forbidden_elements(F: IntArray, points: FloatArray, given: IntArray) -> IntArray:
    """Elements that turn over, or have no area, at a corner of which all that matters is given; ascending.

    Parameters
    ----------
    F : (f, 3), (f, 4) or (f, 6) int64
    points : (n, 2) float64
    given : (k,) int64
        Nodes whose places are not open to choice.
    """
    known = np.zeros(len(points), dtype=bool)
    known[given] = True
    if F.shape[1] == 6:
        x, y = (points[F] - points[F[:, :1]]).transpose(2, 0, 1)
        # At a corner the derivatives depend on the corners and on the middles of the two sides there.
        nodes = np.array([(0, 1, 2, 3, 5), (0, 1, 2, 3, 4), (0, 1, 2, 4, 5)])
        return np.flatnonzero((known[F[:, nodes]].all(axis=2) & (jacobian_coefficients(x, y)[:, :3] < 0)).any(axis=1))
    triangles, of = (F, np.arange(len(F))) if F.shape[1] == 3 else corner_triangles(F)
    sign = orientation(*(points[triangles[:, k]] for k in range(3)))
    return np.unique(of[(sign <= 0) & known[triangles].all(axis=1)])
