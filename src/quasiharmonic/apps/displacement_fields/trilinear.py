"""Folds of a displacement field on voxels that is sampled with trilinear interpolation, as ITK and ANTs do."""

from __future__ import annotations

from itertools import product

import numpy as np

from quasiharmonic.apps.displacement_fields.voxels import VoxelGrid
from quasiharmonic.apps.tetrahedra.energy import cross
from quasiharmonic.util.arrays import BoolArray, FloatArray

# Coefficients of at most this multiple of a bound of their terms may be rounding errors.
_ROUNDING = 2.0**-46


def least_coefficients(grid: VoxelGrid, field: FloatArray) -> FloatArray:
    """Return the smallest Bernstein coefficient of the Jacobian determinant of each cell, (d − 1, h − 1, w − 1).

    On a cell, a derivative of the trilinear map is bilinear in the other two coordinates, so the determinant is a
    polynomial of degree two in each coordinate. It is at least its smallest Bernstein coefficient. Coefficients that
    may be rounding errors are lowered, so that positive ones are certain. A cell at rest has coefficients of 1.
    """
    _, h, w = grid.cell_shape
    least = np.empty(grid.cell_shape)
    for z, _, (by_x, by_y, by_z) in grid.each_layer(field, grid.spacing):
        total = np.zeros((3, 3, 3, h, w))
        bound = np.zeros((3, 3, 3, h, w))
        for j, k in product(range(2), repeat=2):
            a = by_x[:, k, j : j + h]
            for i, n in product(range(2), repeat=2):
                b = by_y[:, n, :, i : i + w]
                normal = cross(a, b)
                size = np.abs(a).sum(axis=0) * np.abs(b).sum(axis=0)
                for m, q in product(range(2), repeat=2):
                    c = by_z[:, 0, q : q + h, m : m + w]
                    at = k + n, j + q, i + m
                    total[at] += (normal * c).sum(axis=0)
                    bound[at] += size * np.abs(c).sum(axis=0)
        # A coefficient is the sum of its terms divided by three binomial coefficients.
        share = np.array([1.0, 0.5, 1.0])
        factor = (share[:, None, None] * share[:, None] * share)[..., None, None]
        least[z] = (factor * (total - _ROUNDING * bound)).min(axis=(0, 1, 2))
    return least


def trilinear_fold_free(grid: VoxelGrid, field: FloatArray) -> BoolArray:
    """Return the cells (d − 1, h − 1, w − 1) whose determinant is certainly positive everywhere."""
    return np.asarray(least_coefficients(grid, field) > 0)
