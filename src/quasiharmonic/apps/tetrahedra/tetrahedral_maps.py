"""Maps of tetrahedral meshes with fixed vertices, and tetrahedral meshes that follow their boundary in steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.tetrahedra.certificate import space_array
from quasiharmonic.apps.tetrahedra.descent import TetrahedraDescent
from quasiharmonic.apps.tetrahedra.elements import tetrahedron_signs
from quasiharmonic.apps.tetrahedra.placement import (
    RestMesh,
    Sliding,
    check_rest,
    extend_harmonically,
    find_sliding,
    make_energy,
    place_vertices,
)
from quasiharmonic.apps.tetrahedra.result import TetrahedraResult
from quasiharmonic.problem.result import Step
from quasiharmonic.util.arrays import FloatArray, IntArray, check_finite, distinct_vertices, reject
from quasiharmonic.util.options import MorphOptions, TetrahedraOptions, takes
from quasiharmonic.util.progress import reports_progress


class TetrahedraKeywords(TypedDict, total=False):
    """Types of the options of `injective_tetrahedra`."""

    start: ArrayLike | None
    polish: bool
    max_iterations: int
    tol: float
    callback: Callable[[Step], object] | None


@reports_progress
@takes(TetrahedraOptions, TetrahedraKeywords)
def injective_tetrahedra(
    X: ArrayLike, T: ArrayLike, fixed: ArrayLike, target: ArrayLike, **options: Unpack[TetrahedraKeywords]
) -> TetrahedraResult:
    """Map a tetrahedral mesh such that fixed vertices have target positions and every tetrahedron is positive.

    Parameters
    ----------
    X : (n, 3) array
        Rest positions.
    T : (t, 4) array of int
        Tetrahedra. The orientation of a row does not matter; neighbours must not overlap at rest.
    fixed : (k,) array of int
        Fixed vertices, usually the whole boundary.
    target : (k, 3) array
        Their target positions.
    start : (n, 3) array, optional
        Initial positions; default: the harmonic map.
    polish : bool
        Whether to lower the distortion after the first valid mesh.
    max_iterations : int
        Maximum number of Newton steps.
    tol : float
        The distortion has converged if a step lowers it by less than this fraction.
    callback : callable, optional
        Called with a `Step` at every iteration. It may raise KeyboardInterrupt, which ends the search as Ctrl-C does.

    Returns
    -------
    TetrahedraResult
        The mesh, its certificate, the tetrahedra that are still inverted, and the obstructions that were found.

    Raises
    ------
    ValueError
        If an argument is malformed or not finite, or a tetrahedron at rest is degenerate, repeated, or overlaps a
        neighbour. The message names the elements.

    See Also
    --------
    morph : Moves some nodes of a mesh.
    certify_tetrahedra : Checks a mesh.

    Notes
    -----
    The search can fail although a map exists. A boundary that crosses itself is reported before any search.

    Examples
    --------
    >>> import numpy as np
    >>> X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]])
    >>> T = [[0, 1, 2, 4], [0, 1, 3, 4], [0, 2, 3, 4], [1, 2, 3, 4]]
    >>> injective_tetrahedra(X, T, range(4), 2.0 * X[:4] + 1.0).success
    True
    """
    X = space_array("X", X, finite=False)
    mesh = check_rest(T, X)
    held = distinct_vertices("fixed", fixed, len(X))
    goal = space_array("target", target, held.size)
    checked = TetrahedraOptions(**options)
    begin = None if checked.start is None else _check_positions("start", checked.start, mesh)
    return place_vertices(mesh, X, held, goal, begin, checked)


def is_volume(points: ArrayLike, cells: ArrayLike) -> bool:
    """Whether points are in space, and cells are not triangles; ValueError for triangles in space."""
    if np.ndim(points) != 2 or np.shape(points)[1] != 3 or np.ndim(cells) != 2:
        return False
    if np.shape(cells)[1] == 3:
        raise ValueError(
            f"points must have shape (n, 2) for triangles, not {np.shape(points)}: for a planar mesh pass "
            "points[:, :2]; tetrahedra need F of shape (f, 4)"
        )
    return True


def morph_tetrahedra(
    points: ArrayLike, T: ArrayLike, moved_vertices: ArrayLike, target: ArrayLike, options: MorphOptions
) -> TetrahedraResult:
    """`quasiharmonic.morph` for points (n, 3) and tetrahedra (t, 4).

    Boundary vertices that are neither moved nor slide are fixed; ``slide`` as in `find_sliding`.
    """
    checked = TetrahedraOptions(
        polish=options.energy is not None,
        max_iterations=options.max_iterations,
        tol=options.tol,
        callback=options.callback,
    )
    rest, start = options.rest, options.start
    points = space_array("points", points, finite=False)
    mesh = check_rest(T, points if rest is None else space_array("rest", rest, len(points), finite=False))
    points = _check_positions("points", points, mesh)
    moved, still, sliding = find_fixed(mesh, points, moved_vertices, options.slide)
    goal = space_array("target", target, moved.size)
    begin = (None if rest is None else points) if start is None else _check_positions("start", start, mesh)
    fixed, goal = np.concatenate([moved, still]), np.concatenate([goal, points[still]])
    return place_vertices(mesh, points, fixed, goal, begin, checked, sliding)


def _check_positions(name: str, X: ArrayLike, mesh: RestMesh) -> FloatArray:
    """Return other positions (n, 3) of a mesh; vertices in no tetrahedron may be anywhere."""
    array = space_array(name, X, len(mesh.X), finite=False)
    check_finite(name, "vertex", "vertices", array, mesh.T)
    return array


def find_fixed(
    mesh: RestMesh, points: FloatArray, moved_vertices: ArrayLike, slide: bool | ArrayLike
) -> tuple[IntArray, IntArray, Sliding]:
    """Return the moved vertices, checked, the boundary vertices that neither move nor slide, and those that slide."""
    moved = distinct_vertices("moved_vertices", moved_vertices, len(points))
    idle = moved[~np.isin(moved, mesh.T)]
    reject(idle, "vertex", "vertices", "moved_vertices refers to {}, in no tetrahedron")
    sliding = find_sliding(mesh.faces.boundary, points, moved, slide)
    return moved, np.setdiff1d(mesh.boundary_vertices, np.concatenate([moved, sliding.vertices])), sliding


class MovingTetrahedra:
    """The part of `quasiharmonic.MovingMesh` for tetrahedra.

    Each move adds the harmonic extension of the displacement. If tetrahedra are then inverted, they are untangled.
    ``settle`` Newton steps lower the isotropic energy relative to the first mesh. ``slide`` as in `find_sliding`; it
    refers to the first mesh.
    """

    def __init__(
        self, points: ArrayLike, T: ArrayLike, moved_vertices: ArrayLike, settle: int, slide: bool | ArrayLike = False
    ) -> None:
        self.points = space_array("points", points, finite=False)
        self._mesh = check_rest(T, self.points)
        self._settle = settle
        self._moved, still, sliding = find_fixed(self._mesh, self.points, moved_vertices, slide)
        self._fixed = np.concatenate([self._moved, still])
        self._free = np.setdiff1d(np.unique(self._mesh.T), self._fixed)
        self._projections = sliding.restrict(self._free)
        self._energy, scaled, self._exponent = make_energy(self._mesh, self.points, False)
        self._descent = TetrahedraDescent(self._energy, self._free, scaled, projections=self._projections)

    @property
    def T(self) -> IntArray:
        """The tetrahedra (t, 4), positive at rest."""
        return self._mesh.T

    def advance(self, target: ArrayLike) -> FloatArray:
        """Move the boundary; return the new mesh, or raise a RuntimeError and leave the mesh unchanged."""
        goal = space_array("target", target, self._moved.size)
        descent = self._descent
        before = np.zeros_like(self.points)
        used = np.unique(self._mesh.T)
        before[used] = np.ldexp(self.points[used], -self._exponent)
        places = before[self._fixed]
        places[: self._moved.size] = np.ldexp(goal, -self._exponent)
        with np.errstate(all="ignore"):
            descent.X = extend_harmonically(self._energy, before, self._fixed, places, self._projections)
            descent.X[self._fixed] = places
            if descent.make_valid(max_steps=200):
                for _ in descent.polish(self._settle, tol=1e-8):
                    pass
        points = self.points.copy()
        points[self._moved] = goal
        points[self._free] = np.ldexp(descent.X[self._free], self._exponent)
        bad = np.flatnonzero(tetrahedron_signs(self._mesh.T, points)[0] <= 0)
        if bad.size:
            raise RuntimeError(
                f"{bad.size} tetrahedra, the first of them {bad[0]}, stay inverted after this step; use shorter steps, "
                "or a new mesh"
            )
        self.points = points
        return points.copy()
