"""The Jacobian determinant of second-order triangles, in Bernstein form.

A triangle of six nodes ``X`` is the image of the reference triangle under a quadratic map. The derivatives towards the
second and the third corner are linear in the barycentric coordinates λ, so the determinant is a quadratic form,

    2 J(λ) = Σᵢⱼ λᵢ λⱼ cᵢⱼ,        cᵢⱼ = xᵀ Sᵢⱼ y.

The six coefficients are its Bézier control values, one for each corner and each side. They are bilinear in the
coordinates x and y of the nodes, with antisymmetric integer matrices Sᵢⱼ. If the sides are straight and the mid-side
nodes lie at their midpoints, all coefficients equal four times the area.

References
----------
A. Johnen, J.-F. Remacle, C. Geuzaine, Geometrical validity of curvilinear finite elements. Journal of Computational
Physics 233 (2013).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray

#: The corners of each coefficient: a corner twice, or two corners.
PAIRS = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)])


def _forms() -> IntArray:
    """The matrices Sᵢⱼ of the six coefficients; (6, 6, 6) int64."""
    # Twice the Bézier points of the element by its nodes: corners, and 2 · middle − half of either end.
    net = np.zeros((3, 3, 6), dtype=np.int64)
    for corner in range(3):
        net[corner, corner, corner] = 2
    for middle, (i, j) in zip((3, 4, 5), ((0, 1), (1, 2), (2, 0)), strict=True):
        net[i, j, middle] = net[j, i, middle] = 4
        net[i, j, [i, j]] = net[j, i, [i, j]] = -1
    # The derivatives towards corners 1 and 2, at corner i.
    along, across = net[1] - net[0], net[2] - net[0]
    forms = [np.outer(along[i], across[j]) + np.outer(along[j], across[i]) for i, j in PAIRS]
    return np.array([form - form.T for form in forms])


#: Sᵢⱼ in the order of `PAIRS`; (6, 6, 6) int64.
FORMS = _forms()


def jacobian_coefficients(x: FloatArray, y: FloatArray) -> FloatArray:
    """Control values (f, 6) of twice the Jacobian determinant, in floating point, for coordinates (f, 6) of nodes.

    They have the order of `PAIRS`: three corners, then the sides 01, 12 and 20.
    """
    return np.asarray(np.einsum("fa,kab,fb->fk", x, FORMS.astype(np.float64), y, optimize=True))


def min_jacobian(values: FloatArray) -> FloatArray:
    """Minimum of quadratic forms on the triangle where barycentric coordinates are non-negative.

    ``values`` (f, 6) are control values, as returned by `jacobian_coefficients`. The result is correct up to rounding
    relative to the largest control value. The minimum is attained at a corner, or at a critical point on a side or in
    the interior.
    """
    scale = np.abs(values).max(axis=1)
    values = values / np.where(scale > 0, scale, 1.0)[:, None]
    (a, b, c), (ab, bc, ca) = values[:, :3].T, values[:, 3:].T
    lowest = np.minimum(np.minimum(a, b), c)
    for start, end, between in ((a, b, ab), (b, c, bc), (c, a, ca)):
        fall, rise = start - between, end - between
        within = (fall > 0) & (rise > 0)
        share = fall / np.where(within, fall + rise, 1.0)
        lowest = np.where(within, np.minimum(lowest, start - fall * share), lowest)
    # Slopes at the first corner towards the second and the third, and half the second derivatives. For straight sides
    # these are noise, and so is the critical point. The form is evaluated there, so noise cannot give too low a
    # minimum.
    second, third, bb, cc, cross = ab - a, ca - a, a + b - 2 * ab, a + c - 2 * ca, a + bc - ab - ca
    det = bb * cc - cross**2
    convex = (det > 0) & (bb > 0)
    at = np.stack([cross * third - cc * second, cross * second - bb * third]) / np.where(convex, det, 1.0)
    inside = convex & (at > 0).all(axis=0) & (at.sum(axis=0) < 1)
    s, t = np.where(inside, at, 0.0)
    value = a + 2 * (second * s + third * t) + bb * s**2 + cc * t**2 + 2 * cross * s * t
    return np.asarray(scale * np.minimum(lowest, value))
