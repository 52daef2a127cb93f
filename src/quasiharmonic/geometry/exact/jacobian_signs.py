"""Exact test of which elements are inverted somewhere, on the coordinates of their nodes as stored.

- A triangle of three nodes is inverted if it is not counterclockwise.
- A quadrilateral is inverted if one of the four triangles at its corners is not counterclockwise. The Jacobian
  determinant of the bilinear map has its minimum at a corner, so no other test is needed.
- A triangle of six nodes is inverted if the Jacobian determinant of its quadratic map is not positive everywhere,
  sides and corners included.

For six nodes the determinant is a quadratic form in barycentric coordinates
(`quasiharmonic.geometry.mesh.elements`). It must be positive for all non-negative coordinates, so the symmetric
matrix C of its control values must be *strictly copositive*. Positive control values are sufficient; positive values at
the corners are necessary. All other cases are decided without subdivision [1]_ [2]_. On the sides the condition is
``cᵢⱼ ≥ 0`` or ``cᵢⱼ² < cᵢᵢ cⱼⱼ``. If the sides pass, C fails if and only if ``det C ≤ 0`` and a column of its adjugate
is positive, which indicates a minimum inside. The undecided cases are computed in integers.

References
----------
.. [1] R. W. Cottle, G. J. Habetler, C. E. Lemke, On classes of copositive matrices. Linear Algebra and its Applications
   3 (1970).
.. [2] K. P. Hadeler, On copositive matrices. Linear Algebra and its Applications 49 (1983).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite
from quasiharmonic.geometry.mesh.elements import FORMS, corner_triangles, element_rows, jacobian_coefficients
from quasiharmonic.util.arrays import FloatArray, IntArray, map_array, to_integers

# Relative to the product of the extents. Differences, products and at most 36 terms each lose one unit, 2⁻⁵³.
_RELATIVE_BOUND = 64 * 2.0**-53 * float(np.abs(FORMS).sum(axis=(1, 2)).max())


def inverted_elements(F: ArrayLike, points: ArrayLike) -> IntArray:
    """Find the elements that are inverted or degenerate somewhere.

    Parameters
    ----------
    F : (f, 3), (f, 4) or (f, 6) array of int
        Elements, as in `quasiharmonic.geometry.mesh.elements`.
    points : (n, 2) array

    Returns
    -------
    (k,) int64
        Ascending indices; elements with a non-finite coordinate are included.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype, or ``F`` refers to nodes that do not exist.

    See Also
    --------
    inverted_triangles : The same for maps of triangles.
    apps.mesh_motion.quality.element_quality : The quality of each element.
    certify_tetrahedra : Checks tetrahedra.

    Examples
    --------
    >>> from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
    >>> inverted_elements([[0, 1, 2, 3]], [[0, 0], [1, 0], [0.1, 0.1], [0, 1]]).tolist()
    [0]
    """
    points = map_array("points", points, finite=False)
    F = element_rows(F, len(points))
    if F.shape[1] == 6:
        return _find_inverted_curved(points[F])
    triangles, of = (F, np.arange(len(F))) if F.shape[1] == 3 else corner_triangles(F)
    sign, _ = orientation_or_nonfinite(*(points[triangles[:, k]] for k in range(3)))
    return np.unique(of[sign <= 0])


def _find_inverted_curved(nodes: FloatArray) -> IntArray:
    """Inverted elements among second-order triangles (f, 6, 2); (k,) int64."""
    # Bound, with a margin, on the loss by underflow in products of numbers of magnitude at most one.
    underflow_bound = 2.0**-1000
    with np.errstate(all="ignore"):
        offsets = nodes - nodes[:, :1]
        exponent = np.frexp(np.abs(offsets).max(axis=(1, 2)))[1]
        offsets = np.ldexp(offsets, -exponent[:, None, None])
        extent = np.abs(offsets).max(axis=1).prod(axis=1)
        values = jacobian_coefficients(offsets[..., 0], offsets[..., 1])
        bound = (_RELATIVE_BOUND * extent + underflow_bound)[:, None]
        good, bad = (values > bound).all(axis=1), (values[:, :3] < -bound).any(axis=1)
    # Elements that are not finite are neither good nor bad here.
    for k in np.flatnonzero(~good & ~bad).tolist():
        bad[k] = not (np.isfinite(nodes[k]).all() and _is_positive_everywhere(nodes[k]))
    return np.flatnonzero(bad)


def _is_positive_everywhere(nodes: FloatArray) -> bool:
    """Whether the Jacobian determinant of one element (6, 2) is positive everywhere, in integer arithmetic."""
    integers = to_integers(nodes)
    x, y = integers[::2], integers[1::2]
    a, b, c, ab, bc, ca = (
        sum(s * p * q for row, p in zip(form, x, strict=True) for s, q in zip(row, y, strict=True))
        for form in FORMS.tolist()
    )
    if min(a, b, c) <= 0:
        return False
    if any(side <= 0 and side * side >= p * q for side, p, q in ((ab, a, b), (bc, b, c), (ca, c, a))):
        return False
    column = b * c - bc * bc, bc * ca - ab * c, ab * bc - b * ca
    det = a * column[0] + ab * column[1] + ca * column[2]
    return not (det <= 0 and min(column) > 0)
