"""Patches around the folds of a field, and a map of each without folds that fits into the field around it.

The pixels of cells that fold are freed, and those a little way around them. Inside each patch displacements become
harmonic: as smooth as those around it let them be. Where that folds too, the patch grows, and what it meets it takes
in; a patch that has become the whole grid takes the field smoothed until it does not fold, as every field does in
the end: far enough smoothed it is a translation.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import BoolArray, ComplexArray, IntArray
from quasiharmonic.linsolve import make_solver
from quasiharmonic.registration.approach import touched_cells
from quasiharmonic.registration.grid import Grid

# How far around folded cells pixels are freed, and by what factor patches that fold still grow.
_REACH, _GROWTH = 2, 2
# Standard deviations of smoothing, in pixels, grow by this factor.
_SMOOTHER = 1.2
_EIGHT = np.ones((3, 3), dtype=bool)


class NoRoom(Exception):
    """Pixels that are held leave no map without folds that could be found; ``mask`` (h, w) says where."""

    def __init__(self, mask: BoolArray) -> None:
        super().__init__("pixels that are held leave no room")
        self.mask = mask


def folded(grid: Grid, w: ComplexArray, least: float) -> BoolArray:
    """The cells (h − 1, w − 1) of which a corner's determinant is at most ``least``."""
    cells: BoolArray = (grid.jacobians(w) <= least).any(axis=2)
    return cells


def corners_of(cells: BoolArray) -> BoolArray:
    """The pixels (h, w) of some cells (h − 1, w − 1)."""
    pixels = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1), dtype=bool)
    for y in (0, 1):
        for x in (0, 1):
            pixels[y : y + cells.shape[0], x : x + cells.shape[1]] |= cells
    return pixels


def labelled(free: BoolArray) -> IntArray:
    """Number the patches that free pixels (h, w) make, from 1 on: no cell has pixels of two."""
    from scipy.ndimage import label

    return np.asarray(label(free, structure=_EIGHT)[0], dtype=np.int64)


def grown(pixels: BoolArray, steps: int, held: BoolArray) -> BoolArray:
    """Pixels and all that are at most some steps away, by rows, columns or both, but for those that are held."""
    from scipy.ndimage import maximum_filter

    around: BoolArray = maximum_filter(pixels, 2 * steps + 1, mode="constant") & ~held
    return around


def filled_in(grid: Grid, given: ComplexArray, held: BoolArray, least: float) -> tuple[ComplexArray, IntArray]:
    """A map without folds that is the given one but for some patches.

    Parameters
    ----------
    grid : Grid
    given : (h, w) complex128
        A map in the grid's unit.
    held : (h, w) bool
        Pixels that stay.
    least : float
        What all determinants are to be above.

    Returns
    -------
    w : (h, w) complex128
    patch : (h, w) int64
        The patch of each pixel that has been freed, from 1 on, and 0 of all others.

    Raises
    ------
    NoRoom
        When none was found, which only pixels that are held can do.
    """
    w, steps = given.copy(), _REACH
    free = grown(corners_of(folded(grid, given, least)), steps, held)
    while True:
        patch = labelled(free)
        _fill(grid, w, given, patch)
        wrong = folded(grid, w, least)
        if not wrong.any():
            return w, patch
        if free.all():
            return _smoothed(grid, given, least), patch
        steps *= _GROWTH
        failed = np.unique(patch[corners_of(wrong)])
        larger = grown(np.isin(patch, failed[failed > 0]) | corners_of(wrong), steps, held) | free
        if np.array_equal(larger, free):
            raise NoRoom(corners_of(wrong))
        free = larger


def _fill(grid: Grid, w: ComplexArray, given: ComplexArray, patch: IntArray) -> None:
    """Make the displacements of free pixels harmonic, those of the others given, the grid's border free."""
    from scipy.sparse import coo_array

    free = patch.ravel() > 0
    place = np.cumsum(free) - 1
    size = int(np.count_nonzero(free))
    rest = (grid.points / grid.unit).view(np.complex128)[..., 0].ravel()
    moved = given.ravel() - rest
    pixel = np.arange(free.size).reshape(grid.shape)
    aspect = grid.spacing[1] / grid.spacing[0]
    diagonal, load = np.zeros(size), np.zeros(size, dtype=np.complex128)
    entries = []
    for tail, head, weight in (
        (pixel[:, :-1].ravel(), pixel[:, 1:].ravel(), aspect),
        (pixel[:-1].ravel(), pixel[1:].ravel(), 1 / aspect),
    ):
        for one, other in ((tail, head), (head, tail)):
            own = free[one]
            np.add.at(diagonal, place[one[own]], weight)
            rim = own & ~free[other]
            np.add.at(load, place[one[rim]], weight * moved[other[rim]])
        both = free[tail] & free[head]
        entries.append((place[tail[both]], place[head[both]], np.full(np.count_nonzero(both), -weight)))
    if np.all(free):
        return
    own = np.arange(size)
    row, column, value = (np.concatenate(part) for part in zip((own, own, diagonal), *entries, strict=True))
    matrix = coo_array((value, (row, column)), shape=(size, size)).tocsr()
    matrix.sort_indices()
    with make_solver(matrix.indptr, matrix.indices) as solver:
        solver.factor(matrix.data)
        answer = solver.solve(np.stack([load.real, load.imag], axis=1))
    w[:] = given
    w.ravel()[free] = rest[free] + answer[:, 0] + 1j * answer[:, 1]


def _smoothed(grid: Grid, given: ComplexArray, least: float) -> ComplexArray:
    """The map whose displacements are smoothed by a Gaussian, as little as leaves no fold."""
    rest = (grid.points / grid.unit).view(np.complex128)[..., 0]
    deviation = 1.0
    while True:
        w = rest + smoothed(given - rest, deviation)
        if not folded(grid, w, least).any():
            return w
        deviation *= _SMOOTHER
        if deviation > 10 * max(grid.shape):
            return rest + (given - rest).mean()


def smoothed(moved: ComplexArray, deviation: float) -> ComplexArray:
    """Displacements (h, w) smoothed by a Gaussian, its standard deviation in pixels."""
    from scipy.ndimage import gaussian_filter

    parts = [gaussian_filter(part, deviation, mode="nearest") for part in (moved.real, moved.imag)]
    return np.asarray(parts[0] + 1j * parts[1])
