"""Any vertices held at given places and all else free, the boundary too: a bijective map.

    surface ─▶ flattened freely ─▶ moved, turned and scaled onto the pins ─▶ air around it, holes filled, up to a frame
            ─▶ surface and air as one problem of fixed boundary: frame and pins are held, the rest finds its way
            ─▶ bijective; the air is dropped ─▶ guarded descent, nothing held but the pins ─▶ certified

While the frame stays and no triangle of surface and air is inverted, no two points of the surface share a place. So
the search that meets pins inside any outline meets them where there is none. Edges of air between pins can forbid a map
that the surface alone would allow: they are split, as are those that a diagnosis names, for air may have any vertices.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.descent import GuardedDescent, descend
from quasiharmonic.apps.flattening.layout import in_given_unit
from quasiharmonic.apps.flattening.piece import Flattening, Piece, Settings
from quasiharmonic.apps.flattening.pins.obstructions import pin_obstructions
from quasiharmonic.apps.flattening.scaffold.triangulation import air_around
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.refinement import split_edges
from quasiharmonic.geometry.mesh.topology import edge_keys, edges
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis, Kind
from quasiharmonic.problem.result import MapResult, Snapshot, Stage, Status, Step
from quasiharmonic.solver.methods import RandomRestarts, Untangling, VectorAdam
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.solver.search.stages import CoarseToFine, Stages
from quasiharmonic.solver.search.strategy import speed
from quasiharmonic.util.arrays import FloatArray, IntArray, held_places, held_vertices

# How far the map that is moved onto the pins is flattened before.
_TOLERANCE, _STEPS = 1e-2, 40
# Distance of the frame over the longer side of the box around surface and pins, in one try after the other.
_MARGINS = 0.5, 1.5
# Iterations after which tensors are left for vertices, and how many of these: three times as quick in hard cases as to
# wait until tensors have settled, and as sure, since what is tried otherwise comes after.
_FIRST, _UNTANGLING = 60, 300
# Patches in a row that may be started anew in vain, when all else has failed.
_IN_VAIN = 30
# Linear solves at most in each try, unless more are asked for, and times that air is split as a diagnosis says.
_ITERATIONS, _SPLITS = 2000, 4


def pinned(
    piece: Piece,
    fixed: IntArray,
    target: FloatArray,
    settings: Settings,
    weights: FloatArray | None = None,
    start: FloatArray | None = None,
) -> MapResult:
    """Map a surface into the plane bijectively, with some vertices held and the boundary free.

    Parameters
    ----------
    piece : Piece
    fixed : (k,) int64
        Vertices that are held, on the boundary or not, each once; at least one.
    target : (k, 2) float64
        Where they are held.
    settings : Settings
        Of the descent once the map is bijective. The search before it is called back from, too.
    weights : (f,) float64, optional
        How much each triangle's distortion counts.
    start : (n, 2) float64, optional
        An injective map to begin with, of any size and anywhere.

    Returns
    -------
    MapResult
        With ``fixed`` at ``target`` to the last bit. Where ``certificate.bijective``, the status tells how far
        distortion was lowered, as that of `flatten`. Where not, it is ``IMPOSSIBLE`` if there is a proof that no
        bijective map has the vertices there, which the diagnosis gives; otherwise what the search has ended with,
        or ``INJECTIVE`` where no triangle is inverted but the surface overlaps itself.

    Raises
    ------
    ValueError
        When a rest triangle has no area. Places that no map can meet, two vertices in one for instance, are no
        malformed input.
    KeyboardInterrupt
        When Ctrl-C comes before there is any bijective map, with or without pins.
    """
    began = time.perf_counter()
    run = Pinned(piece, fixed, target, settings, weights)
    # Overflow gives inf or NaN, and every comparison with NaN is false: such a step is never accepted.
    with np.errstate(all="ignore"):
        run.run(start)
    return replace(run.result(), seconds=time.perf_counter() - began)


def moved_onto(uv: FloatArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """A map moved, turned and scaled so that vertices come as near to their places as can be, by least squares.

    Parameters
    ----------
    uv : (n, 2) float64
    fixed : (k,) int64
    target : (k, 2) float64

    Returns
    -------
    (n, 2) float64
        Only moved if there is one vertex, or none of this brings them nearer.
    """
    w, there = (np.ascontiguousarray(places).view(np.complex128).ravel() for places in (uv, target))
    here = w[fixed]
    a, b = here - here.mean(), there - there.mean()
    square = float(np.sum(a.real**2 + a.imag**2))
    factor = np.sum(a.conj() * b) / square if square > 0 else 1.0
    if not 0 < abs(factor) < np.inf:
        factor = 1.0
    return ((w - here.mean()) * factor + there.mean()).view(np.float64).reshape(-1, 2)


def _stages(problem: Problem, *, last: bool) -> Stages:
    """What is tried, in which order: air gives way, so that vertices can be moved soon.

    Random restarts are left to the last: other air is a better chance than a hundred tries with this one.
    """
    stages = [stage for stage in speed(problem) if not isinstance(stage, RandomRestarts)]
    if isinstance(stages[0], CoarseToFine):
        return stages
    first = VectorAdam(parameterisation="si-log", iterations=_FIRST)
    restarts = [RandomRestarts(in_vain=_IN_VAIN)] if last else []
    return [first, Untangling(iterations=_UNTANGLING, resume=True), *stages, *restarts]


def checked_pins(fixed: ArrayLike, target: ArrayLike, n: int) -> tuple[IntArray, FloatArray]:
    """Vertices of n and their places, checked: what `flatten` takes as ``fixed`` and ``target``.

    Raises
    ------
    ValueError
        When there is none, one is no vertex or held twice, or a place is missing or not finite.
    """
    vertices = held_vertices(fixed, n)
    if not vertices.size:
        raise ValueError("fixed has no vertex: omit fixed and target, or give at least one vertex")
    return vertices, held_places(target, vertices.size)


# In powers of two: how many times further apart pins may be than the surface is large, or nearer, for energies.
_APART = 100
# In powers of two, in its unit: how far away a map may be from the origin.
_LARGEST = 1000
# Ends of a search that say no more than that no map was found, of which one may be injective all the same.
_UNDECIDED = Status.INJECTIVE, Status.STALLED, Status.OUT_OF_ITERATIONS, Status.UNSOLVABLE


class Pinned:
    """A surface with vertices held, the map of it so far, and what is to be told.

    Parameters
    ----------
    piece, fixed, target, settings, weights
        As `pinned` has them.

    Attributes
    ----------
    certificate : Certificate
        Of the map so far.
    status : Status
    exponent : int
        The map is in units of ``2 ** exponent``: in the piece's, unless pins are so much further apart, or nearer, than
        vertices of the surface that squares of stretches leave the numbers' range, or so far from the origin that they
        would themselves. Energies are then measured as if they were less so; what has the least is the same.
    """

    def __init__(
        self, piece: Piece, fixed: IntArray, target: FloatArray, settings: Settings, weights: FloatArray | None
    ) -> None:
        self._piece, self._settings = piece, settings
        self._fixed, self._given = fixed, target
        # A quarter of it, for the difference of the largest numbers is none.
        extent, quarter = np.frexp(np.ptp(np.ldexp(target, -2), axis=0).max())
        apart = int(quarter) + 2 - piece.exponent if extent > 0 else 0
        unit = piece.exponent + apart - min(max(apart, -_APART), _APART)
        # From the origin they may be still further away; a map there must not leave the numbers' range either.
        self._larger = max(int(np.frexp(np.abs(target).max())[1]) - _LARGEST - unit, 0)
        self.exponent = unit + self._larger
        self._target = np.ldexp(target, -self.exponent)
        self._energy = piece.energy(settings.density, weights)
        self._solver = ""
        self.status = Status.STALLED
        self._diagnosis: Diagnosis | None = None
        self._stages: list[Stage] = []
        self._history: list[Step] = []
        self._path: list[Snapshot] = []

    @property
    def pins(self) -> tuple[IntArray, FloatArray]:
        """The vertices (k,) that are held, and where (k, 2)."""
        return self._fixed, self._target

    def run(self, start: FloatArray | None) -> None:
        """Find a bijective map with the vertices in place, and lower its distortion."""
        moved = self.lay(start)
        if not self.certificate.bijective and self.status is not Status.INTERRUPTED:
            self.seek(moved)
        if self.certificate.bijective and self.status is not Status.INTERRUPTED:
            self.let_go()

    def lay(self, start: FloatArray | None) -> FloatArray:
        """Flatten freely, from a start in the surface's unit if there is one, and move that onto the pins; (n, 2)."""
        piece = self._piece
        rough = replace(
            self._settings, density=SymmetricDirichlet(), name="symmetric-dirichlet", callback=None, record_every=0
        )
        rough = replace(rough, tolerance=_TOLERANCE, max_iterations=_STEPS)
        flat = Flattening(piece, rough, None).run(None if start is None else np.ldexp(start, -piece.exponent))
        self._stages += flat.stages
        self._solver = flat.linear_solver
        if flat.status is Status.INTERRUPTED:
            self.status = Status.INTERRUPTED
        moved = moved_onto(np.ldexp(flat.uv, -self._larger), self._fixed, self._target)
        self.keep(moved)
        return moved

    def seek(self, moved: FloatArray) -> None:
        """Look for a bijective map with the vertices in place, from a bijective map (n, 2) with them elsewhere."""
        piece = self._piece
        n = len(piece.V)
        diagnosis = pin_obstructions(piece.F, n, edges(piece.F, n), self._fixed, self._target)
        if diagnosis.forbids_bijective:
            self.status, self._diagnosis = Status.IMPOSSIBLE, diagnosis
            return
        if not certify(piece.F, moved, loops=piece.loops).bijective:
            # Too far away, or too large or small there, for doubles to tell its triangles.
            self.status = Status.ROUNDED
            return
        for margin in _MARGINS:
            self._search(moved, margin, last=margin == _MARGINS[-1])
            if self.certificate.bijective or self.status in (Status.INTERRUPTED, Status.IMPOSSIBLE):
                return

    def _search(self, flat: FloatArray, margin: float, *, last: bool) -> None:
        """Solve surface and air together, from a bijective map of the surface, with frame and pins held."""
        n, piece = len(flat), self._piece
        try:
            air = air_around(piece.F, flat, piece.loops, margin=margin, around=self._target)
        except ValueError:
            # The boundary is so near to itself that no doubles are in between.
            self.status = Status.ROUNDED
            return
        F, points = np.concatenate([piece.F, air.F]), np.concatenate([flat, air.points])
        fixed = np.concatenate([self._fixed, air.frame])
        target = np.concatenate([self._target, air.points[air.frame - n]])
        inner = edges(F, len(points)).interior
        split = self._of_air(inner[np.isin(inner, fixed).all(axis=1)])
        for _ in range(1 + _SPLITS):
            refined = split_edges(points, F, split)
            F, points = refined.F, refined.V
            problem = Problem(points, F, fixed, target, reference="equilateral")
            settings = self._settings
            found = solve(
                problem,
                strategy=_stages(problem, last=last),
                max_iterations=max(_ITERATIONS, settings.max_iterations),
                linear_solver=settings.linear_solver,
                callback=settings.callback,
            )
            self._stages += found.stages
            self._history += found.history
            before = self.certificate
            uv = found.uv[:n]
            here = certify(piece.F, uv, loops=piece.loops)
            if (
                here.bijective
                or here.inverted.size + here.degenerate.size < before.inverted.size + before.degenerate.size
            ):
                self.keep(uv)
            self.status = found.status
            if here.bijective or found.status is not Status.IMPOSSIBLE or found.diagnosis is None:
                return
            split = self._of_air(found.diagnosis.split)
            if not len(split):
                self._diagnosis = self._of_surface(found.diagnosis)
                self.status = Status.STALLED if self._diagnosis is None else Status.IMPOSSIBLE
                return

    def _of_air(self, pairs: IntArray) -> IntArray:
        """Those edges that belong to no triangle of the surface."""
        F = self._piece.F
        n = max(int(pairs.max(initial=0)) + 1, len(self._piece.V))
        own = edge_keys(F.ravel(), np.roll(F, -1, axis=1).ravel(), n)
        return pairs[~np.isin(edge_keys(pairs[:, 0], pairs[:, 1], n), own)]

    def _of_surface(self, diagnosis: Diagnosis) -> Diagnosis | None:
        """Those obstructions that neither air nor frame have a part in; None where there are none."""
        n, F = len(self._piece.V), self._piece.F
        held = np.zeros(n, dtype=bool)
        held[self._fixed] = True
        own = []
        for obstruction in diagnosis.obstructions:
            vertices = np.concatenate([obstruction.vertices, obstruction.edges.ravel()])
            if vertices.max(initial=-1) >= n or obstruction.triangles.max(initial=-1) >= len(F):
                continue
            if obstruction.kind in (Kind.HALF_PLANES, Kind.HIDDEN):
                # Where the pins do not go all around a vertex, there may be a place for it beyond the frame.
                around = np.setdiff1d(F[np.isin(F, vertices[:1]).any(axis=1)], vertices[:1])
                if not held[around].all():
                    continue
            elif obstruction.kind not in (Kind.COLLAPSED_EDGE, Kind.INVERTED_TRIANGLE, Kind.INVERTED_PATCH, Kind.CHORD):
                continue
            own.append(obstruction)
        return Diagnosis(tuple(own), diagnosis.unchecked) if own else None

    def let_go(self) -> None:
        """Lower the distortion from a bijective map, nothing held but the pins."""
        began, settings = time.perf_counter(), self._settings
        descent = GuardedDescent(self._energy, self._uv, settings.linear_solver, Rim(self._piece.loops), self._fixed)
        self._solver = descent.system.solver.name
        first, steps, status = descent.distortion, 0, Status.STILL_FALLING
        try:
            self._report(descent)
            course = descend(descent, settings.density, settings.tolerance)
            for steps, outcome in enumerate(itertools.islice(course, settings.max_iterations), 1):  # noqa: B007
                status = outcome or status
                self._report(descent)
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        self.keep(descent.uv)
        self.status = status
        seconds, energies = time.perf_counter() - began, (first, descent.distortion)
        self._stages.append(Stage(f"guarded descent, {settings.name}", steps, seconds, (0, 0), energies))

    def _report(self, descent: GuardedDescent) -> None:
        settings, number = self._settings, len(self._history)
        self._history.append(Step(number, 0, descent.distortion))
        if settings.record_every and number % settings.record_every == 0:
            self._path.append(Snapshot(number, self._outward(descent.uv)))
        if settings.callback is not None:
            settings.callback(self._history[-1])

    def keep(self, uv: FloatArray) -> None:
        """Take a map on, in units of ``2 ** exponent``, with the vertices put in place."""
        self._uv = uv.copy()
        self._uv[self._fixed] = self._target
        self.certificate = certify(self._piece.F, self._uv, loops=self._piece.loops)

    def _outward(self, uv: FloatArray) -> FloatArray:
        """A map in the target's unit, the vertices where they were given to the last bit."""
        placed = in_given_unit(uv, self.exponent)
        placed[self._fixed] = self._given
        return placed

    def result(self) -> MapResult:
        """What is handed back."""
        uv = self._outward(self._uv)
        certificate = certify(self._piece.F, uv, loops=self._piece.loops)
        status = self.status
        if certificate.injective and not certificate.bijective and status in _UNDECIDED:
            status = Status.INJECTIVE
        return MapResult(
            uv=uv,
            status=status,
            certificate=certificate,
            stages=self._stages,
            history=self._history,
            path=self._path,
            diagnosis=self._diagnosis,
            linear_solver=self._solver,
        )
