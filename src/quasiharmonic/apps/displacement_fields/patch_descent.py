"""Descend from a field without folds to the nearest one, patch by patch, with a step length for each patch.

The free pixels form patches. No cell has free pixels of two patches. Let ``w`` be the positions of the mapped pixels
and ``a`` those under the given field, both in the grid's unit. Each patch minimises::

    ½ Σ |w − a|²  +  κ Σ B((det − δ) / d)        B(s) = −(s − 1)² log s   for s < 1,   0 for s ≥ 1

over its pixels and its cells' corner triangles. The barrier [1]_ is infinite at determinants of δ. From δ + d on, it
and its first two derivatives vanish. So only the first term acts on pixels whose cells are not nearly folded, and moves
them exactly to their positions under the given field. κ decreases in steps, until the barrier's effect is negligible.

Patches share one block-diagonal matrix and Newton's direction. Step length and convergence are determined per patch.
Large patches shrink to the surroundings of the pixels that move.

The start is a map without folds that agrees with the field outside patches around the folds. The pixels of folded cells
and some pixels around them become free, with harmonic displacements. Where the result still folds, the given map itself
descends, with a penalty of ``½ (s − 2)²`` for s < 2 in place of B, whose weight increases. The patch grows if pixels at
its border move. If folds
remain, the displacements around them become harmonic, and the penalty acts once more. This repeats on larger distances.
Finally the whole field is smoothed until it does not fold; this always ends, as smoothing converges to a translation.

References
----------
.. [1] M. Li, Z. Ferguson, T. Schneider, T. Langlois, D. Zorin, D. Panozzo, C. Jiang, D. Kaufman, Incremental potential
   contact. ACM Transactions on Graphics 39 (2020), equation 6.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quasiharmonic.apps.displacement_fields.grid import (
    FieldStep,
    PixelGrid,
    find_cells,
    find_points,
    grow,
    label_patches,
)
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, Isotropic
from quasiharmonic.energies.newton.line_search import backtrack_each
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.linsolve import make_solver
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from quasiharmonic.util.progress import report

if TYPE_CHECKING:
    from scipy.sparse import dia_array


class PatchTuning(NamedTuple):
    """Numbers that tune the descent on patches of pixels."""

    # The penalty's width d.
    width: float = 0.05
    # The barrier's weights κ, its widths d and the maximum numbers of steps, in turn.
    barriers: tuple[tuple[float, float, int], ...] = (1e-3, width, 100), (1e-5, width, 100)
    # The same if a patch has more than `large` pixels. Steps of a patch with many folds to a thin barrier are short.
    wide_barriers: tuple[tuple[float, float, int], ...] = (
        (1e-1, 0.5, 20),
        (1e-2, 0.2, 20),
        (1e-3, width, 40),
        (1e-5, width, 40),
    )
    large: int = 5_000
    # Pixels closer than this to their original position, in pixels, return to it. In large patches they return earlier.
    return_distance: float = 1e-5
    return_early: float = 1e-2
    # The penalty's weights in turn.
    penalties: tuple[float, ...] = (1e-2, 1e-1, 1.0, 10.0, 100.0)
    # A patch has converged if Newton's model predicts a decrease below this fraction of its value.
    tolerance: float = 1e-6
    # It has also converged below this decrease in squared pixels.
    zero_decrease: float = 1e-14
    # It has also converged if a step lowers its value by less than this fraction.
    idle: float = 1e-9
    # Maximum number of steps for one weight of the penalty.
    max_penalty_steps: int = 10
    # Maximum number of lengths of one step.
    max_halvings: int = 30
    # Fraction of the step to the first collapse, as in the other Newton descents.
    fraction: float = 0.9
    # Diagonal shifts, tried in this order until the matrix is positive definite.
    shifts: tuple[float, ...] = (0.0, 1e-12, 1e-8, 1e-4)
    # Approximate number of free pixels in one matrix.
    at_once: int = 20_000
    # Distance in pixels around folded cells, and around patches whose border moves, that becomes free.
    margin: int = 4
    # Distance in pixels around folds in which displacements become harmonic; it grows by a half if folds remain.
    near: int = 2
    # Growth factor of the smoothing's standard deviation in pixels.
    smoother: float = 1.2


_TUNING = PatchTuning()


@dataclass(frozen=True)
class _OfDeterminant(Isotropic):
    """A function of ``s = (det − min_jacobian) / width``."""

    min_jacobian: float
    width: float

    @abstractmethod
    def derivatives(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """First and second derivative by s."""

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """Derivatives by a and by b; they are opposite, as det = a − b."""
        slope = self.derivatives(self.place(d))[0] / self.width
        return slope, -slope

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Second derivatives by a and a, a and b, b and b."""
        bend = self.derivatives(self.place(d))[1] / self.width**2
        return bend, -bend, bend

    def place(self, d: Deformation) -> FloatArray:
        """Return s."""
        return (d.det - self.min_jacobian) / self.width


class ThinBarrier(_OfDeterminant):
    """A barrier at determinants of ``min_jacobian`` that vanishes from ``min_jacobian + width`` on."""

    barrier = True

    def density(self, d: Deformation) -> FloatArray:
        """Return ``B(s)``."""
        s = np.minimum(self.place(d), 1)
        return np.where(s > 0, -((s - 1) ** 2) * np.log(np.where(s > 0, s, 1)), np.inf)

    def derivatives(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """First and second derivative of B; zero where B is infinite."""
        s = np.where(s > 0, np.minimum(s, 1), 1)
        slope = -(2 * (s - 1) * np.log(s) + (s - 1) ** 2 / s)
        return slope, -(2 * np.log(s) + 4 * (s - 1) / s - ((s - 1) / s) ** 2)


class FoldPenalty(_OfDeterminant):
    """A penalty for determinants below ``min_jacobian + 2 width``, finite at folds."""

    def density(self, d: Deformation) -> FloatArray:
        """Return ``½ (s − 2)²`` for s < 2."""
        return 0.5 * np.minimum(self.place(d) - 2, 0) ** 2

    def derivatives(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """First and second derivative."""
        return np.minimum(s - 2, 0), np.where(s < 2, 1.0, 0.0)


def descend_patches(
    grid: PixelGrid, w: ComplexArray, given: ComplexArray, patch: IntArray, min_jacobian: float
) -> IntArray:
    """Move the free pixels as near to their positions under a given field as possible.

    ``w`` (h, w) complex128 is changed in place. It is a map in the grid's unit whose determinants are above
    ``min_jacobian`` at all corners of cells with free pixels. ``given`` (h, w) is the given map, and ``patch`` (h, w)
    the patch of each free pixel, from 1 on; 0 for fixed pixels. Return the patches of the pixels that were free at the
    end: large patches shrink to the surroundings of the pixels that move.
    """
    large = np.bincount(patch.ravel())[1:].max(initial=0) > _TUNING.large
    for weight, width, steps in _TUNING.wide_barriers if large else _TUNING.barriers:
        _descend_batches(_Patches(grid, w, given, patch, ThinBarrier(min_jacobian, width)), weight, steps)
        if large:
            _return_pixels(grid, w, given, min_jacobian, _TUNING.return_early)
            patch = label_patches(grow(w != given, _TUNING.margin, patch == 0))
    _return_pixels(grid, w, given, min_jacobian, _TUNING.return_distance)
    return patch


def _return_pixels(grid: PixelGrid, w: ComplexArray, given: ComplexArray, min_jacobian: float, distance: float) -> None:
    """Return pixels to their original positions: patches without folds, and those nearly there where none arises."""
    patch = label_patches(w != given)
    needed = patch[find_points(find_folds(grid, given, min_jacobian))]
    needless = (patch > 0) & ~np.isin(patch, np.unique(needed))
    w[needless] = given[needless]
    close = (w != given) & (np.abs(w - given) < distance)
    before = w.copy()
    w[close] = given[close]
    while (folded := find_points(find_folds(grid, w, min_jacobian)) & close).any():
        w[folded] = before[folded]
        close &= ~folded


class _Patches(NamedTuple):
    """The arguments of `descend_patches`, and the function of the determinants."""

    grid: PixelGrid
    w: ComplexArray
    given: ComplexArray
    patch: IntArray
    energy: _OfDeterminant


def _descend_batches(patches: _Patches, weight: float, steps: int) -> None:
    """Converge all patches for one weight of the energy, with at most so many steps."""
    size = np.bincount(patches.patch.ravel())
    size[0] = 0
    batch = (np.cumsum(size) - size) // _TUNING.at_once
    # Overflow gives inf or NaN. Comparisons with NaN are false, so such a step is never taken.
    with np.errstate(all="ignore"):
        for number in range(int(batch[-1]) + 1):
            _descend(patches, np.flatnonzero((batch == number) & (size > 0)), weight, steps)


def _descend(patches: _Patches, todo: IntArray, weight: float, steps: int) -> None:
    """Converge the patches ``todo`` for one weight of the energy; the matrix only has patches that still move."""
    iteration = 0
    while todo.size and iteration < steps:
        batch = _Batch(patches, todo, weight)
        moving = np.ones(todo.size, dtype=bool)
        while iteration < steps and 2 * np.count_nonzero(moving) > todo.size:
            report(FieldStep(iteration, int(np.count_nonzero(moving)), batch.free.size))
            moving &= batch.step(moving)
            iteration += 1
        batch.enter(patches.w)
        todo = todo[moving]


class _Batch:
    """Patches that share one matrix."""

    def __init__(self, patches: _Patches, todo: IntArray, weight: float) -> None:
        grid, w, given, patch, energy = patches
        patch = np.where(np.isin(patch, todo), patch, 0)
        touched = find_cells(patch > 0)
        cells = grid.cells(*np.nonzero(touched))
        pixels, local = np.unique(cells, return_inverse=True)
        F = grid.corner_triangles(local.reshape(-1, 4))
        self.weight, self._pixels = weight, pixels
        self.here, self.given = w.ravel()[pixels], given.ravel()[pixels]
        label = patch.ravel()[pixels]
        self.free = np.flatnonzero(label)
        _, own = np.unique(label[self.free], return_inverse=True)
        self.patches = int(own.max()) + 1
        self.of_pixel = own
        of = np.full(len(pixels), -1, dtype=np.int64)
        of[self.free] = own
        self.of_triangle = np.repeat(of[local.reshape(-1, 4)].max(axis=1), 4)
        self.energy = DeformationEnergy(grid.points.reshape(-1, 2)[pixels] / grid.unit, F, energy)
        self.system = NewtonSystem(F, self.energy.g, len(pixels), np.flatnonzero(label == 0))
        self._count = len(F)

    def enter(self, w: ComplexArray) -> None:
        """Write the free pixels' positions into a map (h, w)."""
        w.ravel()[self._pixels[self.free]] = self.here[self.free]

    def _values(self, w: ComplexArray) -> tuple[FloatArray, Deformation]:
        """Return the objective of each patch, and the deformation."""
        deformation = self.energy.deform(w)
        density = self.energy.energy.density(deformation)
        apart = np.abs((w - self.given)[self.free]) ** 2
        near = np.bincount(self.of_pixel, apart, minlength=self.patches)
        return 0.5 * near + self.weight * np.bincount(self.of_triangle, density, minlength=self.patches), deformation

    def step(self, moving: BoolArray) -> BoolArray:
        """Take one step of each moving patch; return which patches have not converged."""
        value, deformation = self._values(self.here)
        # The energy is a mean, but the patches' objective is a sum.
        share = self.weight * self._count
        pull = share * self.energy.gradient_of(deformation, len(self.here))[self.free]
        gradient = pull + (self.here - self.given)[self.free]
        self.system.assemble(self.energy.curvature_of(deformation).scaled(np.full(self._count, share)))
        one = np.ones(self.free.size)
        self.system.add_blocks(one, 0 * one, one)
        found = self.system.descent(gradient, _TUNING.shifts)
        direction = found[0] if found is not None else self.system.solve_diagonal(-gradient)
        fall = -(gradient.real * direction.real + gradient.imag * direction.imag)
        expected_decrease = np.bincount(self.of_pixel, fall, minlength=self.patches).astype(np.float64, copy=False)
        fallen = self._search(direction, expected_decrease, value, moving & (expected_decrease > 0) & (value < np.inf))
        return (fallen > _TUNING.idle * value) & (
            0.5 * expected_decrease > np.maximum(_TUNING.tolerance * value, _TUNING.zero_decrease)
        )

    def _search(
        self, direction: ComplexArray, expected_decrease: FloatArray, before: FloatArray, moving: BoolArray
    ) -> FloatArray:
        """Search along a direction with a step length for each patch; return each patch's decrease."""
        full = np.zeros_like(self.here)
        full[self.free] = direction
        reach = np.full(self.patches, np.inf)
        if self.energy.energy.barrier:
            np.minimum.at(reach, self.of_triangle, self.energy.steps_to_collapse(self.here, full))
        longest = np.where(moving, np.minimum(1, _TUNING.fraction * reach), 0)
        start, trial = self.here[self.free], self.here.copy()

        def values(t: FloatArray) -> FloatArray:
            step = t[self.of_pixel]
            trial[self.free] = np.where(step > 0, start + step * direction, start)
            return self._values(trial)[0]

        t, value = backtrack_each(values, before, expected_decrease, longest, tries=_TUNING.max_halvings)
        self.here = trial
        return np.where(t > 0, before - value, 0)


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
    w, distance, penalties = given.copy(), _TUNING.near, list(_TUNING.penalties)
    free = grow(find_points(find_folds(grid, given, min_jacobian)), distance, fixed)
    if not free.all():
        _fill(grid, w, free)
    patch = label_patches(free)
    folded = np.isin(patch, np.unique(patch[find_points(find_folds(grid, w, min_jacobian)) & free]))
    w[folded & free] = given[folded & free]
    wrong = find_folds(grid, w, min_jacobian)
    if not wrong.any():
        return w, patch
    free |= grow(find_points(wrong), _TUNING.margin, fixed)
    while not free.all():
        for weight in penalties:
            patch = label_patches(free)
            folded = np.isin(patch, np.unique(patch[find_points(wrong)]))
            patches = _Patches(grid, w, given, np.where(folded, patch, 0), FoldPenalty(min_jacobian, _TUNING.width))
            _descend_batches(patches, weight, _TUNING.max_penalty_steps)
            free |= grow_pressing(w != given, patch, fixed)
            wrong = find_folds(grid, w, min_jacobian)
            if not wrong.any():
                return w, label_patches(free)
        around = grow(find_points(wrong), distance, fixed)
        if around.all():
            break
        if distance > max(grid.shape):
            raise FixedPixelsError(find_points(wrong))
        _fill(grid, w, around)
        free |= around
        wrong = find_folds(grid, w, min_jacobian)
        if not wrong.any():
            return w, label_patches(free)
        distance += distance // 2
        penalties = penalties[-1:]
    return _smooth(grid, given, min_jacobian), np.ones(grid.shape, dtype=np.int64)


def grow_pressing(moved: BoolArray, patch: IntArray, fixed: BoolArray) -> BoolArray:
    """Return the patches (h, w) in which pixels moved at the border, and pixels around them."""
    rim = moved & (patch > 0) & grow(patch == 0, 1, fixed)
    return grow(np.isin(patch, np.unique(patch[rim])) & (patch > 0), _TUNING.margin, fixed)


def _fill(grid: PixelGrid, w: ComplexArray, free: BoolArray) -> None:
    """Make the displacements of free pixels harmonic, given the others; natural conditions at the grid's border."""
    from scipy.sparse import csr_array, dia_array, kron, triu

    inside, moved = np.flatnonzero(free), (w - grid.rest).ravel()
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
        deviation *= _TUNING.smoother
    return grid.rest + moved.mean()
