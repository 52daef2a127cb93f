"""One connected surface on its way into the plane."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.arrays import FloatArray, check_callback, counted
from quasiharmonic.energy.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energy.energies import Energy
from quasiharmonic.energy.newton_descent import in_units
from quasiharmonic.energy.reweighted import ReweightedDirichlet
from quasiharmonic.exact.certificate import certify, is_injective
from quasiharmonic.flattening.cascade import coarse_start
from quasiharmonic.flattening.contacts import Rim
from quasiharmonic.flattening.descent import FreeDescent, GuardedDescent, descend
from quasiharmonic.flattening.start import disk_start
from quasiharmonic.problem import Domain
from quasiharmonic.result import MapResult, Snapshot, Stage, Status, Step

#: From so many triangles on a surface is flattened by way of coarse meshes.
COARSE_FROM = 50_000
# A mean energy below this is near enough to the least for Newton's own steps.
_NEAR = 1.0
# Energies are equal if they differ by no more than this part of them.
_SAME = 1e-6
# Of so many last maps of a free descent the latest is looked for that is bijective, if its energy is at most so many
# times the last one's: far from that the start is the better place to begin anew.
_RECENT, _NOT_FAR = 12, 10.0
# Every so many steps of a free descent it is looked whether so much of the boundary has met itself that it will not
# come apart again.
_LOOK_EVERY, _TANGLED = 8, 0.1


@dataclass(frozen=True)
class Settings:
    """What a caller of `flatten` has chosen, checked.

    Attributes
    ----------
    density : Energy
    name : str
        Of the energy.
    tolerance : float
    max_iterations : int
    linear_solver : str
    callback : callable or None
    record : int
    """

    density: Energy
    name: str
    tolerance: float
    max_iterations: int
    linear_solver: str
    callback: Callable[[Step], object] | None
    record: int

    def __post_init__(self) -> None:
        check_callback(self.callback)


class Piece:
    """A connected surface that can be flattened, in a unit near its size.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
    F : (f, 3) array of int

    Raises
    ------
    ValueError
        As `Domain`; where the surface has handles, or a triangle no area.

    Attributes
    ----------
    V : (n, 3) float64
        Positions in units of ``2 ** exponent``.
    F : (f, 3) int64
    loops : list of (l,) int64
        Boundary loops.
    exponent : int
    area : float
        The surface's, in square units.
    """

    def __init__(self, V: ArrayLike, F: ArrayLike) -> None:
        domain = Domain(V, F, [])
        self.F, self.loops = domain.F, domain.loops
        handles, odd = divmod(self._missing(domain), 2)
        if handles or odd:
            raise ValueError(
                f"the surface has {counted('handle', 'handles', handles)} and cannot lie in the plane: "
                "cut it open first (cut_open; --cut of qhm map and qhm flatten)"
            )
        self.exponent = int(np.frexp(np.abs(domain.V).max())[1])
        self.V = np.zeros((domain.n, 3))
        self.V[:, : domain.V.shape[1]] = np.ldexp(domain.V, -self.exponent)

        corners = self.V[self.F]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.area = 0.5 * float(np.linalg.norm(normal, axis=1).sum())

    @classmethod
    def united(cls, pieces: Sequence[Piece]) -> Piece:
        """Several pieces as one that is not connected, their elements piece after piece, in the largest one's unit."""
        made = object.__new__(cls)
        first = np.cumsum([0, *(len(piece.V) for piece in pieces)])[:-1].tolist()
        made.F = np.concatenate([piece.F + k for piece, k in zip(pieces, first, strict=True)])
        made.loops = [loop + k for piece, k in zip(pieces, first, strict=True) for loop in piece.loops]
        made.exponent = max(piece.exponent for piece in pieces)
        smaller = [piece.exponent - made.exponent for piece in pieces]
        made.V = np.concatenate([np.ldexp(piece.V, down) for piece, down in zip(pieces, smaller, strict=True)])
        made.area = float(sum(np.ldexp(piece.area, 2 * down) for piece, down in zip(pieces, smaller, strict=True)))
        return made

    @staticmethod
    def _missing(domain: Domain) -> int:
        """What the Euler characteristic is short of a disk's with as many holes: two for each handle."""
        found = domain.edges
        euler = domain.n - len(found.interior) - len(found.boundary) + len(domain.F)
        return 2 - len(domain.loops) - euler

    def energy(self, density: Energy, weights: FloatArray | None) -> DeformationEnergy:
        """The energy of its maps."""
        return DeformationEnergy(self.V, self.F, density, weights=weights)


class Flattening:
    """The descent of one surface's map, and what is to be told of it.

    Parameters
    ----------
    piece : Piece
    settings : Settings
    weights : (f,) float64 or None
    """

    def __init__(self, piece: Piece, settings: Settings, weights: FloatArray | None) -> None:
        self._piece, self._settings, self._weights = piece, settings, weights
        self._rim = Rim(piece.loops)
        self._measure = piece.energy(settings.density, weights)
        self._bijective: FloatArray | None = None
        self._solver = ""
        self._stages: list[Stage] = []
        self._history: list[Step] = []
        self._path: list[Snapshot] = []

    def run(self, start: FloatArray | None) -> MapResult:
        """Flatten, from an injective map (n, 2) in the piece's unit or from one of the library's own.

        Raises
        ------
        KeyboardInterrupt
            Before there is a first bijective map.
        """
        began = time.perf_counter()
        try:
            status = self._descended(start)
        except KeyboardInterrupt:
            if self._bijective is None:
                raise
            status = Status.INTERRUPTED
        assert self._bijective is not None
        uv = self._bijective
        if self._blind_to_scale(uv):
            uv = self._in_scale(uv)
        return MapResult(
            uv=uv,
            status=status,
            certificate=certify(self._piece.F, uv, loops=self._piece.loops),
            stages=self._stages,
            history=self._history,
            path=self._path,
            linear_solver=self._solver,
            seconds=time.perf_counter() - began,
        )

    def _descended(self, start: FloatArray | None) -> Status:
        """Descend freely, and once more with the boundary guarded if it has ended on itself."""
        if start is not None:
            start = self._in_scale(start)
            if not self._rim.meets_itself(start):
                self._bijective = start
            status = self._descent(start, guarded=False, near=False)
            if status is not None:
                return status
        if self._bijective is None:
            # Nothing was given, or what was given overlaps itself and ended so.
            own, near = self._own_start()
            status = self._descent(own, guarded=False, near=near)
            if status is not None:
                return status
        assert self._bijective is not None
        status = self._descent(self._bijective, guarded=True, near=True)
        assert status is not None
        return status

    def _own_start(self) -> tuple[FloatArray, bool]:
        """A bijective map, and whether it is near its best already."""
        began = time.perf_counter()
        piece, solver = self._piece, self._settings.linear_solver
        uv = self._as_it_lies()
        if uv is None and len(piece.F) < COARSE_FROM:
            uv = disk_start(piece.V, piece.F, piece.loops, solver)
        if uv is None:
            uv = coarse_start(piece.V, piece.F, piece.loops, solver)
        if uv is None:
            raise ValueError(
                "no bijective map to start from was found within double precision: the triangles differ too much in "
                "size; give one by start"
            )
        uv = self._bijective = self._in_scale(uv)
        energy = self._measure.value(in_units(uv, 0))
        self._stages.append(Stage("start", 0, time.perf_counter() - began, (0, 0), (energy, energy)))
        return uv, energy < _NEAR

    def _as_it_lies(self) -> FloatArray | None:
        """The surface itself, if it is plane and covers no point twice: there is no better map."""
        V, F, loops = self._piece.V, self._piece.F, self._piece.loops
        if np.ptp(V[:, 2]) > 0:
            return None
        # Seen from the side on which its triangles are counterclockwise.
        uv = V[:, :2] * [np.sign(signed_areas(F, in_units(V[:, :2], 0)).sum()) or 1.0, 1.0]
        return uv if certify(F, uv, loops=loops).bijective else None

    def _blind_to_scale(self, uv: FloatArray) -> bool:
        """Whether a map of twice the size would be as good."""
        w = in_units(uv, 0)
        here, doubled = self._measure.value(w), self._measure.value(2 * w)
        return abs(doubled - here) <= _SAME * here

    def _in_scale(self, uv: FloatArray) -> FloatArray:
        """A map scaled to the surface's area; only by a power of two, exactly, where more would invert a triangle."""
        unit = np.ldexp(uv, -int(np.frexp(np.abs(uv).max())[1]))
        centred = unit - unit.mean(axis=0)
        area = float(signed_areas(self._piece.F, in_units(centred, 0)).sum())
        factor = np.sqrt(self._piece.area / area)
        scaled = centred * factor
        return scaled if is_injective(self._piece.F, scaled) else np.ldexp(unit, round(np.log2(factor)))

    def _descent(self, uv: FloatArray, *, guarded: bool, near: bool) -> Status | None:
        """Descend from a map, which is bijective if the descent is guarded; None where the end overlaps itself."""
        began = time.perf_counter()
        settings, solver = self._settings, self._settings.linear_solver
        energy = self._piece.energy(settings.density if near else ReweightedDirichlet(), self._weights)
        descent = GuardedDescent(energy, uv, solver, self._rim) if guarded else FreeDescent(energy, uv, solver)
        self._solver = descent.system.solver.name
        first = self._measure.value(descent.w)
        apart, status, steps = guarded, Status.STILL_FALLING, 0
        recent: deque[tuple[float, FloatArray]] = deque(maxlen=_RECENT)
        try:
            self._report(descent)
            course = descend(descent, settings.density, settings.tolerance)
            for steps, outcome in enumerate(itertools.islice(course, settings.max_iterations), 1):
                status = outcome or status
                recent.append((self._measure.value(descent.w), descent.uv))
                self._report(descent)
                if not guarded and steps % _LOOK_EVERY == 0 and self._rim.tangled(descent.uv) > _TANGLED:
                    break
        finally:
            # Also what Ctrl-C has left half done may be a better map than there was.
            last = self._measure.value(descent.w)
            apart = guarded or not self._rim.meets_itself(descent.uv)
            if apart:
                self._bijective = descent.uv
            else:
                self._bijective = self._latest_bijective(recent, _NOT_FAR * last)
            seconds = time.perf_counter() - began
            name = f"{'guarded' if guarded else 'free'} descent, {settings.name}"
            self._stages.append(Stage(name, steps, seconds, (0, 0), (first, last), kept=apart))
        return status if apart else None

    def _latest_bijective(self, recent: Iterable[tuple[float, FloatArray]], most: float) -> FloatArray | None:
        """The latest of some maps with their energies that is bijective and of no more energy; else what there was."""
        for energy, uv in reversed([*recent]):
            if energy <= most and not self._rim.meets_itself(uv):
                return uv
        return self._bijective

    def _report(self, descent: FreeDescent) -> None:
        settings, number = self._settings, len(self._history)
        self._history.append(Step(number, 0, self._measure.value(descent.w)))
        if settings.record and number % settings.record == 0:
            self._path.append(Snapshot(number, np.ldexp(descent.uv, self._piece.exponent)))
        if settings.callback is not None:
            settings.callback(self._history[-1])
