"""Flatten one connected surface."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.multilevel import flatten_coarse, map_to_disk
from quasiharmonic.apps.flattening.rigid_steps import ALMOST_FROM, AlmostIsometry, find_almost_isometry
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.apps.flattening.worst_triangles import PatchDescents, has_collapsed, thin_triangles
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import Energy, SymmetricDirichlet
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.line_search import RotationPath
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.geometry.exact.certificate import certify, is_injective
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.linsolve import available
from quasiharmonic.problem import Domain
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run, finish, finish_result
from quasiharmonic.util.arrays import ComplexArray, FloatArray, count_of, find_exponent, pad_to_space, scale_to_unit
from quasiharmonic.util.options import FlattenOptions

#: Surfaces with at least this number of triangles are flattened with coarse meshes.
COARSE_FROM = 50_000
# Below this mean energy, Newton steps start from the given map.
_DIRECT_ENERGY = 1.0
# The same bound for a guarded boundary, which makes all steps short. From higher energies, in which a step at best
# halves the energy, there would be too many steps.
_DISTANT_ENERGY = 1e4
# Energies with a relative difference of at most this are equal.
_EQUAL_ENERGY = 1e-6
# After an overlap, the latest bijective map among this number of last maps may be the start of the guarded descent.
_RECENT = 12
# It is the start if its energy is at most this many times the last one's; otherwise the initial map is better.
_MAX_ENERGY_RATIO = 10.0
# A free descent checks its boundary every so many steps.
_CHECK_EVERY = 8
# It stops if edges at this fraction of the boundary vertices intersect, unless the mean energy is above the second
# number and has fallen below the third fraction since the last check: other boundaries do not separate again.
_TANGLED, _ISOMETRIC, _FALLING = 0.1, 0.02, 0.95
# A map whose overlaps were pulled apart is the result if its energy has grown by at most this factor, plus this amount.
_MAX_PULLED_RATIO, _LEAST_PULLED = 1.001, 1e-6
# Descents from different initial maps agree if their energies differ by at most this fraction.
_AGREE = 0.1
# A descent that has not converged after this number of steps is checked for collapse.
_MANY = 100


def energy_name(options: FlattenOptions) -> str:
    """Return the name of the energy of a flattening, for reports."""
    return options.energy if isinstance(options.energy, str) else type(options.energy).__name__


def is_scale_free(measure: DeformationEnergy, w: ComplexArray) -> bool:
    """Whether the energy of a map (n,) does not depend on its scale."""
    here, doubled = measure.value(w), measure.value(2 * w)
    return abs(doubled - here) <= _EQUAL_ENERGY * here


class Piece:
    """A connected surface that can be flattened, in a unit near its size.

    Raises ValueError as `Domain`, or if the surface has handles or a triangle has no area.

    Attributes
    ----------
    V : (n, 3) float64
        Positions in units of ``2 ** exponent``.
    F : (f, 3) int64
    loops : list of (l,) int64
        Boundary loops.
    exponent : int
    area : float
        Area of the surface, in square units.
    """

    def __init__(self, V: ArrayLike, F: ArrayLike) -> None:
        domain = Domain(V, F, [])
        self.F, self.loops = domain.F, domain.loops
        # Every handle lowers the Euler characteristic by two below that of a disk with as many loops.
        handles, odd = divmod(2 - len(domain.loops) - domain.euler, 2)
        if handles or odd:
            raise ValueError(
                f"the surface has {count_of('handle', 'handles', handles)} and cannot be flattened: "
                "cut it open first (cut_open; --cut of qhm map and qhm flatten)"
            )
        self.exponent = find_exponent(domain.V)
        self.V = pad_to_space(np.ldexp(domain.V, -self.exponent))
        self.area = surface_area(self.V, self.F)

    @classmethod
    def unite(cls, pieces: Sequence[Piece]) -> Piece:
        """Combine several pieces into one that is not connected, with elements in order, in the largest one's unit."""
        made = object.__new__(cls)
        first = np.cumsum([0, *(len(piece.V) for piece in pieces)])[:-1].tolist()
        made.F = np.concatenate([piece.F + k for piece, k in zip(pieces, first, strict=True)])
        made.loops = [loop + k for piece, k in zip(pieces, first, strict=True) for loop in piece.loops]
        made.exponent = max(piece.exponent for piece in pieces)
        smaller = [piece.exponent - made.exponent for piece in pieces]
        made.V = np.concatenate([np.ldexp(piece.V, down) for piece, down in zip(pieces, smaller, strict=True)])
        made.area = float(sum(np.ldexp(piece.area, 2 * down) for piece, down in zip(pieces, smaller, strict=True)))
        return made

    def planar_map(self) -> FloatArray | None:
        """Return the surface itself if it is planar and does not overlap itself, as no map is better."""
        if np.ptp(self.V[:, 2]) > 0:
            return None
        # Seen from the side on which its triangles are counterclockwise.
        uv = self.V[:, :2] * [np.sign(signed_areas(self.F, in_units(self.V[:, :2], 0)).sum()) or 1.0, 1.0]
        return uv if certify(self.F, uv, loops=self.loops).bijective else None

    def thin_planar_map(self) -> FloatArray | None:
        """Return `planar_map` if all triangles are so thin that energies are dominated by rounding errors."""
        return self.planar_map() if thin_triangles(self.V, self.F).all() else None

    def energy(self, density: Energy, weights: FloatArray | None) -> DeformationEnergy:
        """Return the energy of the piece's maps."""
        if weights is not None:
            return DeformationEnergy(self.V, self.F, density, weights=weights)
        return self._reference.with_density(density)

    @cached_property
    def _reference(self) -> DeformationEnergy:
        """An energy that knows the rest shapes of the triangles."""
        return DeformationEnergy(self.V, self.F, SymmetricDirichlet())


@dataclass
class _Attempt:
    """The result of the descents from one initial map."""

    energy: float
    uv: FloatArray
    status: Status
    solver: str
    stages: range


class Flattening:
    """The flattening of one surface, with its record for the result; ``weights`` is (f,) or None."""

    def __init__(self, piece: Piece, options: FlattenOptions, weights: FloatArray | None) -> None:
        self._piece, self._options, self._weights = piece, options, weights
        self._density = find_energy(options.energy)
        self._rim = Rim(piece.loops)
        self._measure = piece.energy(self._density, weights)
        self._bijective: FloatArray | None = None
        # Whether a free descent ended with an overlap, and the map, if it had converged.
        self._overlaps = False
        self._overlapping: FloatArray | None = None
        self._starts = self._default_starts()
        # Solver and initial energy of the initial maps already used.
        self._begun: set[tuple[str, float]] = set()
        self._solver = ""
        self._run = Run(options.callback, options.record_every)

    def run(self, start: FloatArray | None) -> MapResult:
        """Flatten the piece from an injective map (n, 2) in the piece's unit, or from a default initial map.

        Ctrl-C before there is a bijective map raises KeyboardInterrupt.
        """
        status = Status.INTERRUPTED
        with self._run.until_interrupted():
            if (flat := self._piece.thin_planar_map()) is not None:
                status = self._keep(flat)
            else:
                status = self._descend(start)
                if self._has_collapsed(status):
                    status = self._restart(status)
        found = self._bijective
        if found is None:
            raise KeyboardInterrupt

        def end() -> MapResult:
            uv = self._fit_scale(found) if is_scale_free(self._measure, in_units(found, 0)) else found
            return self._run.result(uv, self._piece.F, status, loops=self._piece.loops, linear_solver=self._solver)

        return finish_result(end)

    def _keep(self, uv: FloatArray) -> Status:
        """Use a bijective map without descending."""
        self._options = replace(self._options, max_iterations=0)
        self._run_descent(self._fit_scale(uv), guarded=False, near=True)
        return Status.EXHAUSTED

    def _descend(self, start: FloatArray | None) -> Status:
        """Descend with a free boundary; if the result overlaps itself, descend again with a guarded boundary."""
        almost = self._find_almost_isometry() if start is None else None
        start = almost.uv if almost is not None else start
        if start is not None:
            start = self._fit_scale(start)
            if not self._rim.meets_itself(start):
                self._bijective = start
            near = almost is not None
            status = self._run_descent(start, guarded=False, near=near, rotations=almost and almost.rotations)
            if status is not None:
                return status
        if self._bijective is None:
            # There was no start, or both the start and the map that it led to overlap themselves.
            own, near = self._first_default_start()
            status = self._run_descent(own, guarded=False, near=near)
            if status is not None:
                return status
        return self._descend_guarded()

    def _find_almost_isometry(self) -> AlmostIsometry | None:
        """Return an almost isometric map of a large surface, if there is one."""
        piece, solver = self._piece, self._options.linear_solver
        if len(piece.F) < ALMOST_FROM or self._weights is not None or np.ptp(piece.V[:, 2]) == 0:
            return None
        found = find_almost_isometry(piece.V, self._measure, piece.loops, solver)
        if found is not None:
            energy = self._measure.value(in_units(found.uv, 0))
            self._run.add_stage("start", energy=(energy, energy))
        return found

    def _descend_guarded(self) -> Status:
        """Descend from the current bijective map with a guarded boundary."""
        assert self._bijective is not None
        near = self._measure.value(in_units(self._bijective, 0)) < _DISTANT_ENERGY
        status = self._run_descent(self._bijective, guarded=True, near=near)
        assert status is not None
        return status

    def _has_collapsed(self, status: Status) -> bool:
        """Whether a descent that ended with this status stalled at a collapsed map."""
        # A converged map is a minimum. Only the barriers of a cramped boundary can imitate convergence, and then there
        # is an overlapping map to compare with.
        converged = status is Status.POLISHED and self._overlapping is None
        falling = status is Status.STILL_FALLING and self._run.stages[-1].n_iterations < _MANY
        if converged or falling or status is Status.INTERRUPTED:
            return False
        assert self._bijective is not None
        piece, uv = self._piece, self._bijective
        angles_alone = is_scale_free(self._measure, in_units(uv, 0))
        return has_collapsed(
            piece.V, piece.F, piece.loops, piece.area, uv, self._overlapping, angles_alone=angles_alone
        )

    def _restart(self, status: Status) -> Status:
        """Descend from other initial maps until one result has not collapsed; otherwise use the best result."""
        attempts, first = [self._record_attempt(status, 0)], len(self._run.stages)
        with self._run.until_interrupted():
            while (own := self._next_default_start()) is not None:
                found = self._run_descent(own[0], guarded=False, near=own[1]) if not self._overlaps else None
                status = found or self._descend_guarded()
                attempts.append(self._record_attempt(status, first))
                if not self._has_collapsed(status):
                    return self._choose(attempts, attempts[-1])
                if self._agree(attempts):
                    return self._choose(attempts)
                first = len(self._run.stages)
            self._choose(attempts)
            return Status.COLLAPSED
        self._choose([*attempts, self._record_attempt(Status.INTERRUPTED, first)])
        return Status.INTERRUPTED

    def _agree(self, attempts: Sequence[_Attempt]) -> bool:
        """Whether another initial map led to the same energy, so that the surface requires the stretch."""
        *others, last = attempts
        least = min(attempt.energy for attempt in attempts)

        def begun(attempt: _Attempt) -> float:
            return self._run.stages[attempt.stages.start].energy[0]

        return last.energy <= (1 + _AGREE) * least and any(
            other.energy <= (1 + _AGREE) * least and abs(begun(other) - begun(last)) > _AGREE * begun(last)
            for other in others
        )

    def _record_attempt(self, status: Status, first: int) -> _Attempt:
        """Record the current map, the result of the stages from ``first`` on."""
        assert self._bijective is not None
        energy = self._measure.value(in_units(self._bijective, 0))
        return _Attempt(energy, self._bijective, status, self._solver, range(first, len(self._run.stages)))

    def _choose(self, attempts: Sequence[_Attempt], best: _Attempt | None = None) -> Status:
        """Use the result of one attempt, by default the one with the least energy, and mark the others as discarded."""
        best = best or min(attempts, key=lambda attempt: attempt.energy)
        for attempt in attempts:
            for k in attempt.stages if attempt is not best else ():
                self._run.stages[k] = replace(self._run.stages[k], kept=False)
        self._bijective, self._solver = best.uv, best.solver
        return best.status

    def _first_default_start(self) -> tuple[FloatArray, bool]:
        """Return the first default initial map that exists, and whether it is already near the minimum."""
        own = self._next_default_start()
        if own is None:
            raise ValueError(
                "no initial bijective map was found in double precision: the triangles differ too much in "
                "size; give a bijective map as start"
            )
        return own

    def _next_default_start(self) -> tuple[FloatArray, bool] | None:
        """The next default initial map that exists, and whether it is near the minimum already; None at the end."""
        for name, start in self._starts:
            uv = start()
            if uv is None:
                continue
            uv = self._fit_scale(uv)
            energy = self._measure.value(in_units(uv, 0))
            if (self._options.linear_solver, energy) in self._begun:
                # The coarse mesh of a small surface is the surface itself.
                continue
            self._begun.add((self._options.linear_solver, energy))
            self._bijective = uv
            self._run.add_stage(f"start again, {name}" if self._run.stages else "start", energy=(energy, energy))
            return uv, energy < _DIRECT_ENERGY
        return None

    def _default_starts(self) -> Iterator[tuple[str, Callable[[], FloatArray | None]]]:
        """Initial bijective maps, the most promising first; each is computed on demand and may not exist."""
        piece, solver = self._piece, self._options.linear_solver
        surface = piece.V, piece.F, piece.loops
        disk = "disk", partial(map_to_disk, *surface, solver)
        large = len(piece.F) >= COARSE_FROM
        yield "as it lies", piece.planar_map
        if not large:
            yield disk
        yield "coarse mesh", partial(flatten_coarse, *surface, solver)
        yield "coarse mesh, guarded", partial(flatten_coarse, *surface, solver, guarded=True)
        if large:
            yield disk
        for other in [name for name in available() if name != self._solver][:1]:
            self._options = replace(self._options, linear_solver=other)
            yield f"coarse mesh, {other}", partial(flatten_coarse, *surface, other)

    def _fit_scale(self, uv: FloatArray) -> FloatArray:
        """Scale a map to the surface's area; if this inverts a triangle, scale exactly by a power of two."""
        unit = scale_to_unit(uv)
        centred = unit - unit.mean(axis=0)
        area = float(signed_areas(self._piece.F, in_units(unit, 0)).sum())
        # The area of needles can be lost by rounding.
        factor = np.sqrt(self._piece.area / area) if area > 0 else 1.0
        scaled = centred * factor
        return scaled if is_injective(self._piece.F, scaled) else np.ldexp(unit, round(np.log2(factor)))

    def _run_descent(
        self, uv: FloatArray, *, guarded: bool, near: bool, rotations: RotationPath | None = None
    ) -> Status | None:
        """Descend from a map, which must be bijective if ``guarded``; return None if the result overlaps itself."""
        options, solver = self._options, self._options.linear_solver
        energy = self._measure if near else self._piece.energy(ReweightedDirichlet(), self._weights)
        rim = self._rim if guarded else None
        descent = SurfaceDescent(energy, uv, solver, rim=rim, iterate=True, rotations=rotations)
        self._solver = descent.linear_solver
        status = Status.STILL_FALLING
        recent: deque[tuple[float, FloatArray]] = deque(maxlen=_RECENT)

        def measure() -> float:
            return self._measure.value(descent.w)

        def take_steps() -> Iterator[Status | None]:
            patches = None if guarded else PatchDescents(self._measure, solver).improve
            course = descend(descent, self._density, options.tol, patches)
            last = np.inf
            for number, outcome in enumerate(itertools.islice(course, options.max_iterations), 1):
                recent.append((measure(), descent.uv))
                yield outcome
                if guarded or number % _CHECK_EVERY:
                    continue
                falls, last = _ISOMETRIC < recent[-1][0] < _FALLING * last, recent[-1][0]
                tangled = not falls and self._rim.tangled_fraction(descent.uv) > _TANGLED
                if tangled and self._rim.pull_apart(self._piece.F, descent.uv) is None:
                    return

        name = f"{'guarded' if guarded else 'free'} descent, {energy_name(options)}"
        exponent = self._piece.exponent

        def end() -> tuple[bool, FloatArray | None]:
            apart = guarded or not self._rim.meets_itself(descent.uv)
            pulled = None if apart else self._rim.pull_apart(self._piece.F, descent.uv)
            if apart:
                self._bijective = descent.uv
            elif pulled is not None:
                self._bijective = pulled
            else:
                self._overlaps = True
                self._overlapping = descent.uv if status is not Status.STILL_FALLING else None
                self._bijective = self._latest_bijective(recent, _MAX_ENERGY_RATIO * measure())
            self._run.judge_last_stage(kept=apart or pulled is not None)
            return apart, pulled

        try:
            status = self._run.descend(name, take_steps(), measure, lambda: to_given_unit(descent.uv, exponent))
        finally:
            # After Ctrl-C too, the current map may be better than the previous one.
            (apart, pulled), interrupted = finish(end)
            if interrupted:
                raise KeyboardInterrupt
        if pulled is None:
            return status if apart else None
        before, after = measure(), self._measure.value(in_units(pulled, 0))
        self._run.add_stage("overlaps pulled apart", n_iterations=1, energy=(before, after))
        self._run.record(0, after, lambda: to_given_unit(pulled, exponent))
        # If the pulled triangles are distorted too much, a guarded descent continues from there.
        return status if after <= _MAX_PULLED_RATIO * before + _LEAST_PULLED else None

    def _latest_bijective(self, recent: Iterable[tuple[float, FloatArray]], most: float) -> FloatArray | None:
        """Return the latest of several maps that is bijective and has at most this energy, or else the stored map."""
        for energy, uv in reversed([*recent]):
            if energy <= most and not self._rim.meets_itself(uv):
                return uv
        return self._bijective


def check_in_range(uv: FloatArray) -> FloatArray:
    """Return a map unchanged if it is finite; otherwise raise ValueError."""
    if not np.isfinite(uv).all():
        raise ValueError("the map is outside the range of doubles (1e308): scale the surface or the pins down")
    return uv


def to_given_unit(uv: FloatArray, exponent: int) -> FloatArray:
    """Convert a map from units of ``2 ** exponent`` to the original unit; ValueError as `check_in_range`."""
    with np.errstate(over="ignore"):
        return check_in_range(np.ldexp(uv, exponent))
