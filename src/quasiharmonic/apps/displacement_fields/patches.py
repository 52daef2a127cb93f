"""Patches around the folds of a field, and a map without folds that agrees with the field outside them.

The pixels of folded cells and some pixels around them become free. Inside each patch, displacements become harmonic. If
the result still folds, the patch grows and merges with patches that it meets. If a patch becomes the whole grid, the
field is smoothed until it does not fold. This always ends, as smoothing converges to a translation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.apps.displacement_fields.grid import PixelGrid, find_points, grow, label_patches
from quasiharmonic.linsolve import make_solver
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray

if TYPE_CHECKING:
    from scipy.sparse import dia_array

# Distance in pixels around folded cells that becomes free.
_MARGIN = 2
# Factor of that distance for patches that still fold.
_GROWTH = 2
# Growth factor of the smoothing's standard deviation in pixels.
_SMOOTHER = 1.2


class FixedPixelsError(Exception):
    """Because of fixed pixels, no map without folds was found; ``mask`` (h, w) marks the pixels of the folds."""

    def __init__(self, mask: BoolArray) -> None:
        super().__init__("the fixed pixels allow no field without folds")
        self.mask = mask


def find_folds(grid: PixelGrid, w: ComplexArray, min_jacobian: float) -> BoolArray:
    """The cells (h − 1, w − 1) with a corner whose determinant is not above ``min_jacobian``."""
    return np.asarray(~(grid.jacobians(w) > min_jacobian).all(axis=2))


def fill_patches(
    grid: PixelGrid, given: ComplexArray, fixed: BoolArray, min_jacobian: float
) -> tuple[ComplexArray, IntArray]:
    """Find a map without folds that agrees with the given one (h, w), in the grid's unit, outside some patches.

    Return the map and the patch (h, w) of each free pixel, from 1 on; 0 for all others. Raise FixedPixelsError if no
    such map was found, which can only happen with fixed pixels.
    """
    w, steps = given.copy(), _MARGIN
    free = grow(find_points(find_folds(grid, given, min_jacobian)), steps, fixed)
    while not free.all():
        patch = label_patches(free)
        _fill(grid, w, given, free)
        wrong = find_folds(grid, w, min_jacobian)
        if not wrong.any():
            return w, patch
        steps *= _GROWTH
        failed = np.unique(patch[find_points(wrong)])
        larger = grow(np.isin(patch, failed[failed > 0]) | find_points(wrong), steps, fixed) | free
        if np.array_equal(larger, free):
            raise FixedPixelsError(find_points(wrong))
        free = larger
    return _smooth(grid, given, min_jacobian), label_patches(free)


def _fill(grid: PixelGrid, w: ComplexArray, given: ComplexArray, free: BoolArray) -> None:
    """Make the displacements of free pixels harmonic, given the others; natural conditions at the grid's border."""
    from scipy.sparse import csr_array, dia_array, kron, triu

    inside, moved = np.flatnonzero(free), (given - grid.rest).ravel()
    (rows, columns), aspect = grid.shape, grid.spacing[1] / grid.spacing[0]
    across, along = (dia_array((np.ones((1, count)), [0]), shape=(count, count)) for count in (rows, columns))
    laplacian = aspect * kron(across, _path(columns)) + kron(_path(rows), along) / aspect
    own_rows = csr_array(laplacian)[inside]
    load = -(own_rows @ np.where(free.ravel(), 0, moved))
    matrix = csr_array(triu(own_rows[:, inside], format="csr"))
    matrix.sort_indices()
    with make_solver(matrix.indptr, matrix.indices) as solver:
        solver.factor(matrix.data)
        answer = solver.solve(np.stack([load.real, load.imag], axis=1))
    w[:] = given
    w.ravel()[inside] = grid.rest.ravel()[inside] + answer[:, 0] + 1j * answer[:, 1]


def _path(count: int) -> dia_array:
    """The Laplacian of a path of points."""
    from scipy.sparse import dia_array

    bands = np.full((3, count), -1.0)
    bands[1] = 2
    bands[1, [0, -1]] = 1
    return dia_array((bands, [-1, 0, 1]), shape=(count, count))


def _smooth(grid: PixelGrid, given: ComplexArray, min_jacobian: float) -> ComplexArray:
    """Smooth the displacements by the smallest tried Gaussian that leaves no fold."""
    from scipy.ndimage import gaussian_filter

    moved, deviation = given - grid.rest, 1.0
    while deviation < max(grid.shape):
        smooth = [gaussian_filter(part, deviation, mode="nearest") for part in (moved.real, moved.imag)]
        w: ComplexArray = grid.rest + smooth[0] + 1j * smooth[1]
        if not find_folds(grid, w, min_jacobian).any():
            return w
        deviation *= _SMOOTHER
    return grid.rest + moved.mean()
