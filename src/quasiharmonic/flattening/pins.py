"""Any vertices held at given places, all else free, boundary and all: a bijective map.

    surface ─▶ flattened freely ─▶ moved onto the pins as a rigid body, or nearly ─▶ air around it, holes filled, up to a frame
            ─▶ surface and air together as a problem of fixed boundary: frame and pins are held, the rest finds its way
            ─▶ bijective; air forgotten ─▶ guarded descent, only the pins held ─▶ certified

As the frame stays and no triangle of surface and air is inverted, no two points of the surface share a place; so the
solver that meets pins inside any outline meets them where there is none. Edges of air between pins can forbid a map that
the surface itself would allow. These are split where a diagnosis names them: air may have any vertices.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.arrays import check_finite, check_range, index_array, real_array
from quasiharmonic.certificate import Certificate, certify
from quasiharmonic.diagnosis import Diagnosis
from quasiharmonic.energies import Energy, SymmetricDirichlet
from quasiharmonic.flattening.air import air_around
from quasiharmonic.flattening.contacts import Rim
from quasiharmonic.flattening.descent import GuardedDescent, descend
from quasiharmonic.flattening.piece import Flattening, Piece, Settings
from quasiharmonic.flattening.pin_obstructions import pin_obstructions
from quasiharmonic.inject import solve
from quasiharmonic.mesh.topology import edge_keys, edges, named
from quasiharmonic.polishing import energy_named, not_negative
from quasiharmonic.problem import Problem
from quasiharmonic.refinement import refine
from quasiharmonic.result import MapResult, Stage, Status, Step
from quasiharmonic.strategy import whole_number

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# The map that is moved onto the pins: as good as it gets in little time.
_ROUGH, _STEPS = 1e-2, 40
# Distance of the frame over the box of surface and pins, in one try after the other.
_MARGINS = 0.5, 1.5
# Linear solves for each try.
_ITERATIONS = 2000
# Times that edges of air are split as a diagnosis says.
_SPLITS = 4


def pinned(
    V: ArrayLike,
    F: ArrayLike,
    fixed: ArrayLike,
    target: ArrayLike,
    *,
    energy: str | Energy = "symmetric-dirichlet",
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 500,
    tolerance: float = 1e-4,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
) -> MapResult:
    """Map a surface into the plane bijectively, some vertices held and the boundary free.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions.
    F : (f, 3) array of int
        Triangles of one connected surface with at least one boundary loop and no handles.
    fixed : (k,) array of int
        Vertices that are held, each once, on the boundary or not; at least one.
    target : (k, 2) array
        Where.
    energy, weights, start, max_iterations, tolerance, linear_solver, callback
        As `flatten` has them. ``max_iterations`` are Newton steps once the map is bijective.

    Returns
    -------
    MapResult
        With ``fixed`` at ``target`` to the last bit. Where the map is bijective, ``certificate.bijective``, the status
        tells how far distortion has been lowered, as that of `flatten`. Where it is not, the status is ``IMPOSSIBLE``
        if it is known why, and the diagnosis says so; otherwise what the search ended with, or ``INJECTIVE`` when no
        triangle is inverted but the surface overlaps itself.

    Raises
    ------
    ValueError
        When the input is malformed; see `flatten`. Pins that no map can meet, two in one place for instance, are no
        malformed input.
    """
    began = time.perf_counter()
    whole_number("max_iterations", max_iterations, least=0)
    not_negative("tolerance", tolerance)
    density = energy_named(energy)
    name = energy if isinstance(energy, str) else type(energy).__name__
    settings = Settings(density, name, tolerance, max_iterations, linear_solver, callback, 0)
    run = _Pinned(Piece(V, F), *_pins(fixed, target, len(np.asarray(V))), settings)
    given = None if weights is None else real_array("weights", weights)
    run.place(None if start is None else real_array("start", start))
    if run.certificate.bijective:
        run.let_go(given)
    return replace(run.result(), seconds=time.perf_counter() - began)


def _pins(fixed: ArrayLike, target: ArrayLike, n: int) -> tuple[IntArray, FloatArray]:
    """Pins and their places, checked."""
    vertices, places = index_array("fixed", fixed), real_array("target", target)
    if vertices.ndim != 1 or not vertices.size:
        raise ValueError(f"fixed must have shape (k,) with k > 0, not {vertices.shape}")
    check_range("fixed", vertices, n)
    times = np.bincount(vertices, minlength=n)
    if times.max() > 1:
        raise ValueError(f"{named('vertex', 'vertices', np.flatnonzero(times > 1))} fixed more than once")
    if places.shape != (vertices.size, 2):
        raise ValueError(f"target must have shape ({vertices.size}, 2), a position a fixed vertex, not {places.shape}")
    check_finite("target", "row", "rows", places)
    return vertices, places


@dataclass
class _Pinned:
    """A surface with pins, the map of it so far, and what is to be told of that; all in the piece's unit."""

    piece: Piece
    fixed: IntArray
    target: FloatArray
    settings: Settings
    uv: FloatArray = field(init=False)
    certificate: Certificate = field(init=False)
    status: Status = Status.SETTLED
    diagnosis: Diagnosis | None = None
    stages: list[Stage] = field(default_factory=list)
    history: list[Step] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._inner_target = np.ldexp(self.target, -self.piece.exponent)

    def place(self, start: FloatArray | None) -> None:
        """Find a bijective map with the pins in place."""
        piece, n = self.piece, len(self.piece.V)
        settings = replace(
            self.settings, density=SymmetricDirichlet(), name="symmetric-dirichlet", tolerance=_ROUGH, max_iterations=_STEPS, callback=None
        )
        flat = Flattening(piece, settings, None).run(None if start is None else np.ldexp(start, -piece.exponent))
        self.stages += flat.stages
        flat_uv = moved_onto(flat.uv, self.fixed, self._inner_target)
        self._keep(flat_uv)
        if self.certificate.bijective:
            return
        diagnosis = pin_obstructions(piece.F, n, edges(piece.F, n), self.fixed, self._inner_target)
        if diagnosis.forbids_bijective:
            self.status, self.diagnosis = Status.IMPOSSIBLE, diagnosis
            return
        for margin in _MARGINS:
            self._solve_within_frame(flat_uv, margin)
            if self.certificate.bijective or self.status is Status.INTERRUPTED:
                return

    def _solve_within_frame(self, flat: FloatArray, margin: float) -> None:
        """Solve surface and air together, frame and pins held."""
        piece = self.piece
        air = air_around(piece.F, flat, piece.loops, margin=margin, around=self._inner_target)
        F, points = np.concatenate([piece.F, air.F]), np.concatenate([flat, air.points])
        fixed = np.concatenate([self.fixed, air.frame])
        target = np.concatenate([self._inner_target, points[air.frame]])
        F, points = self._without(F, points, fixed, _chords(piece, F, fixed))
        for _ in range(_SPLITS + 1):
            problem = Problem(points, F, fixed, target, reference="equilateral")
            result = solve(problem, max_iterations=_ITERATIONS, linear_solver=self.settings.linear_solver)
            self.stages += result.stages
            certificate = certify(piece.F, result.uv[: len(flat)], loops=piece.loops)
            if certificate.bijective or len(certificate.flipped) <= len(self.certificate.flipped):
                self._keep(result.uv[: len(flat)])
                self.status, self.diagnosis = result.status, None
            if certificate.bijective or result.status is not Status.IMPOSSIBLE or result.diagnosis is None:
                return
            named_ = self._of_air(F, result.diagnosis.split)
            if not len(named_):
                self.diagnosis = _of_surface(result.diagnosis, len(flat))
                return
            F, points = self._without(F, points, fixed, named_)

    def _of_air(self, F: IntArray, pairs: IntArray) -> IntArray:
        """Those edges that belong to no triangle of the surface."""
        n = int(F.max()) + 1
        own = self.piece.F
        keys = np.unique(edge_keys(own.ravel(), np.roll(own, -1, axis=1).ravel(), n))
        return pairs[~np.isin(edge_keys(pairs[:, 0], pairs[:, 1], n), keys)]

    def _without(
        self, F: IntArray, points: FloatArray, fixed: IntArray, chords: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Triangles and points with edges of air split."""
        refined = refine(points, F, chords)
        return refined.F, refined.V

    def let_go(self, weights: FloatArray | None) -> None:
        """Lower the distortion, all but the pins free."""
        began, piece, settings = time.perf_counter(), self.piece, self.settings
        surface = piece.energy(settings.density, weights)
        rim = Rim(piece.loops)
        status, steps = Status.STILL_FALLING, 0
        with np.errstate(all="ignore"):
            descent = GuardedDescent(surface, self.uv, settings.linear_solver, rim, self.fixed)
        first = descent.distortion
        self._report(first)
        try:
            course = descend(descent, settings.density, settings.tolerance)
            for steps, outcome in enumerate(itertools.islice(course, settings.max_iterations), 1):  # noqa: B007
                status = outcome or status
                self._report(descent.distortion)
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        self._keep(descent.uv)
        self.status = status
        seconds, name = time.perf_counter() - began, f"guarded descent, {settings.name}"
        self.stages.append(Stage(name, steps, seconds, (0, 0), (first, descent.distortion)))

    def _report(self, value: float) -> None:
        self.history.append(Step(len(self.history), 0, value))
        if self.settings.callback is not None:
            self.settings.callback(self.history[-1])

    def _keep(self, uv: FloatArray) -> None:
        """Take a map on, its pins put in place."""
        self.uv = uv.copy()
        self.uv[self.fixed] = self._inner_target
        self.certificate = certify(self.piece.F, self.uv, loops=self.piece.loops)

    def result(self) -> MapResult:
        """What is handed back, in the target's unit."""
        uv = np.ldexp(self.uv, self.piece.exponent)
        uv[self.fixed] = self.target
        certificate = certify(self.piece.F, uv, loops=self.piece.loops)
        status = self.status
        if certificate.injective and not certificate.bijective and self.diagnosis is None:
            status = Status.INJECTIVE
        return MapResult(
            uv=uv,
            status=status,
            certificate=certificate,
            stages=self.stages,
            history=self.history,
            diagnosis=self.diagnosis,
        )


def moved_onto(uv: FloatArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """The map moved, turned and scaled so that vertices are as near as can be to their places, by least squares.

    Parameters
    ----------
    uv : (n, 2) float64
    fixed : (k,) int64
    target : (k, 2) float64

    Returns
    -------
    (n, 2) float64
        Of its own size if there is one vertex only.
    """
    w, there = (np.ascontiguousarray(array).view(np.complex128).ravel() for array in (uv, target))
    here = w[fixed]
    a, b = here - here.mean(), there - there.mean()
    square = float(np.sum(np.abs(a) ** 2))
    factor = np.sum(a.conj() * b) / square if square > 0 else 1.0
    if not 0 < abs(factor) < np.inf:
        factor = 1.0
    moved = (w - here.mean()) * factor + there.mean()
    return np.ascontiguousarray(moved).view(np.float64).reshape(-1, 2)


def _chords(piece: Piece, F: IntArray, fixed: IntArray) -> IntArray:
    """Edges of air between two vertices that are held."""
    n = int(F.max()) + 1
    held = np.zeros(n, dtype=bool)
    held[fixed] = True
    inner = edges(F, n).interior
    own = piece.F
    keys = np.unique(edge_keys(own.ravel(), np.roll(own, -1, axis=1).ravel(), n))
    inner = inner[held[inner].all(axis=1)]
    return inner[~np.isin(edge_keys(inner[:, 0], inner[:, 1], n), keys)]


def _of_surface(diagnosis: Diagnosis, n: int) -> Diagnosis | None:
    """Those obstructions that speak of the surface's elements only; None if there are none."""
    own = tuple(o for o in diagnosis.obstructions if max(o.vertices.max(initial=-1), o.edges.max(initial=-1)) < n)
    return Diagnosis(own, diagnosis.unchecked) if own else None
