"""Bijective maps with fixed vertices and an otherwise free boundary.

::

    surface ─▶ flattened freely ─▶ shifted, rotated and scaled onto the pins ─▶ air around it up to a frame
            ─▶ surface and air solved as one problem with frame and pins fixed
            ─▶ bijective; the air is removed ─▶ guarded descent with only the pins fixed ─▶ certified

While the frame is fixed and no triangle of surface and air is inverted, the surface does not overlap itself. So the
solver for fixed boundaries also solves this problem. Air edges between pins can forbid a map that the surface alone
allows. These edges are split, and so are air edges that a diagnosis names, because new vertices in the air are
harmless.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.air_triangulation import triangulate_air
from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.flattening_run import Flattening
from quasiharmonic.apps.flattening.piece import Piece, to_given_unit
from quasiharmonic.apps.flattening.pin_obstructions import find_pin_obstructions, select_without_air
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.splitting import split_edges
from quasiharmonic.geometry.mesh.topology import edge_keys, edges, pair_keys
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.mapping import solve
from quasiharmonic.solver.methods import RandomRestarts, Untangling, VectorAdam
from quasiharmonic.solver.search.stages import CoarseToFine, Stages, speed
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    distinct_vertices,
    find_exponent,
    target_positions,
    to_complex,
)
from quasiharmonic.util.options import FlattenOptions


class PinTuning(NamedTuple):
    """Numbers that tune the search for a map with fixed vertices."""

    # Tolerance for the map without pins, which is then moved onto them.
    tol: float = 1e-2
    # Maximum number of steps for that map.
    max_steps: int = 40
    # Distance of the frame, relative to the longer side of the box around surface and pins, for each attempt in turn.
    margins: tuple[float, ...] = (0.5, 1.5)
    # Iterations on tensors before vertices are moved. In hard cases this takes a third of the time of waiting until
    # tensors converge, and is as reliable, since the other methods follow.
    tensor_iterations: int = 60
    # Iterations on vertices.
    vertex_iterations: int = 300
    # Maximum number of consecutive failed restarts of patches, after all other methods have failed.
    max_failures: int = 30
    # Minimum of the limit on linear solves per attempt.
    min_iterations: int = 2000
    # Maximum number of times that air edges are split.
    max_splits: int = 4
    # Binary exponent: maximum ratio between the extent of the pins and the surface's size, either way, for energies.
    max_ratio_exponent: int = 100
    # Binary exponent: maximum distance of a map from the origin, in its unit.
    max_distance_exponent: int = 1000


_TUNING = PinTuning()


def move_onto_pins(uv: FloatArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """Shift, rotate and scale a map so that vertices are as near to target positions as possible, by least squares.

    Only shift it if there is one vertex, or if the best scale is zero or not finite.
    """
    w, there = (to_complex(places) for places in (uv, target))
    here = w[fixed]
    a, b = here - here.mean(), there - there.mean()
    square = float(np.sum(a.real**2 + a.imag**2))
    factor = np.sum(a.conj() * b) / square if square > 0 else 1.0
    if not 0 < abs(factor) < np.inf:
        factor = 1.0
    return ((w - here.mean()) * factor + there.mean()).view(np.float64).reshape(-1, 2)


def _choose_stages(problem: Problem, *, last: bool) -> Stages:
    """The methods to try, in order; the air is flexible, so vertices are moved early.

    Random restarts are used in the last attempt only, as other air is more promising than many restarts with this one.
    """
    stages = [stage for stage in speed(problem) if not isinstance(stage, RandomRestarts)]
    if isinstance(stages[0], CoarseToFine):
        return stages
    first = VectorAdam(parameterisation="si-log", iterations=_TUNING.tensor_iterations)
    restarts = [RandomRestarts(max_failures=_TUNING.max_failures)] if last else []
    return [first, Untangling(iterations=_TUNING.vertex_iterations, resume=True), *stages, *restarts]


def check_pins(fixed: ArrayLike, target: ArrayLike, n: int) -> tuple[IntArray, FloatArray]:
    """Check the arguments ``fixed`` and ``target`` of `flatten` for a mesh of n vertices.

    ValueError if no vertex is given, an index is out of range or repeated, or a position is missing or not finite.
    """
    vertices = distinct_vertices("fixed", fixed, n)
    if not vertices.size:
        raise ValueError("fixed has no vertex: omit fixed and target, or give at least one vertex")
    return vertices, target_positions(target, vertices.size)


# Statuses that only report that no map was found; the map may still be injective.
_UNDECIDED = Status.INJECTIVE, Status.STALLED, Status.OUT_OF_ITERATIONS, Status.UNSOLVABLE


# Its steps ignore overflow, which gives inf or NaN: comparisons with NaN are false, so such a map is never accepted.
class PinSearch:
    """The search for a bijective map with some fixed vertices and an otherwise free boundary, with its record.

    ``target`` (k, 2) are the positions of ``fixed`` (k,), at least one; they may be contradictory. ``options`` are
    those of the descent that follows once the map is bijective. If the result's certificate is bijective, its status
    reports the convergence of the distortion, as for `flatten`. Otherwise the status is ``IMPOSSIBLE`` if the diagnosis
    proves that there is no bijective map, ``INJECTIVE`` if no triangle is inverted but the surface overlaps itself, or
    else that of the search. Ctrl-C raises KeyboardInterrupt before there is any bijective map, with or without pins.
    ValueError if a rest triangle has no area.

    `run` takes all steps for one surface. The steps can also be called one by one, and `result` ends each of these
    sequences:

    - ``run``
    - ``flatten_freely``; then the caller sets ``status`` to ``INTERRUPTED``. This is for a surface that only needs a
      position, because an earlier one was interrupted.
    - ``keep`` of a map that is not bijective, ``find_bijective`` from one or more other maps, then ``lower_distortion``
      if the certificate is bijective and the status is not ``INTERRUPTED``. This is for several surfaces.

    Attributes
    ----------
    certificate : Certificate
        The certificate of the current map, which is NaN at first.
    status : Status
    exponent : int
        The map is in units of ``2 ** exponent``, normally the piece's unit. It differs if the extent of the pins
        differs so much from the surface's size that squared stretches exceed the range of doubles, or if the pins are
        too far from the origin. Energies are then measured for pins at a smaller ratio or distance; the minimum is the
        same.
    """

    def __init__(
        self, piece: Piece, fixed: IntArray, target: FloatArray, options: FlattenOptions, weights: FloatArray | None
    ) -> None:
        self._piece, self._options = piece, options
        self._fixed, self._given = fixed, target
        # Computed from quarters, because the difference of the largest doubles overflows.
        extent, quarter = np.frexp(np.ptp(np.ldexp(target, -2), axis=0).max())
        apart = int(quarter) + 2 - piece.exponent if extent > 0 else 0
        unit = piece.exponent + apart - min(max(apart, -_TUNING.max_ratio_exponent), _TUNING.max_ratio_exponent)
        # Pins may be even farther from the origin, and the map there must also stay within the range of doubles.
        self._larger = max(find_exponent(target) - _TUNING.max_distance_exponent - unit, 0)
        self.exponent = unit + self._larger
        self._target = np.ldexp(target, -self.exponent)
        self._energy = piece.energy(find_energy(options.energy), weights)
        self._solver = ""
        self._uv = np.full((len(piece.V), 2), np.nan)
        self.certificate = certify(piece.F, self._uv, loops=piece.loops)
        self.status = Status.STALLED
        self._diagnosis: Diagnosis | None = None
        self._run = Run(options.callback, options.record_every)

    @property
    def pins(self) -> tuple[IntArray, FloatArray]:
        """The fixed vertices (k,) and their target positions (k, 2)."""
        return self._fixed, self._target

    def run(self, start: FloatArray | None) -> None:
        """Find a bijective map with the vertices at their target positions, and lower its distortion.

        ``start`` (n, 2) is an injective map at any scale and position.
        """
        moved = self.flatten_freely(start)
        if not self.certificate.bijective and self.status is not Status.INTERRUPTED:
            self.find_bijective(moved)
        if self.certificate.bijective and self.status is not Status.INTERRUPTED:
            self.lower_distortion()

    @np.errstate(all="ignore")
    def flatten_freely(self, start: FloatArray | None) -> FloatArray:
        """Flatten freely, optionally from a start in the surface's unit, and move the map onto the pins; (n, 2)."""
        piece = self._piece
        solver = self._options.linear_solver
        rough = FlattenOptions(tol=_TUNING.tol, max_iterations=_TUNING.max_steps, linear_solver=solver)
        flat = Flattening(piece, rough, None).run(None if start is None else np.ldexp(start, -piece.exponent))
        self._run.stages += flat.stages
        self._solver = flat.linear_solver
        if flat.status is Status.INTERRUPTED:
            self.status = Status.INTERRUPTED
        moved = move_onto_pins(np.ldexp(flat.uv, -self._larger), self._fixed, self._target)
        self.keep(moved)
        return moved

    @np.errstate(all="ignore")
    def find_bijective(self, moved: FloatArray) -> None:
        """Find a bijective map with the target positions, from a bijective map (n, 2) without them.

        The result is kept if it is bijective or has fewer wrong triangles than the current map.
        """
        piece = self._piece
        diagnosis = find_pin_obstructions(piece.F, len(piece.V), self._fixed, self._target)
        if diagnosis.forbids_bijective:
            self.status, self._diagnosis = Status.IMPOSSIBLE, diagnosis
            return
        if not certify(piece.F, moved, loops=piece.loops).bijective:
            # At this distance or scale, doubles cannot resolve the triangles.
            self.status = Status.ROUNDED
            return
        for margin in _TUNING.margins:
            self._search(moved, margin, last=margin == _TUNING.margins[-1])
            if self.certificate.bijective or self.status in (Status.INTERRUPTED, Status.IMPOSSIBLE):
                return

    def _search(self, flat: FloatArray, margin: float, *, last: bool) -> None:
        """Solve surface and air together, from a bijective map of the surface, with frame and pins fixed."""
        n, piece = len(flat), self._piece
        try:
            air = triangulate_air(flat, piece.loops, margin=margin, around=self._target)
        except ValueError:
            # There are no doubles between close parts of the boundary.
            self.status = Status.ROUNDED
            return
        F, points = np.concatenate([piece.F, air.F]), np.concatenate([flat, air.points])
        fixed = np.concatenate([self._fixed, air.frame])
        target = np.concatenate([self._target, air.points[air.frame - n]])
        inner = edges(F, len(points)).interior
        split = self._select_air_edges(inner[np.isin(inner, fixed).all(axis=1)])
        for _ in range(1 + _TUNING.max_splits):
            refined = split_edges(points, F, split)
            F, points = refined.F, refined.V
            problem = Problem(points, F, fixed, target, reference="equilateral")
            options = self._options
            found = solve(
                problem,
                strategy=_choose_stages(problem, last=last),
                max_iterations=max(_TUNING.min_iterations, options.max_iterations),
                linear_solver=options.linear_solver,
                callback=options.callback,
            )
            self._run.stages += found.stages
            self._run.history += found.history
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
            split = self._select_air_edges(found.diagnosis.split)
            if not len(split):
                self._diagnosis = select_without_air(found.diagnosis, piece.F, n, self._fixed)
                self.status = Status.STALLED if self._diagnosis is None else Status.IMPOSSIBLE
                return
        else:
            # Further air edges could be split, so nothing is proven.
            self.status = Status.STALLED

    def _select_air_edges(self, pairs: IntArray) -> IntArray:
        """Return the edges that belong to no triangle of the surface."""
        F = self._piece.F
        n = max(int(pairs.max(initial=0)) + 1, len(self._piece.V))
        own = edge_keys(F.ravel(), np.roll(F, -1, axis=1).ravel(), n)
        return pairs[~np.isin(pair_keys(pairs, n), own)]

    @np.errstate(all="ignore")
    def lower_distortion(self) -> None:
        """Lower the distortion of a bijective map with only the pins fixed."""
        options = self._options
        descent = SurfaceDescent(self._energy, self._uv, options.linear_solver, self._fixed, rim=Rim(self._piece.loops))
        self._solver = descent.linear_solver
        self.status = Status.INTERRUPTED
        with self._run.until_interrupted():
            self.status = self._run.descend(
                f"guarded descent, {options.energy_name}",
                itertools.islice(descend(descent, find_energy(options.energy), options.tol), options.max_iterations),
                lambda: descent.distortion,
                lambda: self._to_target_unit(descent.uv),
            )
        self.keep(descent.uv)

    def keep(self, uv: FloatArray) -> None:
        """Store a map in units of ``2 ** exponent``, with the fixed vertices set to their target positions."""
        self._uv = uv.copy()
        self._uv[self._fixed] = self._target
        self.certificate = certify(self._piece.F, self._uv, loops=self._piece.loops)

    def _to_target_unit(self, uv: FloatArray) -> FloatArray:
        """Return a map in the target's unit, with the fixed vertices exactly at their target positions."""
        placed = to_given_unit(uv, self.exponent)
        placed[self._fixed] = self._given
        return placed

    def result(self) -> MapResult:
        """Return the result for the current map."""
        uv = self._to_target_unit(self._uv)
        result = self._run.result(
            uv,
            self._piece.F,
            self.status,
            loops=self._piece.loops,
            diagnosis=self._diagnosis,
            linear_solver=self._solver,
        )
        undecided = result.injective and not result.certificate.bijective and self.status in _UNDECIDED
        return replace(result, status=Status.INJECTIVE) if undecided else result
