"""Grids of voxels divided into tetrahedra: which cells a displacement field folds, and whether their surface crosses.

A field maps the voxel in slice z, row y and column x, at position ``p = (x, y, z) · spacing``, to
``p + field[z, y, x]``. A cell is the box between eight voxels. It is divided into six tetrahedra around its diagonal
from the first voxel to the last one: each walks along the three axes in one of their six orders. On a tetrahedron the
map is affine, and its determinant is the volume ratio. A cell *folds* if a determinant is not above a bound.
Trilinear interpolation gives a different map, which can fold although the tetrahedra are positive.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import Grid
from quasiharmonic.apps.tetrahedra.contacts import find_contacts
from quasiharmonic.apps.tetrahedra.descent import cross, dot
from quasiharmonic.apps.tetrahedra.elements import ExactSigns, inspect_faces
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Orders of the axes x, y, z, and the sign that makes the determinant of the steps positive at rest.
_ORDERS = tuple((p, int(np.linalg.det(np.eye(3)[list(p)]).round())) for p in permutations(range(3)))
# Floating-point determinants below this, relative to a bound of their terms and with a margin for underflow, are
# decided exactly.
_SURE, _UNDERFLOW = 2.0**-48, 2.0**-1000


class VoxelGrid(Grid):
    """A grid of voxels."""

    def number_cells(self, cells: BoolArray) -> IntArray:
        """Return the first voxels (k,) of cells given by a mask, voxels counted slice by slice."""
        return np.flatnonzero(np.pad(cells, ((0, 1), (0, 1), (0, 1))))

    def each_layer(self, field: FloatArray, scale: FloatArray) -> Iterator[tuple[int, FloatArray, list[FloatArray]]]:
        """Yield the number of every layer of cells, positions (3, 2, h, w), and their differences along x, y and z.

        The differences are divided by ``scale``, which has an entry for each coordinate.
        """
        for z in range(self.shape[0] - 1):
            heartbeat()
            p = np.moveaxis(self.positions(field, z, z + 2), -1, 0)
            yield z, p, [np.diff(p, axis=axis) / scale[:, None, None, None] for axis in (3, 2, 1)]

    def tetrahedra(self, cells: IntArray) -> IntArray:
        """The tetrahedra (6 k, 4) of cells given by their first voxels (k,), voxels counted slice by slice."""
        steps = np.array([1, self.shape[2], self.shape[1] * self.shape[2]])
        orders = []
        for order, sign in _ORDERS:
            row = np.cumsum([0, *steps[list(order)]])
            orders.append(row if sign > 0 else row[[1, 0, 2, 3]])
        return (cells[:, None, None] + np.array(orders)).reshape(-1, 4)


def in_units(field: FloatArray, spacing: ArrayLike) -> tuple[VoxelGrid, FloatArray, int]:
    """Divide a checked field and the spacing by a power of two, so that no product overflows or underflows.

    Returns the grid with the new spacing, the new field, and the exponent of the power.
    """
    grid = VoxelGrid(field.shape[:3], spacing)
    exponent = int(np.frexp(grid.spacing.max())[1])
    grid.spacing = np.ldexp(grid.spacing, -exponent)
    return grid, np.ldexp(field, -exponent), exponent


def find_folded_cells(grid: VoxelGrid, field: FloatArray, min_jacobian: float | None) -> BoolArray:
    """Cells (d − 1, h − 1, w − 1) with a determinant not above a bound; for None, not positive, decided exactly."""
    _, h, w = grid.cell_shape
    folds = np.zeros(grid.cell_shape, dtype=np.bool_)
    # For the bound, a cell has volume 1. Exact signs are those of the positions as stored.
    for z, p, steps in grid.each_layer(field, np.ones(3) if min_jacobian is None else grid.spacing):
        unsure = np.zeros((h, w), dtype=np.bool_)
        for order, sign in _ORDERS:
            at = [0, 0, 0]
            edges = []
            for axis in order:
                edges.append(steps[axis][:, at[2], at[1] : at[1] + h, at[0] : at[0] + w])
                at[axis] = 1
            a, b, c = edges
            D = sign * dot(a, cross(b, c))
            if min_jacobian is not None:
                folds[z] |= ~(min_jacobian < D)
            else:
                # Row sums bound the permanent, of which rounding is less than 2⁻⁴⁹; underflow loses less than the rest.
                size = np.abs(a).sum(axis=0) * np.abs(b).sum(axis=0) * np.abs(c).sum(axis=0)
                unsure |= ~(_SURE * size + _UNDERFLOW < D)
        if unsure.any():
            slices = VoxelGrid((2, *grid.shape[1:]), grid.spacing)
            T = slices.tetrahedra(slices.number_cells(unsure[None]))
            flat = np.moveaxis(p, 0, -1).reshape(-1, 3)
            wrong = (ExactSigns(flat)(T) <= 0).reshape(-1, 6).any(axis=1)
            folds[z][np.nonzero(unsure)] = wrong
    return folds


def surface_crosses(grid: VoxelGrid, field: FloatArray) -> bool:
    """Whether triangles of the surface of the mapped grid meet outside their common vertices and edges."""
    cells, voxel = np.ones(grid.cell_shape, dtype=np.bool_), np.ones(grid.shape, dtype=np.bool_)
    for border in (cells, voxel):
        border[1:-1, 1:-1, 1:-1] = False
    F = inspect_faces(grid.tetrahedra(grid.number_cells(cells)), voxel.size).boundary
    F = F[voxel.ravel()[F].all(axis=1) & _on_one_side(grid, F)]
    nodes, number = np.unique(F, return_inverse=True)
    X = grid.positions(field).reshape(-1, 3)[nodes]
    return len(find_contacts(number.reshape(-1, 3), X, ExactSigns(X))) > 0


def _on_one_side(grid: VoxelGrid, F: IntArray) -> BoolArray:
    """Whether the voxels of triangles (f, 3) lie on one side of the grid."""
    index = np.stack(np.unravel_index(F, grid.shape), axis=-1)
    last = np.array(grid.shape) - 1
    return np.asarray(((index == 0).all(axis=1) | (index == last).all(axis=1)).any(axis=1))
