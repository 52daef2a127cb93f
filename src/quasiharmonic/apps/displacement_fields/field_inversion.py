"""The inverse of a displacement field on pixels or on voxels, on the same grid.

A field of pixels without folds maps each cell bilinearly to a convex quadrilateral, and the quadrilaterals do not
overlap. The cell that contains a pixel is found exactly, and the position in it solves a quadratic equation. So the
inverse is not iterative: at pixels in the image of the field it is exact to rounding.

On voxels, the field and its inverse are affine on the tetrahedra of each cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import PixelGrid, check_field, check_unfolded
from quasiharmonic.apps.displacement_fields.nearest import is_fold_free
from quasiharmonic.apps.displacement_fields.nearest_voxels import (
    VoxelGrid,
    find_folded_cells,
    in_units,
    surface_crosses,
)
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.exact.point_location import PointLocator
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, enumerate_each, find_exponent
from quasiharmonic.util.progress import heartbeat

# Pairs of tetrahedra and voxels are examined for so many cells at once.
_CELLS_AT_ONCE = (1 << 16) // 6
# Rounding of barycentric coordinates, and of positions in voxels.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class InverseVolume:
    """The inverse of a displacement field on voxels.

    Attributes
    ----------
    field : (d, h, w, 3) float64
        Displacement from the voxel at position q to its source ``q + field``; NaN for voxels without a source.
    outside : (d, h, w) bool
        Voxels outside the image of the given field.

    See Also
    --------
    inverse_field : Makes it from a field on voxels.
    InverseField : The inverse on pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import inverse_field
    >>> back = inverse_field(np.full((3, 3, 3, 3), 1.0))
    >>> back.field[1, 1, 1].tolist(), bool(back.outside[0, 0, 0])
    ([-1.0, -1.0, -1.0], True)
    """

    field: FloatArray
    outside: BoolArray

    def summary(self) -> str:
        """Describe the inverse in one sentence."""
        return f"{100 * float(self.outside.mean()):.3g} % of the voxels lie outside"


def inverse_volume(field: ArrayLike, spacing: ArrayLike) -> InverseVolume:
    """`quasiharmonic.inverse_field` for fields on voxels (d, h, w, 3), affine on the tetrahedra of each cell."""
    grid, given, exponent = in_units(check_field(field), spacing)
    check_unfolded(find_folded_cells(grid, given, None))
    if surface_crosses(grid, given):
        raise ValueError(
            "the field has no inverse: the surface of the grid crosses itself; change the displacements there"
        )
    back = np.full((int(np.prod(grid.shape)), 3), np.nan)
    best = np.full(len(back), -np.inf)
    X = (grid.positions(given) / grid.spacing).reshape(-1, 3)
    for tetrahedra, voxel, position in _candidates(grid, X):
        p = X[tetrahedra]
        weights = _solve_each(np.moveaxis(p[:, 1:] - p[:, :1], 1, 2), position - p[:, 0])
        weights = np.column_stack([1 - weights.sum(axis=1), weights])
        inside = weights.min(axis=1)
        good = np.flatnonzero(inside >= -_ROUNDING)
        # If a voxel occurs several times, the last assignment, of the tetrahedron that it is deepest inside, holds.
        good = good[np.argsort(inside[good], kind="stable")]
        good = good[inside[good] > best[voxel[good]]]
        source = np.stack(np.unravel_index(tetrahedra[good], grid.shape), axis=-1)[..., ::-1]
        best[voxel[good]] = inside[good]
        back[voxel[good]] = (weights[good][..., None] * source).sum(axis=1) - position[good]
    back = np.ldexp(back * grid.spacing, exponent)
    outside = np.isnan(back[:, 0])
    return InverseVolume(back.reshape(given.shape), outside.reshape(grid.shape))


def _solve_each(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solve linear systems (k, 3, 3) with right sides (k, 3); NaN for singular ones without a solution."""
    try:
        return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])
    except np.linalg.LinAlgError:
        # Differences of positions are rounded, so the edges of a very flat tetrahedron can be singular. It still
        # contains the points at which the least-squares solution is exact.
        x = np.full(b.shape, np.nan)
        flat = np.linalg.det(A) == 0
        x[~flat] = np.linalg.solve(A[~flat], b[~flat][..., None])[..., 0]
        least = (np.linalg.pinv(A[flat]) @ b[flat][..., None])[..., 0]
        error = np.abs((A[flat] @ least[..., None])[..., 0] - b[flat]).max(axis=1, initial=0)
        x[flat] = np.where(error[:, None] <= _ROUNDING, least, np.nan)
        return x


def _candidates(grid: VoxelGrid, X: FloatArray) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """Yield pairs of tetrahedra (k, 4) and voxels (k,) in their boxes, and the voxels' positions in voxels (k, 3)."""
    last = np.array(grid.shape[::-1]) - 1
    first = grid.number_cells(np.ones(grid.cell_shape, dtype=np.bool_))
    for start in range(0, len(first), _CELLS_AT_ONCE):
        heartbeat()
        T = grid.tetrahedra(first[start : start + _CELLS_AT_ONCE])
        p = X[T]
        low = np.clip(np.ceil(p.min(axis=1) - _ROUNDING), 0, last + 1).astype(np.int64)
        high = np.clip(np.floor(p.max(axis=1) + _ROUNDING), -1, last).astype(np.int64)
        size = np.maximum(high - low + 1, 0)
        count = size.prod(axis=1)
        of, rank = enumerate_each(count)
        x = rank % size[of, 0]
        y = rank // size[of, 0] % size[of, 1]
        z = rank // (size[of, 0] * size[of, 1])
        place = low[of] + np.stack([x, y, z], axis=1)
        voxel = np.asarray(np.ravel_multi_index(tuple(place.T[::-1]), grid.shape))
        yield T[of], voxel, place.astype(np.float64)


@dataclass(frozen=True, eq=False)
class InverseField:
    """The inverse of a displacement field.

    Attributes
    ----------
    field : (h, w, 2) float64
        Displacement from the pixel at position q to its source ``q + field``; NaN for pixels without a source.
    outside : (h, w) bool
        Pixels outside the image of the given field, which have no source.
    error : float
        Maximum distance of a pixel from itself after the inverse and the given field, in the field's unit; caused by
        rounding only.

    See Also
    --------
    inverse_field : Makes it.
    results.InverseVolume : The inverse on voxels.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import inverse_field
    >>> back = inverse_field(np.full((4, 4, 2), 1.0))
    >>> back.field[2, 2].tolist(), bool(back.outside[0, 0])
    ([-1.0, -1.0], True)
    """

    field: FloatArray
    outside: BoolArray
    error: float

    def summary(self) -> str:
        """Describe the inverse in one sentence."""
        share = 100 * float(self.outside.mean())
        return (
            f"{share:.3g} % of the pixels lie outside; for the others, the round-trip error is at most {self.error:.2g}"
        )


def inverse_field(field: ArrayLike, *, spacing: ArrayLike = 1.0) -> InverseField | InverseVolume:
    """Invert a displacement field that does not fold.

    Parameters
    ----------
    field : (h, w, 2) or (d, h, w, 3) array
        Displacements; see `nearest_invertible`.
    spacing : float, (float, float) or (float, float, float)
        Distance between neighbouring pixels, along x, along y, and along z.

    Returns
    -------
    InverseField, or InverseVolume for voxels
        The inverse on the same grid.

    Raises
    ------
    ValueError
        If the field folds, its border overlaps itself, it is not finite, or an argument has the wrong shape. The
        message names the pixels.

    See Also
    --------
    nearest_invertible : Removes folds first.
    InverseMap : The inverse of a map of a surface.

    Notes
    -----
    At its pixels the inverse is exact to rounding. Between them it is interpolated, although the true inverse is not
    bilinear there; this error is proportional to the square of the spacing.

    Examples
    --------
    >>> import numpy as np
    >>> field = np.zeros((5, 6, 2))
    >>> field[..., 0] = 1.0
    >>> back = inverse_field(field)
    >>> back.field[2, 3].tolist(), bool(back.outside[:, 0].all())
    ([-1.0, 0.0], True)
    """
    if np.ndim(field) == 4:
        return inverse_volume(field, spacing)
    given = check_field(field)
    grid = PixelGrid(given.shape[:2], spacing)
    check_unfolded(~is_fold_free(grid, given))
    positions, F = grid.positions(given).reshape(-1, 2), grid.triangles()
    certificate = certify(F, positions)
    if not certificate.bijective:
        raise ValueError(f"the field has no inverse. {certificate.summary()} Change the displacements at the border.")
    pixels = grid.points.reshape(-1, 2)
    triangle = PointLocator(positions[F]).find(pixels)
    found = np.flatnonzero(triangle >= 0)
    images = _Images(grid, positions, triangle[found] // 2)
    back = np.full(pixels.shape, np.nan)
    back[found] = images.source(pixels[found]) - pixels[found]
    away = images.forward(pixels[found] + back[found]) - pixels[found]
    error = float(np.hypot(*away.T).max(initial=0))
    return InverseField(back.reshape(given.shape), (triangle < 0).reshape(grid.shape), error)


class _Images:
    """The images of cells (m,), ``first + s along + t down + s t twist`` for s and t from 0 to 1."""

    def __init__(self, grid: PixelGrid, positions: FloatArray, cell: IntArray) -> None:
        row, column = np.divmod(cell, grid.shape[1] - 1)
        self.corner, self.spacing = np.stack([column, row], axis=1), np.array(grid.spacing)
        self.first, right, below, last = (positions[vertex] for vertex in grid.cells(row, column).T)
        self.along, self.down = right - self.first, below - self.first
        self.twist = last - right - below + self.first

    def source(self, points: FloatArray) -> FloatArray:
        """Return the source positions of points (m, 2), one point in each cell's image."""
        # In a unit in which products neither overflow nor underflow.
        exponent = max(find_exponent(self.along), find_exponent(self.down))
        vectors = (self.first - points, self.along, self.down, self.twist)
        away, along, down, twist = (np.ldexp(vector, -exponent) for vector in vectors)
        t = _rising_root(_cross(twist, down), _cross(along, down) + _cross(twist, away), _cross(along, away))
        across = along + t[:, None] * twist
        s = -np.einsum("mi,mi->m", away + t[:, None] * down, across) / np.einsum("mi,mi->m", across, across)
        return (self.corner + np.stack([np.clip(s, 0, 1), t], axis=1)) * self.spacing

    def forward(self, points: FloatArray) -> FloatArray:
        """Return the images of points (m, 2) of the cells."""
        s, t = (points / self.spacing - self.corner).T[..., None]
        return self.first + s * self.along + t * self.down + s * t * self.twist


def _rising_root(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """The root in [0, 1] at which ``a t² + b t + c`` changes from negative to positive; it must exist."""
    root = np.sqrt(np.maximum(b**2 - 4 * a * c, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(b >= 0, -2 * c / (b + root), (root - b) / (2 * a))
    return np.clip(t, 0, 1)


def _cross(one: FloatArray, other: FloatArray) -> FloatArray:
    return one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
