"""Displacement fields on voxels: which cells fold, and the nearest field without folds.

A field maps the voxel in slice z, row y and column x, at position ``p = (x, y, z) · spacing``, to
``p + field[z, y, x]``. A cell is the box between eight voxels. It is divided into six tetrahedra around its diagonal
from the first voxel to the last one: each walks along the three axes in one of their six orders. On a tetrahedron the
map is affine, and its determinant is the volume ratio. A cell *folds* if a determinant is not above a bound.
Trilinear interpolation gives a different map, which can fold although the tetrahedra are positive.

To find the nearest field, patches around folded cells are untangled.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import (
    FieldStep,
    Grid,
    NearestField,
    check_field,
    check_fixed,
    find_cells,
    find_points,
    grow,
    label_patches,
)
from quasiharmonic.apps.tetrahedra.contacts import find_contacts
from quasiharmonic.apps.tetrahedra.descent import ShapeEnergy, TetrahedraDescent, cross, dot
from quasiharmonic.apps.tetrahedra.elements import ExactSigns, inspect_faces
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, count_of
from quasiharmonic.util.outcome import Verdict
from quasiharmonic.util.progress import heartbeat, report

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


class VoxelTuning(NamedTuple):
    """Numbers that tune the untangling of voxels."""

    # Distance in voxels around folded cells that becomes free; factor of it for patches that still fold; rounds.
    margin: int = 2
    growth: int = 2
    max_rounds: int = 5
    # Determinants aimed at: a multiple of the bound plus the second number, but at most the third.
    aim: float = 1.05
    least_aim: float = 1e-9
    most_aim: float = 0.99
    # Maximum number of steps until no tetrahedron is inverted.
    valid_steps: int = 200
    # Then weights of the energy relative to the squared distance, in voxels, and the steps and tolerance for each.
    weights: tuple[float, ...] = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
    polish_steps: int = 8
    polish_tol: float = 1e-4
    # Voxels closer than this to their original position, in voxels, return to it.
    return_distance: float = 1e-3


_TUNING = VoxelTuning()


@dataclass(frozen=True, eq=False, repr=False)
class VoxelVerdict(Verdict):
    """The exact verdict on a displacement field on voxels; see `InvertibleVolume` for the attributes.

    See Also
    --------
    results.InvertibleVolume : Has it as its certificate.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import nearest_invertible
    >>> nearest_invertible(np.zeros((3, 3, 3, 3))).certificate.valid
    True
    """

    remaining: BoolArray
    bijective: bool

    @property
    def valid(self) -> bool:
        """Whether no cell remains."""
        return not self.remaining.any()

    def summary(self) -> str:
        """Describe the verdict in one sentence."""
        covered = "no point is covered twice" if self.bijective else "not bijective"
        left = int(np.count_nonzero(self.remaining))
        return f"{count_of('cell', 'cells', left)} of {self.remaining.size} fold; {covered}"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        return {**super().to_dict(), "remaining": int(np.count_nonzero(self.remaining))}


@dataclass(frozen=True, eq=False, repr=False)
class InvertibleVolume(NearestField):
    """The nearest displacement field on voxels without folds that was found.

    Attributes
    ----------
    field : (d, h, w, 3) float64
    moved_mask : (d, h, w) bool
        Voxels whose displacement changed; the others are bitwise unchanged.
    folds : int
        Number of cells that the given field folds.
    remaining : (d − 1, h − 1, w − 1) bool
        Cells of ``field`` with a determinant that is not above ``min_jacobian``, or with a tetrahedron that is not
        positive, decided exactly.
    bijective : bool
        Whether no cell folds and the surface of the grid does not cross itself, so that no point is covered twice.
    patches : int
        Number of separate regions that changed.
    distance : float
        Root mean square distance from the given field, over all voxels, in the field's unit.
    seconds : float

    See Also
    --------
    nearest_invertible : Makes it from a field on voxels.
    InvertibleField : The result for pixels.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import nearest_invertible
    >>> field = np.zeros((5, 5, 5, 3))
    >>> field[2, 2, 2, 0] = 1.5
    >>> result = nearest_invertible(field)
    >>> result.success, result.folds > 0, int(result.remaining.sum())
    (True, True, 0)
    """

    remaining: BoolArray
    bijective: bool

    @property
    def success(self) -> bool:
        """Whether no cell remains: every tetrahedron is positive, decided exactly, and above the bound."""
        return not self.remaining.any()

    @property
    def certificate(self) -> VoxelVerdict:
        """The exact verdict on ``field``."""
        return VoxelVerdict(self.remaining, self.bijective)

    def summary(self) -> str:
        """Describe the field in one or two sentences."""
        left = int(np.count_nonzero(self.remaining))
        cells = f"{count_of('cell', 'cells', self.folds)} folded, {left} of them or their neighbours still do"
        moved = count_of("voxel", "voxels", int(np.count_nonzero(self.moved_mask)))
        remedy = "" if self.bijective else " The surface of the grid crosses itself: fix the voxels there."
        if left:
            remedy = " Smooth the field there first, or fix fewer voxels."
        return f"{cells}; {moved} moved, root mean square change {self.distance:.3g}.{remedy}"


def nearest_invertible_volume(
    field: ArrayLike, spacing: ArrayLike, min_jacobian: float, fixed: ArrayLike | None
) -> InvertibleVolume:
    """`quasiharmonic.nearest_invertible` for fields on voxels (d, h, w, 3)."""
    began = time.perf_counter()
    given = check_field(field)
    grid, scaled, exponent = in_units(given, spacing)
    still = check_fixed(fixed, grid)
    wrong = find_folded_cells(grid, scaled, min_jacobian)
    mended = scaled.copy()
    if wrong.any():
        _repair(grid, mended, wrong, still, min_jacobian)
    moved = np.asarray((mended != scaled).any(axis=3))
    repaired = np.where(moved[..., None], np.ldexp(mended, exponent), given)
    folds = find_folded_cells(grid, mended, None)
    low = find_folded_cells(grid, mended, min_jacobian) if moved.any() else wrong
    bijective = not folds.any() and not surface_crosses(grid, mended)
    return InvertibleVolume.of(given, repaired, wrong, began, remaining=folds | low, bijective=bijective)


def _repair(grid: VoxelGrid, field: FloatArray, wrong: BoolArray, fixed: BoolArray, min_jacobian: float) -> None:
    """Change a field in place in patches around folded cells; patches that still fold grow."""
    from scipy.ndimage import find_objects

    given, margin = field.copy(), _TUNING.margin
    free = grow(find_points(wrong), margin, fixed)
    todo = free
    for _ in range(_TUNING.max_rounds):
        labels = label_patches(free)
        again = np.zeros(grid.shape, dtype=np.bool_)
        wanted = set(np.unique(labels[todo & free]).tolist()) - {0}
        for number, place in enumerate(find_objects(labels), start=1):
            # One voxel more on each side, where the cells of the patch end.
            around = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in place)
            if number in wanted:
                mask = labels[around] == number
                if not _repair_patch(grid.spacing, field[around], given[around], mask, min_jacobian, len(wanted)):
                    again[around] |= mask
                wanted.remove(number)
        if not again.any():
            return
        margin *= _TUNING.growth
        todo = grow(again, margin, fixed)
        if np.array_equal(todo | free, free):
            return
        free = todo | free


def _repair_patch(
    spacing: FloatArray, field: FloatArray, given: FloatArray, mask: BoolArray, min_jacobian: float, left: int
) -> bool:
    """Replace the displacements of one patch by the nearest ones without folds; return whether any were found.

    ``field`` and ``given`` are parts of the new and the given field around the patch, and ``mask`` its voxels. ``left``
    is the number of patches from this one on.
    """
    grid = VoxelGrid(mask.shape, spacing)
    nodes, number = np.unique(grid.tetrahedra(grid.number_cells(find_cells(mask))), return_inverse=True)
    T = number.reshape(-1, 4)
    index = np.stack(np.unravel_index(nodes, grid.shape), axis=1)
    unit = float(np.cbrt(np.prod(grid.spacing)))
    corner = index.min(axis=0)
    rest = (index - corner)[:, ::-1] * grid.spacing / unit
    before = rest + given[tuple(index.T)] / unit
    free = np.flatnonzero(mask[tuple(index.T)])
    energy = ShapeEnergy(T, rest, floor=min(_TUNING.aim * min_jacobian + _TUNING.least_aim, _TUNING.most_aim))
    descent = TetrahedraDescent(energy, free, before, anchor=(before, 1.0 / len(T)))

    def show() -> None:
        report(FieldStep(descent.iterations, left, free.size))

    with np.errstate(all="ignore"):
        if not descent.make_valid(max_steps=_TUNING.valid_steps, after_step=show):
            return False
        for weight in _TUNING.weights:
            descent.anchor = before, 1.0 / (weight * len(T))
            for _ in descent.polish(max_steps=_TUNING.polish_steps, tol=_TUNING.polish_tol):
                show()
    X = descent.X
    near = np.flatnonzero((np.abs(X - before) < _TUNING.return_distance).all(axis=1))
    back = X.copy()
    back[near] = before[near]
    if energy.determinants(back).min() > min_jacobian:
        X = back
    changed = free[(X[free] != before[free]).any(axis=1)]
    field[tuple(index.T)] = given[tuple(index.T)]
    field[tuple(index[changed].T)] = (X[changed] - rest[changed]) * unit
    return True
