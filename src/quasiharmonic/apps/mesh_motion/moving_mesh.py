"""A planar mesh whose boundary moves step by step, as in a simulation: valid at each step, and without drift.

    boundary moves ──Newton, interior follows──▶ valid ──a step down the energy──▶ next time step

The energy compares with the first mesh and does not depend on the path to the present one.
"""

from __future__ import annotations

from typing import TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.tetrahedra.moving import MovingTetrahedra
from quasiharmonic.apps.tetrahedra.tetrahedral_maps import is_volume
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.energies.newton.boundary_continuation import MovingDescent
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.sliding_boundary import SlidingModel, SlidingSystem, move_boundary
from quasiharmonic.energies.polishing import find_energy, scale_energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.mesh.elements import check_spread
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.adapters.accepts_mesh import init_accepts_planar_mesh
from quasiharmonic.io.adapters.objects import MeshLike
from quasiharmonic.linsolve import check_name
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_bool,
    check_finite,
    check_integer,
    map_array,
    names_of,
    triangle_array,
    vertex_indices,
)
from quasiharmonic.util.options import MovingOptions, takes

# Minimum decrease, relative to the energy, that a step must predict.
_TOLERANCE = 1e-4
# Maximum number of steps that move the boundary.
_MAX_STEPS = 25


class MovingKeywords(TypedDict, total=False):
    """Types of the options of `MovingMesh`."""

    energy: str | Energy
    settle: int
    slide: bool | ArrayLike
    linear_solver: str


class MovingMesh:
    """A mesh, planar or of tetrahedra, that follows its boundary in small steps.

    Use it for a simulation with a moving boundary. Each call moves the boundary and lets the interior follow, with one
    or two factorisations of the size of linear elasticity. For a single large displacement use `morph`.

    Parameters
    ----------
    points : (n, 2) or (n, 3) array, or a mesh in place of ``points`` and ``F``
        The initial mesh, valid; the shapes and sizes of its triangles are preserved. Every vertex belongs to a
        triangle.
    F : (f, 3) array of int
        Triangles, clockwise or counterclockwise; tetrahedra (f, 4) if points are in space.
    moved_vertices : (k,) array of int
        Vertices that will move, on the boundary or inside. Other boundary vertices are fixed.
    energy : str or Energy
        Distortion energy to keep low; see `quasiharmonic.polish`. The default weights shapes more than sizes.
        Tetrahedra have one isotropic energy.
    settle : int
        Newton steps down the energy after each move. With 0 the mesh is also valid, and a step is faster.
    slide : bool or (m, 4) array
        Let the boundary vertices that are not moved slide along their outline, with fixed corners; in the plane this
        needs ``settle`` of at least 1, and they lag one step behind the mesh, so moved vertices that arrive along the
        same wall are blocked by them. `morph` does not have this limitation. Vertices of tetrahedra slide at once, as
        in `morph`, along the flat parts of the first mesh's boundary or along those on the given planes.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.

    Raises
    ------
    ValueError
        If the input is malformed, a triangle has no area, or an option is invalid.

    Notes
    -----
    All tetrahedra stay positive, but separate parts of the boundary may be moved through each other. To detect this,
    pass the mesh to `quasiharmonic.certify_tetrahedra`.

    Examples
    --------
    Turn the hole of a ring by 200°:

    >>> import numpy as np
    >>> from quasiharmonic import MovingMesh
    >>> from quasiharmonic.geometry.mesh.topology import boundary_loops
    >>> from quasiharmonic.surfaces import annulus
    >>> points, F = annulus(12)
    >>> walls, body = sorted(boundary_loops(F, len(points)), key=lambda loop: -np.abs(points[loop]).max())
    >>> mesh = MovingMesh(points, F, body)
    >>> for angle in np.radians(np.arange(10, 201, 10)):
    ...     turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    ...     there = mesh.advance(points[body] @ turn)
    >>> bool(np.abs(there[body] - points[body] @ turn).max() == 0)
    True
    """

    @overload
    def __init__(
        self, points: ArrayLike, F: ArrayLike, moved_vertices: ArrayLike, **options: Unpack[MovingKeywords]
    ) -> None: ...
    @overload
    def __init__(self, points: MeshLike, moved_vertices: ArrayLike, **options: Unpack[MovingKeywords]) -> None: ...
    @init_accepts_planar_mesh
    @takes(MovingOptions, MovingKeywords)
    def __init__(
        self, points: ArrayLike, F: ArrayLike, moved_vertices: ArrayLike, **options: Unpack[MovingKeywords]
    ) -> None:
        checked = MovingOptions(**options)
        slide, self._settle, self._linear_solver = checked.slide, checked.settle, checked.linear_solver
        self._energy = find_energy(checked.energy)
        self._volume: MovingTetrahedra | None = None
        if is_volume(points, F):
            check_name(self._linear_solver)
            self._volume = MovingTetrahedra(points, F, moved_vertices, self._settle, slide)
            return
        self._points = map_array("points", points)
        F = triangle_array(F, len(self._points))
        ratio = mean_ratio(self._points, F)
        flat = np.flatnonzero(ratio == 0)
        if flat.size:
            raise ValueError(f"{names_of('triangle', 'triangles', flat)} degenerate: repair the mesh first")
        F[ratio < 0] = F[ratio < 0][:, [0, 2, 1]]
        check_spread(F, len(self._points))
        self._moved = vertex_indices("moved_vertices", moved_vertices, len(self._points))
        check_bool("slide", slide)
        self._slide = bool(slide)
        check_integer("settle", self._settle, minimum=1 if slide else 0)
        rest = np.setdiff1d(boundary_edges(F, len(self._points)), self._moved)
        self._domain = Domain(self._points, F, np.concatenate([self._moved, rest]))
        still = [loop for loop in self._domain.loops if not np.isin(loop, self._moved).any()]
        # Walls without moved vertices keep the curves of the first mesh, so that sliding vertices do not cut corners.
        self._walls = BoundaryCurves.around(still, self._points, fixed=self._moved) if slide and still else None
        # Scale to the mesh's size, so that no area overflows or underflows.
        exponent = np.frexp(np.abs(self._points).max())[1]
        a, b, c = np.ldexp(self._points, -exponent)[self._domain.F].transpose(1, 0, 2)
        area = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        # Small triangles mark regions of interest in a simulation, so all triangles have equal weight, whatever their
        # area.
        self._weights = area.mean() / area
        deformation, exponent = scale_energy(self._domain, self._points, self._energy, self._weights)
        self._descent = MovingDescent(deformation, self._points, self._domain.fixed, exponent, self._linear_solver)
        self._system: SlidingSystem | None = None

    @property
    def points(self) -> FloatArray:
        """A copy of the current mesh; every triangle or tetrahedron is strictly positive, verified exactly."""
        if self._volume is not None:
            return self._volume.points.copy()
        return self._points.copy()

    @property
    def F(self) -> IntArray:
        """The triangles (f, 3), counterclockwise, or tetrahedra (f, 4), positive."""
        if self._volume is not None:
            return self._volume.T
        return self._domain.F

    def advance(self, target: ArrayLike) -> FloatArray:
        """Move the boundary, and the mesh with it.

        Parameters
        ----------
        target : (k, 2) or (k, 3) array
            Next positions of the moved vertices.

        Returns
        -------
        (n, 2) or (n, 3) float64
            The new mesh; also available as ``points``.

        Raises
        ------
        ValueError
            If ``target`` has another shape or is not finite.
        RuntimeError
            If triangles prevent the boundary from reaching its positions. The mesh is then unchanged.
        """
        if self._volume is not None:
            return self._volume.advance(target)
        there = map_array("target", target, self._moved.size, finite=False)
        check_finite("target", "row", "rows", there)
        goal = np.concatenate([there, self._points[self._domain.fixed[self._moved.size :]]])
        try:
            # Overflow gives inf or NaN, and a step with either is never accepted.
            with np.errstate(all="ignore"):
                share = self._descent.move(goal, _TOLERANCE, _MAX_STEPS)
            if share < 1:
                raise RuntimeError(
                    f"the boundary can be moved only {share:.1%} of the way: then triangles become too small for such "
                    "a step; use shorter steps, or a new mesh"
                )
            self._points = self._lower_energy()
        finally:
            # Restart from the new mesh, whose walls may have slid, or from the last mesh after an error.
            self._descent.set_map(self._points)
        return self._points.copy()

    def _lower_energy(self) -> FloatArray:
        """Return the mesh after some steps down the energy."""
        with np.errstate(all="ignore"):
            if not self._slide:
                for _ in self._descent.newton.descend(self._settle, _TOLERANCE):
                    pass
                return self._descent.uv
            model = self._make_sliding_model(self._descent.uv)
            descent = NewtonDescent(model, model.start())
            for _ in descent.descend(self._settle, _TOLERANCE):
                pass
        return model.positions(descent.w)

    def _make_sliding_model(self, here: FloatArray) -> SlidingModel:
        """Return a model with sliding walls; reuse the matrix of the last one if the same vertices slide."""
        domain, curves = self._domain, self._walls
        mixed = any(0 < np.isin(loop, self._moved).sum() < loop.size for loop in domain.loops)
        if curves is None or mixed:
            curves = BoundaryCurves.around(domain.loops, here, fixed=self._moved)
        track = move_boundary(curves, domain, here)
        deformation, exponent = scale_energy(domain, track.uv, self._energy, self._weights)
        model = SlidingModel(
            deformation, track, domain.fixed, domain.loops, exponent, self._linear_solver, self._system
        )
        self._system = model.system
        return model
