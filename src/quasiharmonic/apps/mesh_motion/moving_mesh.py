"""A planar mesh whose boundary moves step by step, as in a simulation: valid at each step, and without drift.

    boundary moves ──Newton, interior follows──▶ valid ──a step down the energy──▶ next time step

The energy compares with the first mesh and does not depend on the path to the present one.

Boundary continuation moves fixed vertices to new positions together with the map, keeping every triangle positive.
The step is a Newton step for the new boundary. Let g be the energy's gradient at the free vertices, H its second
derivative, and Δ the displacement of the fixed vertices. The free vertices move by::

    d = −H⁻¹ (g + (H Δ)_free)

The gradient term also corrects the error of earlier steps. The step is shortened so that no triangle collapses, and
repeated until the fixed vertices reach their target. The map thus changes continuously: it does not jump to another
minimum or to the other way around a hole.
"""

from __future__ import annotations

from typing import NamedTuple, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.mesh_motion.morphing import make_way
from quasiharmonic.apps.tetrahedra.tetrahedral_maps import MovingTetrahedra, is_volume
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.energies.newton.line_search import backtrack
from quasiharmonic.energies.newton.map_model import Coordinates, NewtonObjective, in_units, out_of_units
from quasiharmonic.energies.newton.newton_descent import SHIFTS, NewtonDescent, newton_descent
from quasiharmonic.energies.newton.sliding_boundary import SlidingModel, SlidingSystem, move_boundary
from quasiharmonic.energies.polishing import find_energy, scale_energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.elements import check_spread
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.accepts_mesh import init_accepts_planar_mesh
from quasiharmonic.io.objects import MeshLike
from quasiharmonic.linsolve import check_name
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_bool,
    check_finite,
    check_integer,
    distinct_vertices,
    map_array,
    reject,
    sum_at,
    triangle_array,
)
from quasiharmonic.util.options import MovingOptions, takes


class MotionTuning(NamedTuple):
    """Numbers that tune the steps of a moving mesh."""

    # Step as a fraction of the distance to the first collapse of a triangle.
    fraction: float = 0.8
    # Minimum step, as a share of the remaining displacement.
    min_step: float = 1e-4
    # Minimum decrease, relative to the energy, that a step must predict.
    tolerance: float = 1e-4


_TUNING = MotionTuning()


class MovingDescent:
    """A descent whose fixed vertices can be moved to new positions; see `newton_descent` for the parameters."""

    def __init__(
        self, energy: NewtonObjective, uv: FloatArray, fixed: IntArray, exponent: int, linear_solver: str
    ) -> None:
        self.newton, self._model = newton_descent(energy, uv, fixed, exponent, linear_solver)

    @property
    def uv(self) -> FloatArray:
        """The current map; (n, 2) float64."""
        return self._model.positions(self.newton.w)

    def set_map(self, uv: FloatArray) -> None:
        """Continue from another injective map (n, 2), with the fixed vertices at their positions in it."""
        coordinates = self._model.coordinates
        self._model.coordinates = coordinates.with_pinned(uv[coordinates.fixed])
        self.newton.state = self._model.evaluate(in_units(uv, coordinates.exponent))

    def move(self, target: FloatArray, tol: float, steps: int) -> float:
        """Move the fixed vertices to a target (k, 2), as far as possible without inverting triangles.

        Between two partial moves, one descent step lowers the energy. Return the share of the displacement that was
        reached: 1 if the vertices are exactly at the target.
        """
        left = 1.0
        for k in range(steps):
            if k > 0:
                self.newton.step(tol)
            t = self._move_once(target)
            left *= 1 - t
            if left == 0 or t == 0:
                break
        return 1 - left

    def _move_once(self, target: FloatArray) -> float:
        """Take one step of the displacement; return its length, 1 for all of it and 0 for none."""
        model, start = self._model, self.newton.state
        system, coordinates = model.system, model.coordinates
        displacement = np.zeros_like(start.w)
        displacement[coordinates.fixed] = in_units(target, coordinates.exponent) - start.w[coordinates.fixed]
        model.assemble(start, 0.0)
        found = system.descent(
            model.gradient(start) + self._multiply_curvature(displacement), (0.0, *SHIFTS), model.solve
        )
        if found is None:
            return 0.0
        displacement[system.free] = found[0]

        def evaluate_step(t: float, bound: float) -> tuple[float, Coordinates | None]:
            w = start.w + t * displacement
            there = out_of_units(w[coordinates.fixed], coordinates.exponent)
            moved = coordinates.with_pinned(target if t == 1 else there)
            return 0.0, moved if is_injective(model.energy.F, moved.positions(w)) else None

        longest = min(1.0, _TUNING.fraction * float(model.energy.steps_to_collapse(start.w, displacement).min()))
        if not longest >= _TUNING.min_step:
            return 0.0
        tries = 1 + int(np.log2(longest / _TUNING.min_step))
        taken = backtrack(evaluate_step, 0.0, 0.0, longest=longest, tries=tries)
        if taken is None:
            return 0.0
        model.coordinates = taken.state
        self.newton.state = model.evaluate(start.w + taken.t * displacement)
        return taken.t

    def _multiply_curvature(self, displacement: ComplexArray) -> ComplexArray:
        """Product of the clamped second derivative with a displacement (n,), at the free vertices."""
        energy = self._model.energy
        corners, g = energy.F.T, energy.g
        form = energy.curvature_of(self.newton.state.derivatives)
        p, q = form.apply((g.conj() * displacement[corners]).sum(axis=0), (g * displacement[corners]).sum(axis=0))
        pull, at = (g * p + g.conj() * q).ravel(), corners.ravel()
        return sum_at(at, pull, displacement.size)[self._model.system.free]


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
        needs ``settle`` of at least 1. They make way for moved vertices that arrive along the same straight wall, and
        otherwise lag one step behind the mesh, so they block moved vertices along curved walls. `morph` does not have
        this limitation. Vertices of tetrahedra slide at once, as in `morph`, along the flat parts of the first mesh's
        boundary or along those on the given planes.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.

    Raises
    ------
    ValueError
        If the input is malformed, a triangle has no area, or an option is invalid.

    See Also
    --------
    morph : One large displacement.
    AirMesh : Shapes that must not touch.

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
        reject(ratio == 0, "triangle", "triangles", "{} degenerate: repair the mesh first")
        F[ratio < 0] = F[ratio < 0][:, [0, 2, 1]]
        check_spread(F, len(self._points))
        self._moved = distinct_vertices("moved_vertices", moved_vertices, len(self._points))
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
        return (self._points if self._volume is None else self._volume.points).copy()

    @property
    def F(self) -> IntArray:
        """The triangles (f, 3), counterclockwise, or tetrahedra (f, 4), positive."""
        return self._domain.F if self._volume is None else self._volume.T

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
        goal = self._points.copy()
        goal[self._moved] = there
        if self._slide:
            goal = make_way(True, self._domain.loops, self._points, goal, self._moved)
        try:
            # Overflow gives inf or NaN, and a step with either is never accepted.
            with np.errstate(all="ignore"):
                share = self._descent.move(goal[self._domain.fixed], _TUNING.tolerance, steps=25)
            if share < 1:
                raise RuntimeError(
                    f"the boundary can be moved only {min(share, 0.999):.1%} of the way: then triangles become too "
                    "small for such a step; use shorter steps, or a new mesh"
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
                for _ in self._descent.newton.descend(self._settle, _TUNING.tolerance):
                    pass
                return self._descent.uv
            model = self._make_sliding_model(self._descent.uv)
            descent = NewtonDescent(model, model.start())
            for _ in descent.descend(self._settle, _TUNING.tolerance):
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
