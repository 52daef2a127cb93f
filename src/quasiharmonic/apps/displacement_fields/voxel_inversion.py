"""The inverse of a displacement field on voxels, on the same grid: affine on the tetrahedra of each cell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import check_field, check_unfolded
from quasiharmonic.apps.displacement_fields.voxel_grid import VoxelGrid, find_folded_cells, in_units, surface_crosses
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, enumerate_each
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
