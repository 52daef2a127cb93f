"""Line shift: move all vertices along parallel lines at once by a linear programme.

If every vertex moves only along a line of one direction, the signed area of each triangle is *linear* in the positions
on the lines. A linear programme therefore gives the least inverted area that can be reached along that direction,
whatever obstacles lie in between. It needs no step length and has no local minima. A vertex can pass another without
coming close to it, and a fold of many triangles moves as a whole. Directions are drawn at random, one after another,
for large and small patches around inverted triangles.

With ``s`` the positions along the lines in units of the triangles' widths there, and a triangle's row ``A`` scaled to a
largest entry of one,

    minimise Σ z      subject to  A (s + d) + z ≥ δ,   z ≥ 0.

δ is a fraction of a positive triangle's value, so that it stays positive, and a small value for an inverted triangle.
Before directions are drawn, an affine map makes the patch as wide as it is long. It preserves orientations, so flat
targets and thin limbs need no special treatment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates, VertexDescent
from quasiharmonic.solver.methods.local_repair import Patch, RepairEffort, patch_around, remap_patches
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, invert_indices
from quasiharmonic.util.options import option, positive
from quasiharmonic.util.progress import heartbeat

Generator = np.random.Generator


class LineShiftTuning(NamedTuple):
    """Numbers that tune the linear programmes of a line shift."""

    # Rings around an inverted triangle, one drawn per patch.
    rings: tuple[int, ...] = (3, 8, 24)
    # Maximum number of triangles of a patch.
    max_triangles: int = 2000
    # Maximum number for a patch with the fewest rings, which is large around a vertex with very many neighbours.
    max_triangles_near: int = 20000
    # Least value δ of a positive triangle, as a fraction of its present value.
    min_share: float = 0.1
    # Maximum of this value δ, in widths.
    max_widths: float = 1.0
    # Least value δ of an inverted triangle.
    min_untangled: float = 1e-3
    # Maximum move of a vertex, in widths of the triangles around it.
    max_move: float = 20.0
    # Maximum number of simplex steps times triangles: each step takes time proportional to the triangles. The total is
    # about 0.1 to 0.2 CPU seconds.
    pivots_times_triangles: int = 4_000_000
    # Cost of a programme, in steps of untangling the patch.
    steps_per_programme: int = 100


_TUNING = LineShiftTuning()


@dataclass(frozen=True, kw_only=True)
class LineShift(VertexDescent):
    """Untangle inverted triangles by linear programmes along random directions.

    The directions come from a generator with a fixed seed.

    Attributes
    ----------
    max_failures : int
        Maximum number of consecutive programmes that untangle no triangle.
    """

    max_failures: int = option(5, check=positive)

    label: ClassVar[str] = "line shift"
    quick: ClassVar[bool] = True

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; yields a map after every programme that reduces the number of inverted triangles."""
        problem, effort = objective.problem, RepairEffort(len(objective.problem.F))
        rng = np.random.default_rng(0)

        def attempt(w: ComplexArray, left: IntArray) -> tuple[Patch, ComplexArray] | None:
            triangle, rings = int(rng.choice(left)), int(rng.choice(_TUNING.rings))
            patch = patch_around(problem, triangle, rings, _TUNING.max_triangles)
            patch = patch or patch_around(problem, triangle, _TUNING.rings[0], _TUNING.max_triangles_near)
            if patch is None:
                return None
            effort.count(len(patch.F), _TUNING.steps_per_programme)
            return patch, shift_along_lines(rng, patch.F, w[patch.vertices], patch.fixed)

        left = inverted_triangles(problem.F, problem.positions(start.w))
        yield from remap_patches(objective, start.w, left, attempt, patience=self.max_failures, effort=effort)
        return True


def shift_along_lines(rng: Generator, F: IntArray, w: ComplexArray, fixed: BoolArray) -> ComplexArray:
    """Return a map of a patch with the least inverted area, as defined above, along one random direction.

    ``F`` (p, 3) are the triangles of the patch, ``w`` (v,) its map, and ``fixed`` (v,) bool marks its fixed vertices.
    Return ``w`` if the solver finds no solution.
    """
    frame = frame_along(w, rng.uniform(0, np.pi))
    if frame is None:
        return w
    x, y, along = frame
    step = best_shift(F, x, y, fixed)
    return w if step is None else w + step * along


def frame_along(w: ComplexArray, angle: float) -> tuple[FloatArray, FloatArray, complex] | None:
    """Return coordinates x, y (v,) in which points are as wide as they are long, and the step that adds 1 to x.

    ``angle`` is that of the direction of x. The coordinates have the same orientation as the points w (v,). None if the
    points lie on a line.
    """
    centred = np.stack([w.real, w.imag], axis=1)
    centred -= centred.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)
    if not size[1] > 0:
        return None
    # A reflection would invert all triangles.
    axes[1] *= np.sign(np.linalg.det(axes))
    size /= np.sqrt(len(w))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    x, y = turn @ (axes @ centred.T / size[:, None])
    step = axes.T @ (size * turn[0])
    return x, y, complex(step[0], step[1])


def best_shift(F: IntArray, x: FloatArray, y: FloatArray, fixed: BoolArray) -> FloatArray | None:
    """Return the steps (v,) along x that leave the least inverted area, zero at ``fixed`` (v,) vertices.

    None if the solver finds no solution.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    # Twice the area is Σ x dy over the corners.
    dy = y[np.roll(F, -1, axis=1)] - y[np.roll(F, -2, axis=1)]
    wide = np.repeat(np.ptp(x[F], axis=1), 3)
    unit = np.bincount(F.ravel(), wide, len(x)) / np.maximum(np.bincount(F.ravel(), minlength=len(x)), 1)
    free = np.flatnonzero(~fixed)
    column = invert_indices(len(x), free)
    entry = np.where(fixed[F], 0.0, dy * unit[F])
    scale = np.abs(entry).max(axis=1)
    concerned = np.flatnonzero(scale > 0)
    if not concerned.size:
        return None
    count, scale = concerned.size, scale[concerned]
    row, corner = np.nonzero(~fixed[F[concerned]])
    t, every = concerned[row], np.arange(count)
    value = np.concatenate([entry[t, corner] / scale[row], np.ones(count)])
    where = np.concatenate([row, every]), np.concatenate([column[F[t, corner]], free.size + every])
    A = csr_array((value, where), shape=(count, free.size + count))
    area = (x[F] * dy).sum(axis=1)[concerned] / scale
    bound = np.where(area > 0, np.minimum(_TUNING.min_share * area, _TUNING.max_widths), _TUNING.min_untangled)
    heartbeat()
    result = linprog(
        np.repeat([0.0, 1.0], [free.size, count]),
        A_ub=-A,
        b_ub=area - bound,
        bounds=np.repeat([[-_TUNING.max_move, _TUNING.max_move], [0.0, np.inf]], [free.size, count], axis=0),
        method="highs-ds",
        options={"maxiter": max(1, _TUNING.pivots_times_triangles // count)},
    )
    if result.x is None or not np.isfinite(result.x).all():
        return None
    step = np.zeros(len(x))
    step[free] = result.x[: free.size] * unit[free]
    return step
