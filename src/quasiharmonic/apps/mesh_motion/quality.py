"""Quality of the shapes of elements."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.elements import corner_triangles, element_rows, jacobian_coefficients, min_jacobian
from quasiharmonic.util.arrays import FloatArray, IntArray, check_finite, map_array


def element_quality(F: ArrayLike, points: ArrayLike) -> FloatArray:
    """Return the shape quality of every element: at most 1, not positive if it is inverted somewhere.

    Parameters
    ----------
    F : (f, 3), (f, 4) or (f, 6) array of int
    points : (n, 2) array

    Returns
    -------
    (f,) float64
        Triangles: `quasiharmonic.energies.measures.mean_ratio`. Quadrilaterals: the least over the corners of
        ``2 a b sin φ / (a² + b²)`` with sides a and b at an angle φ; 1 for a square, exact sign.
        Six-node triangles: the mean ratio of the corners' triangle times the least Jacobian determinant over its mean.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype, ``F`` has indices out of range, or a node is not finite.

    See Also
    --------
    geometry.exact.jacobian_signs.inverted_elements : Elements whose quality is not positive.
    morph : Returns the quality before and after.

    Examples
    --------
    >>> from quasiharmonic.apps.mesh_motion.quality import element_quality
    >>> element_quality([[0, 1, 2, 3]], [[0, 0], [1, 0], [1, 1], [0, 1]]).tolist()
    [1.0]
    """
    points = map_array("points", points, finite=False)
    F = element_rows(F, len(points))
    check_finite("points", "vertex", "vertices", points, F)
    if F.shape[1] == 3:
        return mean_ratio(points, F)
    if F.shape[1] == 4:
        return _of_quadrilaterals(F, points)
    place = points[F] - points[F[:, :1]]
    # Scale each element separately, because coordinates are multiplied.
    place = np.ldexp(place, -np.frexp(np.abs(place).max(axis=(1, 2)))[1][:, None, None])
    x, y = place.transpose(2, 0, 1)
    values = jacobian_coefficients(x, y)
    mean = np.abs(values.mean(axis=1))
    even = min_jacobian(values) / np.where(mean > 0, mean, 1.0)
    return np.abs(mean_ratio(points, F[:, :3])) * even


def _of_quadrilaterals(F: IntArray, points: FloatArray) -> FloatArray:
    triangles, of = corner_triangles(F)
    before, corner, after = points[triangles].transpose(1, 0, 2)
    a, b = before - corner, after - corner
    longest = np.maximum(np.abs(a).max(axis=1), np.abs(b).max(axis=1))
    a, b = (side / np.where(longest > 0, longest, 1.0)[:, None] for side in (a, b))
    squares = (a * a).sum(axis=1) + (b * b).sum(axis=1)
    area = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.finfo(float).tiny)
    shape = orientation(before, corner, after) * 2 * area / np.where(squares > 0, squares, 1.0)
    triangular = (F[:, 2] == F[:, 3])[of]
    shape = np.where(triangular, mean_ratio(points, triangles), shape)
    least = np.full(len(F), np.inf)
    np.minimum.at(least, of, shape)
    return least
