"""Find the nearest displacement field without folds.

On pixels, a field is interpolated bilinearly. On voxels, it is affine on the six tetrahedra of each cell. `fold_free`
can also examine the trilinear interpolation, as ITK and ANTs sample it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import product
from numbers import Real
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import (
    NearestField,
    PixelGrid,
    check_field,
    check_fixed,
    find_fixed_cells,
    label_patches,
    name_points,
)
from quasiharmonic.apps.displacement_fields.nearest_voxels import (
    InvertibleVolume,
    VoxelGrid,
    find_folded_cells,
    in_units,
    nearest_invertible_volume,
)
from quasiharmonic.apps.displacement_fields.patch_descent import (
    FixedPixelsError,
    descend_patches,
    fill_patches,
    find_folds,
    grow_pressing,
)
from quasiharmonic.apps.tetrahedra.descent import cross
from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, check_choice, count_of


class NearestTuning(NamedTuple):
    """Numbers that tune the search for the nearest field."""

    # Coefficients of at most this multiple of a bound of their terms may be rounding errors.
    rounding: float = 2.0**-46
    # Maximum number of times that patches grow.
    max_rounds: int = 12


_TUNING = NearestTuning()

#: How a field on voxels is sampled between them.
INTERPOLATIONS = "linear", "trilinear"


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
        least[z] = (factor * (total - _TUNING.rounding * bound)).min(axis=(0, 1, 2))
    return least


@dataclass(frozen=True, eq=False, repr=False)
class InvertibleField(NearestField):
    """A displacement field without folds, and its distance from the given one.

    Attributes
    ----------
    field : (h, w, 2) float64
        The field without folds.
    moved_mask : (h, w) bool
        Pixels whose displacement changed; the others are bitwise unchanged.
    certificate : Certificate
        The certificate of the mapped pixels as a mesh, with each cell cut along one diagonal. It reports whether the
        field is injective and, including its border, bijective.
    folds : int
        Number of cells that the given field folds: a corner's determinant is not above ``min_jacobian``.
    patches : int
        Number of separate regions of the grid in which the field changed.
    distance : float
        Root mean square distance from the given field, over all pixels, in the field's unit.
    seconds : float

    See Also
    --------
    nearest_invertible : Makes it.
    results.InvertibleVolume : The result for voxels.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import nearest_invertible
    >>> field = np.zeros((6, 6, 2))
    >>> field[3, 3, 0] = 2.0
    >>> result = nearest_invertible(field)
    >>> result.success, result.folds > 0, bool(result.moved_mask[3, 3])
    (True, True, True)
    """

    certificate: Certificate

    @property
    def success(self) -> bool:
        """Whether the field is injective (certified)."""
        return self.certificate.injective

    def summary(self) -> str:
        """Describe the field in one or two sentences."""
        if not self.folds:
            return f"The field does not fold and is unchanged. {self.certificate.summary()}"
        moved = int(np.count_nonzero(self.moved_mask))
        return (
            f"{count_of('cell', 'cells', self.folds)} folded; {count_of('pixel', 'pixels', moved)} moved, "
            f"root mean square change {self.distance:.3g}. {self.certificate.summary()}"
        )


def nearest_invertible(
    field: ArrayLike, *, spacing: ArrayLike = 1.0, min_jacobian: float = 0.01, fixed: ArrayLike | None = None
) -> InvertibleField | InvertibleVolume:
    """Make a displacement field invertible with a minimum change.

    Between pixels the field is interpolated bilinearly. It folds at a cell, the square between four pixels, if the
    Jacobian determinant is not positive there. This holds if the triangle of one of the cell's corners and its two
    neighbours is inverted. The result is a local minimum of the sum of the squared distances over all pixels.

    Parameters
    ----------
    field : (h, w, 2) or (d, h, w, 3) array
        Displacements along x, to the right, and y, down, of the pixel in row y and column x, in the unit of
        ``spacing``. The pixel at position p is mapped to ``p + field``.
    spacing : float, (float, float) or (float, float, float)
        Distance between neighbouring pixels, along x, along y, and along z.
    min_jacobian : float
        Lower bound of the determinants at the four corners of each cell, or of the volume ratios of the six tetrahedra
        of each cell of voxels; at least 0 and less than 1. Cells with a value that is not above it count as folds. It
        is at least the rounding error of a determinant. A field with determinants slightly above the bound stays
        without folds in single precision.
    fixed : (h, w) or (d, h, w) array of bool, optional
        Pixels that keep their displacements; none by default, so border pixels may also move.

    Returns
    -------
    InvertibleField, or InvertibleVolume for voxels
        The result. Away from folds the field is bitwise unchanged.

    Raises
    ------
    ValueError
        If an array has the wrong shape, the field is not finite, or an option is out of range. The message names the
        pixels. Also if the field is so far from zero that rounding errors are as large as cells.
    RuntimeError
        If no field was found, because of fixed pixels or because displacements are too large for the precision of
        doubles.

    See Also
    --------
    apps.displacement_fields.nearest.fold_free : Checks which cells fold.
    inverse_field : Inverts the result.
    warp_by_landmarks : Makes an invertible warp from landmarks.

    Notes
    -----
    Fields on voxels (d, h, w, 3) have displacements along x, y and z in slice z, row y and column x. Each cell between
    eight voxels is divided into six tetrahedra (`quasiharmonic.apps.displacement_fields.nearest_voxels`), which must be
    positive. The search can fail, also because of fixed pixels: no error is raised then, and the result lists the cells
    that still fold.

    With deep folds the distance has many local minima. The result depends on the start, a harmonic fill of patches
    around the folds (`quasiharmonic.apps.displacement_fields.patch_descent`). If the field's border overlaps itself,
    which is not a fold, `Certificate.bijective` is False and the certificate reports where.

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:40, :40]
    >>> bump = np.exp(-((x - 20) ** 2 + (y - 20) ** 2) / 18)
    >>> repaired = nearest_invertible(np.stack([6 * bump, 0 * bump], axis=-1))
    >>> repaired.certificate.bijective, repaired.folds, bool(repaired.moved_mask.mean() < 0.1)
    (True, 8, True)
    """
    began = time.perf_counter()
    if not isinstance(min_jacobian, Real) or not 0 <= min_jacobian < 1:
        raise ValueError(f"min_jacobian must be at least 0 and less than 1, not {min_jacobian!r}")
    if np.ndim(field) == 4:
        return nearest_invertible_volume(field, spacing, min_jacobian, fixed)
    given = check_field(field)
    grid = PixelGrid(given.shape[:2], spacing)
    mask = check_fixed(fixed, grid)
    w = grid.in_unit(grid.positions(given))
    min_jacobian = max(min_jacobian, _bound_rounding(w))
    wrong = find_folds(grid, w, min_jacobian)
    repaired = given.copy()
    if wrong.any():
        unrepairable = find_fixed_cells(wrong, mask)
        if unrepairable.any():
            raise ValueError(
                f"fixed: cells fold whose four pixels are all fixed; the first of each is {name_points(unrepairable)}"
            )
        here = _descend(grid, w, mask, min_jacobian)
        moved = here != w
        positions = np.stack([here.real, here.imag], axis=-1) * grid.unit
        repaired[moved] = (positions - grid.points)[moved]
        if not is_fold_free(grid, repaired).all():
            raise RuntimeError(
                "rounding folds the new field: its displacements are too large for its spacing; scale them down"
            )
    certificate = certify(grid.triangles(), grid.positions(repaired).reshape(-1, 2))
    return InvertibleField.of(given, repaired, wrong, began, certificate=certificate)


def fold_free(field: ArrayLike, *, spacing: ArrayLike = 1.0, interpolation: str = "linear") -> BoolArray:
    """Decide for each cell of a displacement field whether it does not fold; (h − 1, w − 1) bool.

    All four corner triangles of the mapped pixels, as stored in doubles, must be positive. On voxels (d, h, w, 3) the
    result has shape (d − 1, h − 1, w − 1) and depends on ``interpolation``. With ``"linear"``, all six tetrahedra of a
    cell must be positive, decided exactly. ITK and ANTs sample fields with ``"trilinear"`` interpolation. Then a cell
    is free of folds if all Bernstein coefficients of its Jacobian determinant are positive. This is sufficient, not
    necessary. Other arguments and errors are those of `nearest_invertible`.

    See Also
    --------
    nearest_invertible : Removes the folds.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic.apps.displacement_fields.nearest import fold_free
    >>> field = np.zeros((3, 4, 2))
    >>> field[:, 3, 0] = -2.0
    >>> fold_free(field).tolist()
    [[True, True, False], [True, True, False]]
    """
    check_choice("interpolation", interpolation, INTERPOLATIONS)
    if np.ndim(field) == 4:
        volume, scaled, _ = in_units(check_field(field), spacing)
        if interpolation == "trilinear":
            return np.asarray(least_coefficients(volume, scaled) > 0)
        return ~find_folded_cells(volume, scaled, None)
    if interpolation != "linear":
        raise ValueError("trilinear interpolation applies only to volumes: omit interpolation")
    given = check_field(field)
    return is_fold_free(PixelGrid(given.shape[:2], spacing), given)


def is_fold_free(grid: PixelGrid, field: FloatArray) -> BoolArray:
    """Decide for each cell of a checked field of pixels whether it does not fold; (h − 1, w − 1) bool."""
    positions = grid.positions(field).reshape(-1, 2)
    a, b, c = positions[grid.corner_triangles(grid.all_cells())].swapaxes(0, 1)
    return np.asarray((orientation(a, b, c) > 0).reshape(*grid.cell_shape, 4).all(axis=2))


def _bound_rounding(w: ComplexArray) -> float:
    """A bound on the rounding error of a determinant of a map (h, w), from medians, so that outliers do not count.

    ValueError if it reaches the determinant of a normal cell.
    """
    side = max(float(np.median(np.abs(np.diff(w, axis=axis)))) for axis in (0, 1))
    # Positions have errors of about eps |w|, and their differences of 2 eps |w|. A determinant has two products of two
    # differences, so its error is about 8 eps |w| times a side. The rest, 8, is for positions and sides above the
    # medians.
    error, side = 64 * float(np.finfo(np.float64).eps) * float(np.median(np.abs(w))), max(side, 1)
    if error >= side:
        raise ValueError(
            "the displacements are so large that doubles do not resolve the cells: subtract the mean displacement"
        )
    return error * side


def _descend(grid: PixelGrid, given: ComplexArray, fixed: BoolArray, min_jacobian: float) -> ComplexArray:
    """Find the nearest map, starting from one without folds; patches grow until nothing moves at their borders."""
    try:
        w, patch = fill_patches(grid, given, fixed, min_jacobian)
    except FixedPixelsError as none:
        raise RuntimeError(
            "no field without folds was found that keeps the fixed pixels; folds remain at "
            f"{name_points(none.mask)}. Fix fewer pixels around these"
        ) from none
    moving = patch
    for _ in range(_TUNING.max_rounds):
        shrunk = descend_patches(grid, w, given, moving, min_jacobian)
        patch[(moving > 0) & (shrunk == 0)] = 0
        moving = shrunk
        grown = grow_pressing(w != given, moving, fixed)
        if not (grown & (patch == 0)).any():
            break
        patch = label_patches(grown | (patch > 0))
        moving = np.where(np.isin(patch, np.unique(patch[grown])), patch, 0)
    return w
