"""Displacement fields on a grid of pixels, and the condition under which a field folds.

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

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, real_array

# Corner triangles of a cell whose vertices are numbered along x and then along y.
_TRIANGLES = np.array([[0, 1, 2], [1, 3, 0], [2, 0, 3], [3, 2, 1]])


@dataclass(frozen=True)
class Grid:
    """A grid of pixels."""

    shape: tuple[int, int]  # Numbers of rows and columns, at least two each
    # Distances between columns, along x, and between rows, along y
    spacing: tuple[float, float] = (1.0, 1.0)

    @property
    def unit(self) -> float:
        """The side of a square with the area of a cell."""
        return float(np.sqrt(self.spacing[0]) * np.sqrt(self.spacing[1]))

    @cached_property
    def points(self) -> FloatArray:
        """Positions of the pixels; (h, w, 2)."""
        rows, columns = self.shape
        x, y = np.arange(columns) * self.spacing[0], np.arange(rows) * self.spacing[1]
        return np.stack(np.meshgrid(x, y), axis=-1)

    @cached_property
    def rest(self) -> ComplexArray:
        """Positions of the pixels in the grid's unit, as complex numbers; (h, w)."""
        return np.ascontiguousarray(self.points / self.unit).view(np.complex128)[..., 0]

    def cells(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Return the four vertices of cells, pixels counted row by row; (k, 4) int64."""
        first = rows * self.shape[1] + columns
        return np.stack([first, first + 1, first + self.shape[1], first + self.shape[1] + 1], axis=1)

    def corner_triangles(self, cells: IntArray) -> IntArray:
        """Return all corner triangles of cells (k, 4); (4 k, 3) int64."""
        return cells[:, _TRIANGLES].reshape(-1, 3)

    def triangles(self) -> IntArray:
        """Return the grid as a mesh; each cell's diagonal joins its second and third vertex; (f, 3)."""
        rows, columns = np.indices((self.shape[0] - 1, self.shape[1] - 1)).reshape(2, -1)
        return self.cells(rows, columns)[:, [[0, 1, 2], [3, 2, 1]]].reshape(-1, 3)

    def jacobians(self, w: ComplexArray) -> FloatArray:
        """Return the determinants at all cell corners of a map (h, w) in the grid's unit; (h − 1, w − 1, 4)."""
        along, down = np.diff(w, axis=1), np.diff(w, axis=0)
        upper, lower, left, right = along[:-1], along[1:], down[:, :-1], down[:, 1:]
        sides = ((upper, left), (upper, right), (lower, left), (lower, right))
        # Overflow gives inf or NaN.
        with np.errstate(over="ignore", invalid="ignore"):
            return np.stack([x.real * y.imag - x.imag * y.real for x, y in sides], axis=-1)


def check_grid(shape: tuple[int, ...], spacing: ArrayLike) -> Grid:
    """Return the grid of a field with a given shape; ValueError if the spacing is not one or two positive numbers."""
    sides = real_array("spacing", spacing)
    if sides.shape not in ((), (2,)) or not (np.isfinite(sides) & (sides > 0)).all():
        raise ValueError(f"spacing must be a positive number, or two (along x and along y), not {spacing!r}")
    x, y = np.broadcast_to(sides, 2).tolist()
    return Grid((shape[0], shape[1]), (x, y))


def check_field(field: ArrayLike) -> FloatArray:
    """Check a displacement field, and return a copy as (h, w, 2) float64; a ValueError names the first bad pixels."""
    array = real_array("field", field)
    if array.ndim != 3 or array.shape[2] != 2 or min(array.shape[:2]) < 2:
        advice = ""
        if array.ndim == 3 and array.shape[0] == 2:
            advice = ": pass numpy.moveaxis(field, 0, -1)"
        elif array.ndim == 4 or (array.ndim == 3 and array.shape[2] == 3):
            advice = "; fields on volumes have shape (depth, height, width, 3)"
        raise ValueError(
            "field must have shape (height, width, 2), displacements along x and y for at least 2 × 2 "
            f"pixels, not {array.shape}{advice}"
        )
    bad = np.asarray(~np.isfinite(array).all(axis=2))
    if bad.any():
        raise ValueError(f"field is not finite at {name_pixels(bad)}")
    return array


def name_pixels(mask: BoolArray, most: int = 5) -> str:
    """Name the first pixels of a mask (h, w): ``pixels (0, 3), (2, 7), … (17 in all), row and column``."""
    where = np.argwhere(mask)
    listed = ", ".join(f"({y}, {x})" for y, x in where[:most].tolist())
    rest = f", … ({len(where)} in all)" if len(where) > most else ""
    return f"{'pixel' if len(where) == 1 else 'pixels'} {listed}{rest}, row and column"
