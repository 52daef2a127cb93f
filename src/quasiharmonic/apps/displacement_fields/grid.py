"""Displacement fields on a grid of pixels or voxels, and the condition under which a field of pixels folds.

A field maps the pixel in row y and column x, at the position ``p = (x · spacing_x, y · spacing_y)``, to
``p + field[y, x]``. Between pixels, displacements are interpolated bilinearly, as in registration software. A cell is
the square between four pixels. On it the Jacobian determinant of the map is an affine function of the coordinates. At
each corner the determinant is the area ratio of the triangle of the corner and its two neighbours. So the determinant
is positive on the whole cell if and only if all four *corner triangles* are positive. This holds if and only if the
cell's image is strictly convex and not mirrored; both diagonals then cut it into positive triangles [1]_. Central
differences can be positive everywhere in a field that folds.

::

    0 ── 1      corner triangles 0 1 2, 1 3 0, 2 0 3, 3 2 1: each starts at its corner and turns
    │    │      from the x axis to the y axis
    2 ── 3

References
----------
.. [1] Y. Liu, J. Chen, S. Wei, A. Carass, J. Prince, On finite difference Jacobian computation in deformable image
   registration. International Journal of Computer Vision (2024).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, convert_array, names_of, real_array
from quasiharmonic.util.outcome import SummarisedOutcome

# Corner triangles of a cell whose vertices are numbered along x and then along y.
_TRIANGLES = np.array([[0, 1, 2], [1, 3, 0], [2, 0, 3], [3, 2, 1]])


class FieldStep(NamedTuple):
    """Progress of the search for the nearest field."""

    iteration: int  # Steps of the current descent
    patches: int  # Patches that have not converged
    points: int  # Free pixels or voxels of the current descent


class _Words(NamedTuple):
    """Words for the points of a grid, in messages."""

    one: str
    many: str
    indices: str
    sides: str
    field: str


# By the number of dimensions.
_WORDS = {
    2: _Words(
        "pixel",
        "pixels",
        "row and column",
        "two (along x and along y)",
        "(height, width, 2), displacements along x and y for at least 2 × 2 pixels",
    ),
    3: _Words(
        "voxel",
        "voxels",
        "slice, row and column",
        "three (along x, y and z)",
        "(depth, height, width, 3), displacements along x, y and z for at least 2 × 2 × 2 voxels",
    ),
}


class Grid:
    """A grid of pixels of a shape (h, w) or voxels (d, h, w), at least two along each axis.

    ``spacing`` are the distances between neighbours along x, along y, and along z; one number stands for all. Raises
    ValueError if they are not positive.
    """

    def __init__(self, shape: tuple[int, ...], spacing: ArrayLike = 1.0) -> None:
        sides = real_array("spacing", spacing)
        if sides.shape not in ((), (len(shape),)) or not (np.isfinite(sides) & (sides > 0)).all():
            raise ValueError(f"spacing must be a positive number, or {_WORDS[len(shape)].sides}, not {spacing!r}")
        self.shape = shape
        self.spacing: FloatArray = np.broadcast_to(sides, len(shape)).copy()

    @property
    def cell_shape(self) -> tuple[int, ...]:
        """The shape of an array with one entry per cell."""
        return tuple(count - 1 for count in self.shape)

    def positions(self, field: FloatArray, begin: int = 0, stop: int | None = None) -> FloatArray:
        """Return the positions of the mapped points, those of rows or slices ``begin`` to ``stop``."""
        p = field[begin:stop].copy()
        last = len(self.shape) - 1
        for axis, (count, side) in enumerate(zip(self.shape[::-1], self.spacing, strict=True)):
            along = np.arange(count) * side
            p[..., axis] += (along if axis < last else along[begin:stop]).reshape(-1, *(1,) * axis)
        return p

    @cached_property
    def points(self) -> FloatArray:
        """Positions of the pixels or voxels; (h, w, 2) or (d, h, w, 3)."""
        return self.positions(np.zeros((*self.shape, len(self.shape))))


class PixelGrid(Grid):
    """A grid of pixels."""

    @property
    def unit(self) -> float:
        """The side of a square with the area of a cell."""
        return float(np.sqrt(self.spacing[0]) * np.sqrt(self.spacing[1]))

    @cached_property
    def rest(self) -> ComplexArray:
        """Positions of the pixels in the grid's unit, as complex numbers; (h, w)."""
        return self.in_unit(self.points)

    def in_unit(self, positions: FloatArray) -> ComplexArray:
        """Return positions (h, w, 2) in the grid's unit, as complex numbers; (h, w)."""
        return np.ascontiguousarray(positions / self.unit).view(np.complex128)[..., 0]

    def cells(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Return the four vertices of cells, pixels counted row by row; (k, 4) int64."""
        first = rows * self.shape[1] + columns
        return np.stack([first, first + 1, first + self.shape[1], first + self.shape[1] + 1], axis=1)

    def all_cells(self) -> IntArray:
        """Return the vertices of all cells, row by row; (k, 4) int64."""
        return self.cells(*np.indices(self.cell_shape).reshape(2, -1))

    def corner_triangles(self, cells: IntArray) -> IntArray:
        """Return all corner triangles of cells (k, 4); (4 k, 3) int64."""
        return cells[:, _TRIANGLES].reshape(-1, 3)

    def triangles(self) -> IntArray:
        """Return the grid as a mesh; each cell's diagonal joins its second and third vertex; (f, 3)."""
        return self.all_cells()[:, [[0, 1, 2], [3, 2, 1]]].reshape(-1, 3)

    def jacobians(self, w: ComplexArray) -> FloatArray:
        """Return the determinants at all cell corners of a map (h, w) in the grid's unit; (h − 1, w − 1, 4)."""
        along, down = np.diff(w, axis=1), np.diff(w, axis=0)
        upper, lower, left, right = along[:-1], along[1:], down[:, :-1], down[:, 1:]
        sides = ((upper, left), (upper, right), (lower, left), (lower, right))
        # Overflow gives inf or NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.stack([x.real * y.imag - x.imag * y.real for x, y in sides], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class NearestField(SummarisedOutcome):
    """The nearest displacement field without folds that was found, and its distance from the given one.

    Attributes
    ----------
    field : (h, w, 2) or (d, h, w, 3) float64
        The new field.
    moved_mask : (h, w) or (d, h, w) bool
        Pixels or voxels whose displacement changed; the others are bitwise unchanged.
    folds : int
        Number of cells that the given field folds: a determinant is not above ``min_jacobian``.
    patches : int
        Number of separate regions of the grid in which the field changed.
    distance : float
        Root mean square distance from the given field, over all pixels or voxels, in the field's unit.
    seconds : float
    """

    field: FloatArray
    moved_mask: BoolArray
    folds: int
    patches: int
    distance: float
    seconds: float

    @classmethod
    def of(cls, given: FloatArray, field: FloatArray, wrong: BoolArray, began: float, **further: Any) -> Self:
        """Return the result for a given field, the new one, the cells that fold, and the clock at the beginning.

        ``further`` are the other attributes of the class.
        """
        moved = np.asarray((field != given).any(axis=-1))
        return cls(
            field=field,
            moved_mask=moved,
            folds=int(np.count_nonzero(wrong)),
            patches=int(label_patches(moved).max()),
            distance=mean_length(field - given),
            seconds=time.perf_counter() - began,
            **further,
        )

    @property
    def status(self) -> Status:
        """``INJECTIVE`` if the field is, otherwise ``STALLED``."""
        return Status.of(self.success)


def check_field(field: ArrayLike) -> FloatArray:
    """Check a displacement field, and return a copy as (h, w, 2) or (d, h, w, 3) float64.

    A ValueError names the first bad pixels or voxels.
    """
    array = real_array("field", field)
    dimension = 3 if array.ndim == 4 else 2
    if array.ndim != dimension + 1 or array.shape[-1] != dimension or min(array.shape[:-1]) < 2:
        advice = ""
        if array.ndim == dimension + 1 and array.shape[0] == dimension:
            advice = ": pass numpy.moveaxis(field, 0, -1)"
        elif array.ndim == 3 and array.shape[2] == 3:
            advice = "; fields on volumes have shape (depth, height, width, 3)"
        raise ValueError(f"field must have shape {_WORDS[dimension].field}, not {array.shape}{advice}")
    bad = np.asarray(~np.isfinite(array).all(axis=-1))
    if bad.any():
        raise ValueError(f"field is not finite at {name_points(bad)}: give finite displacements")
    return array


def check_fixed(fixed: ArrayLike | None, grid: Grid) -> BoolArray:
    """Return the mask of the fixed points; ValueError if it has another shape or dtype."""
    if fixed is None:
        return np.zeros(grid.shape, dtype=bool)
    mask = convert_array("fixed", fixed)
    if mask.shape != grid.shape or mask.dtype != bool:
        raise ValueError(f"fixed must be a bool array of shape {grid.shape}, not {mask.dtype} of shape {mask.shape}")
    return mask


def check_unfolded(wrong: BoolArray) -> None:
    """Raise ValueError for the cells in which a field without inverse folds."""
    if wrong.any():
        raise ValueError(
            f"the field folds, so it has no inverse: at the cells that begin at {name_points(wrong)}; "
            "use nearest_invertible (qhm field) to get the nearest invertible field"
        )


def mean_length(change: FloatArray) -> float:
    """Return the root mean square length of displacements (…, n), without overflow."""
    largest = float(np.abs(change).max()) or 1.0
    return largest * float(np.sqrt(((change / largest) ** 2).sum(axis=-1).mean()))


def name_points(mask: BoolArray) -> str:
    """Name the first points of a mask: ``pixels (0, 3), (2, 7), … (17 in all), row and column``."""
    words = _WORDS[mask.ndim]
    return f"{names_of(words.one, words.many, np.argwhere(mask))}, {words.indices}"


def cell_corners(points: BoolArray) -> list[BoolArray]:
    """Return views of a mask of points, one for each corner of the cells, each of the shape of the cells."""
    return [
        points[tuple(slice(at, at + count - 1) for at, count in zip(corner, points.shape, strict=True))]
        for corner in np.ndindex((2,) * points.ndim)
    ]


def find_points(cells: BoolArray) -> BoolArray:
    """Return the points of cells."""
    points = np.zeros(tuple(count + 1 for count in cells.shape), dtype=bool)
    for corner in cell_corners(points):
        corner |= cells
    return points


def find_cells(points: BoolArray) -> BoolArray:
    """Return the cells that have at least one of the points."""
    return np.asarray(np.logical_or.reduce(cell_corners(points)))


def find_fixed_cells(cells: BoolArray, fixed: BoolArray) -> BoolArray:
    """Return those of the cells whose points are all fixed."""
    return np.asarray(cells & np.logical_and.reduce(cell_corners(fixed)))


def label_patches(free: BoolArray) -> IntArray:
    """Number the patches of free points from 1 on; no cell has points of two patches."""
    from scipy.ndimage import label

    return np.asarray(label(free, structure=np.ones((3,) * free.ndim))[0], dtype=np.int64)


def grow(points: BoolArray, steps: int, fixed: BoolArray) -> BoolArray:
    """Add all points within a number of steps, each along any of the axes, except fixed ones."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(points, 2 * steps + 1, mode="constant") & ~fixed)
