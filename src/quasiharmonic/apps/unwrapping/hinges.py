"""Hinges: interior edges of a surface, where two triangles can be joined in the plane as in a paper model.

A side is an edge of one triangle. Side ``3 t + k`` runs from corner ``k`` of triangle ``t`` to the next corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.geometry.mesh.reference import cross, dot
from quasiharmonic.geometry.mesh.topology import ahead, find_pairs, previous_sides
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

#: Triangles on the two sides of an edge with at least this cost factor stay together, such as those of a polygon.
UNDIVIDED_COST = 1e3
#: Edges with at least this cost factor must not be seams. The diagonals of flat polygons have smaller factors.
KEPT_COST = 1e7
#: Sides with at most this cost factor must be seams.
DEMANDED_COST = 1e-9
# Two triangles lie in one plane if no corner of one is farther from the plane of the other than this, relative to the
# diagonal of the model's box. Files with six decimal digits store flat faces with such errors.
FLAT = 2e-6
# No two triangles with a larger angle between them, in radians, count as flat, however small they are.
_FLAT_ANGLE = np.pi / 180
# Lengths are rounded to this number of bits, so that equal lengths stay equal if a model is moved or rotated.
_BITS = 30
# Triangles with a smaller share of the area belong to no flat face: their planes are arbitrary.
_LEAST_AREA = 1e-9


@dataclass(frozen=True, eq=False)
class Hinges:
    """The interior edges (e,) of a surface.

    Attributes
    ----------
    one, other : (e,) int64
        Their two sides.
    angle : (e,) float64
        Angle between the normals of the two triangles in radians; negative where the surface is concave.
    length : (e,) float64
    flat : (e,) bool
        Whether both triangles lie in one plane.
    """

    one: IntArray
    other: IntArray
    angle: FloatArray
    length: FloatArray
    flat: BoolArray

    @property
    def first(self) -> IntArray:
        """The triangles (e,) of the sides ``one``."""
        return self.one // 3

    @property
    def second(self) -> IntArray:
        """The triangles (e,) of the sides ``other``."""
        return self.other // 3

    def ends(self, F: IntArray) -> IntArray:
        """Return the vertices (e, 2) of the hinges of triangles (f, 3), in the direction of the sides ``one``."""
        return np.stack([F.ravel()[self.one], F.ravel()[ahead(self.one)]], axis=1)

    def price(self, cost: FloatArray) -> FloatArray:
        """Return the length (e,) of each hinge times the mean of the factors (f, 3) of its two sides."""
        return self.length * (cost.ravel()[self.one] + cost.ravel()[self.other]) / 2

    def touch(self, sides: BoolArray) -> BoolArray:
        """Return the hinges (e,) with one or both of their sides among some sides (f, 3)."""
        return np.asarray(sides.ravel()[self.one] | sides.ravel()[self.other])

    def mark_sides(self, chosen: BoolArray, count: int) -> BoolArray:
        """Return a mask (count, 3) of the sides of chosen hinges (e,), given the number of triangles."""
        marked = np.zeros(3 * count, dtype=np.bool_)
        marked[self.one[chosen]] = marked[self.other[chosen]] = True
        return marked.reshape(-1, 3)


def find_hinges(V: FloatArray, F: IntArray) -> Hinges:
    """Return the hinges of a surface with positions (n, 3) and triangles (f, 3) that are not degenerate."""
    one, other = find_pairs(F)
    size = float(np.linalg.norm(np.ptp(V, axis=0)))
    points = np.ascontiguousarray(V.T) / size
    at = np.ascontiguousarray(points.take(F.ravel(), axis=1))
    corners = at.reshape(3, -1, 3)
    normal = cross(corners[..., 1] - corners[..., 0], corners[..., 2] - corners[..., 0])
    doubled = np.sqrt(dot(normal, normal))
    normal /= np.maximum(doubled, np.finfo(float).tiny)
    tiny = doubled <= _LEAST_AREA * doubled.sum()
    start = at.take(one, axis=1)
    along = at.take(ahead(one), axis=1) - start
    length = np.sqrt(dot(along, along))
    a, b = normal.take(one // 3, axis=1), normal.take(other // 3, axis=1)
    sine = cross(a, b)
    angle = np.arctan2(np.sqrt(dot(sine, sine)), dot(a, b))
    above = dot(at.take(previous_sides(other), axis=1) - start, a)
    height = np.maximum(np.abs(above), np.abs(dot(at.take(previous_sides(one), axis=1) - start, b)))
    flat = (height <= FLAT) & (angle <= _FLAT_ANGLE) & ~(tiny[one // 3] | tiny[other // 3])
    fraction, exponent = np.frexp(length * size)
    rounded = np.ldexp(np.rint(np.ldexp(fraction, _BITS)), exponent - _BITS)
    return Hinges(one, other, np.where(above > 0, -angle, angle), rounded, flat)
