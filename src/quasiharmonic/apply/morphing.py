"""Morphing of planar meshes: the boundary has moved, give me a valid interior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.arrays import (
    FloatArray,
    IntArray,
    check_finite,
    check_range,
    index_array,
    map_array,
    named,
    triangle_array,
)
from quasiharmonic.curves.rails import Rails
from quasiharmonic.energy.energies import Energy
from quasiharmonic.energy.measures import mean_ratio
from quasiharmonic.given.taking import takes_planar_mesh
from quasiharmonic.hearing import heard
from quasiharmonic.mesh.topology import boundary_edges
from quasiharmonic.problem import Problem
from quasiharmonic.result import MapResult, Step
from quasiharmonic.search.solving import solve


@dataclass(frozen=True, eq=False)
class Morphed:
    """A planar mesh after its boundary has moved.

    Attributes
    ----------
    points : (n, 2) float64
        All vertices, those in no triangle where they were.
    result : MapResult
        The search: status, certificate, stages, seconds. Its ``uv`` has the vertices that triangles use, in
        their order.
    quality_before, quality_after : (f,) float64
        `quasiharmonic.energy.measures.mean_ratio` of every triangle: 1 where it is equilateral, 0 where it has no
        area, negative where it is inverted.
    """

    points: FloatArray
    result: MapResult
    quality_before: FloatArray
    quality_after: FloatArray

    @property
    def valid(self) -> bool:
        """Whether every triangle is strictly positive, decided exactly."""
        return self.result.injective

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        sides = (("quality_before", self.quality_before), ("quality_after", self.quality_after))
        return {
            **self.result.to_dict(),
            **{
                name: {"minimum": float(quality.min()), "mean": float(quality.mean()), "worst": int(quality.argmin())}
                for name, quality in sides
            },
        }


@takes_planar_mesh
@heard
def morph(
    points: ArrayLike,
    F: ArrayLike,
    moved: ArrayLike,
    positions: ArrayLike,
    *,
    energy: str | Energy | None = "symmetric-dirichlet",
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | Rails = False,
) -> Morphed:
    """Move some vertices of a planar mesh and place the others such that no triangle is inverted.

    Parameters
    ----------
    points : (n, 2) array, or a mesh in the plane in place of ``points`` and ``F``
        The mesh as it is, valid.
    F : (f, 3) array of int
        Triangles, wound either way.
    moved : (k,) array of int
        Vertices that go somewhere else: of the boundary, or inside. Boundary vertices not among them stay.
    positions : (k, 2) array
        Where they go.
    energy : str, Energy or None
        What the placement minimises; see `quasiharmonic.polish`. The default keeps shapes and sizes of the
        triangles, so that a graded mesh stays graded. None takes the first valid mesh.
    max_iterations : int
        Linear solves to spend at most on finding a valid mesh.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between, but
        not within a single factorisation.
    slide : bool or Rails
        Let the boundary vertices that are not moved glide along their outline, its corners held, as nodes on the walls
        of a channel do: along the curves of `quasiharmonic.curves.Rails`, or with True along the polygon that the
        boundary is. Moved ones slide only where ``Rails`` tell them a curve of their own.

    Returns
    -------
    Morphed
        When no valid mesh was found, ``result.status`` says why.

    Raises
    ------
    ValueError
        When the input is malformed (see `Problem`), a triangle has no area, or a vertex to move is in none.

    Examples
    --------
    The upper side of a square pushed halfway down in its middle:

    >>> import numpy as np
    >>> from quasiharmonic import morph
    >>> from quasiharmonic.surfaces import grid
    >>> points, F = grid(12, 12)
    >>> upper = np.flatnonzero(points[:, 1] == 1)
    >>> x = points[upper, 0]
    >>> morphed = morph(points, F, upper, np.stack([x, 1 - 0.5 * np.sin(np.pi * x) ** 4], axis=1))
    >>> morphed.valid, bool(morphed.quality_after.min() > 0.25)
    (True, True)
    """
    points = map_array("points", points, finite=False)
    F = triangle_array(F, len(points))
    # Vertices in no triangle may be anywhere.
    met = np.isin(np.arange(len(points)), F)
    check_finite("points", "vertex", "vertices", np.where(met[:, None], points, 0))
    before = mean_ratio(points, F)
    flat = np.flatnonzero(before == 0)
    if flat.size:
        raise ValueError(f"{named('triangle', 'triangles', flat)} without area: repair the mesh first")
    turned = before < 0
    F[turned] = F[turned][:, [0, 2, 1]]

    fixed, target = _placed(points, F, moved, positions)
    used = np.unique(F)
    # On the mesh's own triangles the search starts from the harmonic extension of the displacement.
    own = np.searchsorted(used, F), np.searchsorted(used, fixed)
    problem = Problem(points[used], *own, target, reference="corrected")
    rails = _rails(slide, problem, used, np.asarray(moved))
    result = solve(
        problem,
        polish=energy,
        max_iterations=max_iterations,
        linear_solver=linear_solver,
        callback=callback,
        slide=rails,
    )
    after = points.copy()
    after[used] = result.uv
    return Morphed(after, result, np.abs(before), mean_ratio(after, F))


def _placed(points: FloatArray, F: IntArray, moved: ArrayLike, positions: ArrayLike) -> tuple[IntArray, FloatArray]:
    """Return the vertices that are given, those moved and the rest of the boundary, and where they go."""
    given = index_array("moved", moved)
    if given.ndim != 1:
        raise ValueError(f"moved must have shape (k,), not {given.shape}")
    check_range("moved", given, len(points))
    target = map_array("positions", positions, len(given), finite=False)
    check_finite("positions", "row", "rows", target)
    idle = given[~np.isin(given, F)]
    if idle.size:
        raise ValueError(f"{named('vertex', 'vertices', idle)} to be moved in no triangle")
    rest = np.setdiff1d(boundary_edges(F, len(points)), given)
    return np.concatenate([given, rest]), np.concatenate([target, points[rest]])


def _rails(slide: bool | Rails, problem: Problem, used: IntArray, moved: IntArray) -> bool | Rails:
    """What the boundary slides along, in the numbers of the vertices that triangles use; those moved are held."""
    held = np.searchsorted(used, moved)
    if isinstance(slide, Rails):
        return slide.among(used).holding(held)
    if slide is not True:
        return slide
    places = np.zeros((problem.n, 2))
    places[problem.fixed] = problem.target
    return Rails.around(problem.domain.loops, places, held=held)
