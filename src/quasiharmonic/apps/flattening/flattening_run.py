"""The descents that flatten one surface, first with a free boundary.

initial map ──▶ free descent ──▶ overlaps itself? ── no ──▶ collapsed? ── no ──▶ map
     ▲                                 │ yes                  ▲  │ yes
     │                          guarded descent ──────────────┘  │
     └────────────────── next initial map ◀──────────────────────┘

Overlaps are first pulled apart. If that fails or distorts the map, the guarded descent follows. It also replaces the
free descent from each initial map that is tried because of a collapse, once any free descent has ended with an overlap.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.large_surfaces import ALMOST_FROM, AlmostIsometry, find_almost_isometry
from quasiharmonic.apps.flattening.piece import InitialMap, Piece, list_initial_maps, to_given_unit
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.apps.flattening.worst_triangles import PatchDescents, has_collapsed
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.line_search import RotationPath
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run, finish, finish_result
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.options import FlattenOptions


class RunTuning(NamedTuple):
    """Numbers that tune the descents of a flattening. Energies are means over the surface."""

    # Below this energy, Newton steps start from the given map.
    direct_energy: float = 1.0
    # The same bound for a guarded boundary, which makes all steps short. From higher energies, in which a step at best
    # halves the energy, there would be too many steps.
    distant_energy: float = 1e4
    # After an overlap, the latest bijective map among this number of last maps may be the start of the guarded descent.
    recent: int = 12
    # It is the start if its energy is at most this many times the last one's; otherwise the initial map is better.
    max_energy_ratio: float = 10.0
    # A free descent checks its boundary every so many steps.
    check_every: int = 8
    # It stops if edges at this fraction of the boundary vertices intersect, unless the energy is above the second
    # number and has fallen below the third fraction since the last check: other boundaries do not separate again.
    tangled: float = 0.1
    isometric: float = 0.02
    falling: float = 0.95
    # A map whose overlaps were pulled apart is the result if its energy has grown by at most this factor, plus the
    # second number.
    max_pulled_ratio: float = 1.001
    least_pulled: float = 1e-6
    # Descents from different initial maps agree if their energies differ by at most this fraction.
    agree: float = 0.1
    # A descent that has not converged after this number of steps is checked for collapse.
    many: int = 100


_TUNING = RunTuning()


@dataclass
class _Attempt:
    """The result of the descents from one initial map."""

    energy: float
    uv: FloatArray
    status: Status
    solver: str
    stages: range


class _Found(NamedTuple):
    """The bijective map (n, 2) of a descent, and whether its overlaps were pulled apart."""

    uv: FloatArray
    pulled: bool


class Flattening:
    """The flattening of one surface, with its record for the result; ``weights`` is (f,) or None."""

    def __init__(self, piece: Piece, options: FlattenOptions, weights: FloatArray | None) -> None:
        self._piece, self._options, self._weights = piece, options, weights
        self._density = find_energy(options.energy)
        self._rim = Rim(piece.loops)
        self._measure = piece.energy(self._density, weights)
        self._run = Run(options.callback, options.record_every)
        # The solver of the next descents, by the name that was asked for, and that of the last descent.
        self._wanted_solver, self._solver = options.linear_solver, ""
        self._starts = list_initial_maps(piece, self._measure, options.linear_solver, lambda: self._solver)
        # The map so far.
        self._bijective: FloatArray | None = None
        # Whether any free descent has ended with an overlap. It is never cleared: an overlap is usually required by the
        # surface, so a free descent from another initial map would end with one too.
        self._overlaps = False
        # The map of the last such descent, if it had converged. It shows how much stretch the surface requires, so the
        # maps from all later initial maps are compared with it.
        self._overlapping: FloatArray | None = None

    def run(self, start: FloatArray | None) -> MapResult:
        """Flatten the piece from an injective map (n, 2) in the piece's unit, or from a default initial map.

        Ctrl-C before there is a bijective map raises KeyboardInterrupt.
        """
        status = Status.INTERRUPTED
        with self._run.until_interrupted():
            if (flat := self._piece.thin_planar_map()) is not None:
                status = self._keep_planar(flat)
            else:
                status = self._descend(start)
                if self._has_collapsed(status):
                    status = self._restart(status)
        found = self._bijective
        if found is None:
            assert self._run.interrupted
            raise KeyboardInterrupt

        def end() -> MapResult:
            uv = self._fit_scale(found) if self._measure.is_scale_free(in_units(found, 0)) else found
            return self._run.result(uv, self._piece.F, status, loops=self._piece.loops, linear_solver=self._solver)

        return finish_result(end)

    def _keep_planar(self, flat: FloatArray) -> Status:
        """Use a planar surface as its own map, because rounding errors dominate the energies of its thin triangles."""
        self._bijective = uv = self._fit_scale(flat)
        self._solver = SurfaceDescent(self._measure, uv, self._wanted_solver, iterate=True).linear_solver
        # The record has a stage, of no steps, as that of any other surface.
        name, exponent = f"free descent, {self._options.energy_name}", self._piece.exponent
        self._run.descend(name, (), lambda: self._energy(uv), lambda: to_given_unit(uv, exponent))
        return Status.EXHAUSTED

    def _fit_scale(self, uv: FloatArray) -> FloatArray:
        """Scale a bijective map to the surface's area, unless rounding then makes its boundary meet itself."""
        scaled = self._piece.fit_scale(uv)
        return uv if self._rim.meets_itself(scaled) else scaled

    def _descend(self, start: FloatArray | None) -> Status:
        """Descend with a free boundary and, if `_run_descent` asks for it, again with a guarded boundary."""
        almost = self._find_almost_isometry() if start is None else None
        start = almost.uv if almost is not None else start
        if start is not None:
            start = self._piece.fit_scale(start)
            if not self._rim.meets_itself(start):
                self._bijective = start
            near = almost is not None
            status = self._run_descent(start, guarded=False, near=near, rotations=almost and almost.rotations)
            if status is not None:
                return status
        if self._bijective is None:
            # There was no start, or both the start and the map that it led to overlap themselves.
            own = self._begin_anew()
            if own is None:
                raise ValueError(
                    "no initial bijective map was found in double precision: the triangles differ too much in "
                    "size; give a bijective map as start"
                )
            status = self._descend_free(own)
            if status is not None:
                return status
        return self._descend_guarded()

    def _find_almost_isometry(self) -> AlmostIsometry | None:
        """Return an almost isometric map of a large surface, if there is one."""
        piece, solver = self._piece, self._wanted_solver
        if len(piece.F) < ALMOST_FROM or self._weights is not None or np.ptp(piece.V[:, 2]) == 0:
            return None
        found = find_almost_isometry(piece.V, self._measure, piece.loops, solver)
        if found is not None:
            energy = self._energy(found.uv)
            self._run.add_stage("start", energy=(energy, energy))
        return found

    def _begin_anew(self) -> InitialMap | None:
        """Use the next default initial map that exists."""
        own = next(self._starts, None)
        if own is not None:
            self._bijective, self._wanted_solver = own.uv, own.linear_solver
            name = f"start again, {own.name}" if self._run.stages else "start"
            self._run.add_stage(name, energy=(own.energy, own.energy))
        return own

    def _descend_free(self, own: InitialMap) -> Status | None:
        """Descend from an initial map with a free boundary; return as `_run_descent`."""
        return self._run_descent(own.uv, guarded=False, near=own.energy < _TUNING.direct_energy)

    def _descend_guarded(self) -> Status:
        """Descend from the current bijective map with a guarded boundary."""
        assert self._bijective is not None
        near = self._energy(self._bijective) < _TUNING.distant_energy
        status = self._run_descent(self._bijective, guarded=True, near=near)
        assert status is not None
        return status

    def _has_collapsed(self, status: Status) -> bool:
        """Whether a descent that ended with this status stalled at a collapsed map."""
        # A converged map is a minimum. Only the barriers of a cramped boundary can imitate convergence, and then there
        # is an overlapping map to compare with.
        converged = status is Status.POLISHED and self._overlapping is None
        falling = status is Status.STILL_FALLING and self._run.stages[-1].n_iterations < _TUNING.many
        if converged or falling or status is Status.INTERRUPTED:
            return False
        assert self._bijective is not None
        piece, uv = self._piece, self._bijective
        angles_alone = self._measure.is_scale_free(in_units(uv, 0))
        return has_collapsed(
            piece.V, piece.F, piece.loops, piece.area, uv, self._overlapping, angles_alone=angles_alone
        )

    def _restart(self, status: Status) -> Status:
        """Descend from other initial maps until one result has not collapsed; otherwise use the best result."""
        attempts, first = [self._record_attempt(status, 0)], len(self._run.stages)
        with self._run.until_interrupted():
            while (own := self._begin_anew()) is not None:
                found = self._descend_free(own) if not self._overlaps else None
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

        return last.energy <= (1 + _TUNING.agree) * least and any(
            other.energy <= (1 + _TUNING.agree) * least
            and abs(begun(other) - begun(last)) > _TUNING.agree * begun(last)
            for other in others
        )

    def _record_attempt(self, status: Status, first: int) -> _Attempt:
        """Record the current map, the result of the stages from ``first`` on."""
        assert self._bijective is not None
        stages = range(first, len(self._run.stages))
        return _Attempt(self._energy(self._bijective), self._bijective, status, self._solver, stages)

    def _choose(self, attempts: Sequence[_Attempt], best: _Attempt | None = None) -> Status:
        """Use the result of one attempt, by default the one with the least energy, and mark the others as discarded."""
        best = best or min(attempts, key=lambda attempt: attempt.energy)
        for attempt in attempts:
            for k in attempt.stages if attempt is not best else ():
                self._run.stages[k] = replace(self._run.stages[k], kept=False)
        self._bijective, self._solver = best.uv, best.solver
        return best.status

    def _run_descent(
        self,
        uv: FloatArray,
        *,
        guarded: bool,
        near: bool,
        rotations: RotationPath | None = None,
    ) -> Status | None:
        """Descend from a map, which must be bijective if ``guarded``.

        Return None if a guarded descent must follow: the result overlaps itself, or its overlaps were pulled apart, but
        this distorts it too much. In the first case `_bijective` is None if no bijective map is known yet; in the
        second it is the distorted map.
        """
        energy = self._measure if near else self._piece.energy(ReweightedDirichlet(), self._weights)
        rim = self._rim if guarded else None
        descent = SurfaceDescent(energy, uv, self._wanted_solver, rim=rim, iterate=True, rotations=rotations)
        self._solver = descent.linear_solver
        recent: deque[tuple[float, FloatArray]] = deque(maxlen=_TUNING.recent)
        name = f"{'guarded' if guarded else 'free'} descent, {self._options.energy_name}"
        exponent = self._piece.exponent
        status = Status.STILL_FALLING
        try:
            status = self._run.descend(
                name,
                self._take_steps(descent, recent, guarded=guarded),
                lambda: self._measure.value(descent.w),
                lambda: to_given_unit(descent.uv, exponent),
            )
        finally:
            # After Ctrl-C too, the current map may be better than the previous one.
            found, interrupted = finish(lambda: self._use(descent, status, recent, guarded=guarded))
            if interrupted:
                raise KeyboardInterrupt
        if found is None:
            return None
        if not found.pulled:
            return status
        before, after = self._measure.value(descent.w), self._energy(found.uv)
        self._run.add_stage("overlaps pulled apart", n_iterations=1, energy=(before, after))
        self._run.record(0, after, lambda: to_given_unit(found.uv, exponent))
        # If the pulled triangles are distorted too much, a guarded descent continues from this map.
        return status if after <= _TUNING.max_pulled_ratio * before + _TUNING.least_pulled else None

    def _take_steps(
        self, descent: SurfaceDescent, recent: deque[tuple[float, FloatArray]], *, guarded: bool
    ) -> Iterator[Status | None]:
        """Take the steps of a descent, with its last maps in ``recent``; stop if the free boundary is tangled."""
        patches = None if guarded else PatchDescents(self._measure, self._wanted_solver).improve
        course = descend(descent, self._density, self._options.tol, patches)
        last = np.inf
        for number, outcome in enumerate(itertools.islice(course, self._options.max_iterations), 1):
            energy = self._measure.value(descent.w)
            recent.append((energy, descent.uv))
            yield outcome
            if guarded or number % _TUNING.check_every:
                continue
            falls, last = _TUNING.isometric < energy < _TUNING.falling * last, energy
            tangled = not falls and self._rim.tangled_fraction(descent.uv) > _TUNING.tangled
            if tangled and self._rim.pull_apart(self._piece.F, descent.uv) is None:
                return

    def _use(
        self, descent: SurfaceDescent, status: Status, recent: Sequence[tuple[float, FloatArray]], *, guarded: bool
    ) -> _Found | None:
        """Use the map of a descent that has ended, with its overlaps pulled apart; return None if that fails.

        Then the latest of its ``recent`` maps that is bijective is used, or else the map before the descent.
        """
        uv = descent.uv
        overlaps = not guarded and self._rim.meets_itself(uv)
        apart = self._rim.pull_apart(self._piece.F, uv) if overlaps else uv
        self._run.judge_last_stage(kept=apart is not None)
        if apart is not None:
            self._bijective = apart
            return _Found(apart, overlaps)
        self._overlaps = True
        self._overlapping = uv if status is not Status.STILL_FALLING else None
        most = _TUNING.max_energy_ratio * self._measure.value(descent.w)
        for energy, earlier in reversed([*recent]):
            if energy <= most and not self._rim.meets_itself(earlier):
                self._bijective = earlier
                break
        return None

    def _energy(self, uv: FloatArray) -> float:
        """The energy of a map (n, 2)."""
        return self._measure.value(in_units(uv, 0))
