"""The Jacobian determinant of second-order triangles, in Bernstein form.

A triangle of six nodes ``X`` is the image of the reference triangle under a quadratic map. Its derivatives towards the
second and the third corner are linear in the barycentric coordinates λ, so that the determinant is a quadratic form,

    2 J(λ) = Σᵢⱼ λᵢ λⱼ cᵢⱼ,        cᵢⱼ = xᵀ Sᵢⱼ y,

whose six coefficients, at the corners and for the sides between them, are its Bézier control values: bilinear in the
nodes' coordinates x and y, by antisymmetric matrices Sᵢⱼ of integers. Of a triangle with straight sides and the nodes
in their middles all of them are four times its area.

References
----------
A. Johnen, J.-F. Remacle, C. Geuzaine, Geometrical validity of curvilinear finite elements. Journal of Computational
Physics 233 (2013).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import FloatArray, IntArray

#: What each coefficient is for: a corner twice, or two corners.
PAIRS = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)])


def _forms() -> IntArray:
    """The matrices Sᵢⱼ of the six coefficients; (6, 6, 6) int64."""
    # Bézier points of the element, twice, by its nodes: corners, and 2 · middle − half of either end.
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
    """The control values of Jacobian determinants, in floating point.

    Parameters
    ----------
    x, y : (f, 6) float64
        Coordinates of each element's nodes.

    Returns
    -------
    (f, 6) float64
        In the order of `PAIRS`: at the three corners, then for the sides 01, 12 and 20. Twice the determinant's own.
    """
    return np.asarray(np.einsum("fa,kab,fb->fk", x, FORMS.astype(np.float64), y, optimize=True))


def least_jacobian(values: FloatArray) -> FloatArray:
    """The least value of quadratic forms on the triangle where barycentric coordinates are not negative.

    Parameters
    ----------
    values : (f, 6) float64
        As of `jacobian_coefficients`.

    Returns
    -------
    (f,) float64
        In floating point: at a corner, or where a side or the inside has a point at which the form is at rest.
    """
    corners, sides = values[:, :3], values[:, 3:]
    least = corners.min(axis=1)
    with np.errstate(all="ignore"):
        for k in range(3):
            a, b, ab = corners[:, k], corners[:, (k + 1) % 3], sides[:, k]
            bend = a + b - 2 * ab
            at_rest = (a * b - ab * ab) / bend
            least = np.where((bend > 0) & (ab < np.minimum(a, b)), np.minimum(least, at_rest), least)
        (a, b, c), (ab, bc, ca) = corners.T, sides.T
        # Where C λ = (ν, ν, ν): λ is the adjugate's row sums over their sum, and ν the determinant over it.
        rows = np.stack(
            [
                b * c - bc * bc + bc * ca - ab * c + ab * bc - b * ca,
                a * c - ca * ca + bc * ca - ab * c + ab * ca - a * bc,
                a * b - ab * ab + ab * bc - b * ca + ab * ca - a * bc,
            ]
        )
        det = a * (b * c - bc * bc) + ab * (bc * ca - ab * c) + ca * (ab * bc - b * ca)
        inside = (rows > 0).all(axis=0) | (rows < 0).all(axis=0)
        return np.where(inside, np.minimum(least, det / rows.sum(axis=0)), least)
