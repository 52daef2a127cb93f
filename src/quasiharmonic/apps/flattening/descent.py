"""Newton's steps down the energy of a map whose boundary is free; where asked, without overlap on the way.

One vertex is held, or the map could drift. It may turn: the raised diagonal of the Newton system takes care of that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.contacts import HATS, Contacts, Rim
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Energy, QuadraticForm
from quasiharmonic.energies.newton.line_search import backtrack, extend
from quasiharmonic.energies.newton.newton_descent import NewtonDescent, NewtonObjective
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.newton.reweighted import ReweightedDirichlet
from quasiharmonic.energies.newton.rotation_path import Turning, rates
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Stages of a guarded descent. Each contact weighs so much of the surface's mean energy, against a triangle of mean
# size; the first stages end sooner, at this multiple of the tolerance, for they are only on the way.
_STAGES = (1e-2, 30.0), (1e-3, 5.0), (1e-4, 1.0)
# The pattern of the system is made anew when this share of the contacts that repel is not in it.
_STRANGE = 0.3
# ... where the energy is next to nothing as if it were this.
_LEAST_ENERGY = 1e-4
# A step may take the narrowest gap down to this share of what it was, or of its reach.
_NARROWER = 0.3
# Newton's steps in full converge quadratically. Where so many of them in a row leave this share of the decrement, and
# this of the energy, triangles turn, which a straight step allows by little.
_SLOW, _LITTLE, _SLOW_STEPS = 0.3, 0.8, 4
# ... if in the middle they turn by so many times what they grow: otherwise a line is as good, and costs no solve.
_TURNED = 12.0


class _Moment(NamedTuple):
    """A map as a `GuardedEnergy` reads it."""

    surface: Any
    w: ComplexArray


class GuardedEnergy:
    """The energy of a surface and of the contacts of its boundary with itself, as `NewtonDescent` asks for it.

    Parameters
    ----------
    surface : Lowered

    Attributes
    ----------
    contacts : Contacts
        Those that couple their vertices in the Newton system.
    strangers : Contacts
        Others, for which it has no place.
    stiffness : float
        The factor on each contact's barrier.
    """

    def __init__(self, surface: NewtonObjective) -> None:
        self.surface = surface
        self.F, self.g = surface.F, surface.g
        self.contacts, self.strangers, self.stiffness = Contacts.none(), Contacts.none(), 0.0

    def deform(self, w: ComplexArray) -> _Moment:
        """What the other methods read of a map."""
        return _Moment(self.surface.deform(w), w)

    def value_of(self, moment: _Moment) -> float:
        """The mean energy of the surface, and the barriers."""
        return self.surface.value_of(moment.surface) + self.stiffness * (
            self.contacts.value(moment.w) + self.strangers.value(moment.w)
        )

    def gradient_of(self, moment: _Moment, n: int) -> ComplexArray:
        """The derivative by ``n`` positions; (n,) complex128."""
        return self.surface.gradient_of(moment.surface, n) + self.stiffness * (
            self.contacts.gradient(moment.w) + self.strangers.gradient(moment.w)
        )

    def curvature_of(self, moment: _Moment, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives on the surface's triangles, and then on the contacts'."""
        surface = self.surface.curvature_of(moment.surface, negative=negative)
        between = self.contacts.curvature(moment.w).scaled(np.full(self.contacts.reach.shape, self.stiffness))
        fields = zip(vars(surface).values(), vars(between).values(), strict=True)
        return QuadraticForm(*(np.concatenate(both) for both in fields))

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """How far along a direction each of the surface's triangles first vanishes."""
        return self.surface.steps_to_collapse(w, direction)


class FreeDescent(NewtonDescent):
    """Steps of a map with a free boundary, of which as a rule nothing but one vertex is held.

    Parameters
    ----------
    energy : Lowered
    uv : (n, 2) float64
        An injective map, of about unit size.
    linear_solver : str
    fixed : sequence of int
        Vertices that are held where they are; one at least, or the map could drift.
    """

    def __init__(
        self, energy: NewtonObjective, uv: FloatArray, linear_solver: str, fixed: Sequence[int] | IntArray = (0,)
    ) -> None:
        super().__init__(energy, uv, np.asarray(fixed, dtype=np.int64), 0, linear_solver)
        self._linear_solver = linear_solver
        self._last, self._slow = (np.inf, np.inf), 0

    @property
    def uv(self) -> FloatArray:
        """The map at hand; (n, 2) float64."""
        return self.positions(self.w)

    @property
    def surface(self) -> NewtonObjective:
        """The energy of the surface alone."""
        return self.energy

    @property
    def distortion(self) -> float:
        """The value of the surface's energy alone."""
        return self.value

    def turn_to(self, density: Energy) -> None:
        """Go on with another density on the same triangles; only of a `DeformationEnergy`, which has one."""
        assert isinstance(self.surface, DeformationEnergy)
        self.surface.energy = density
        self.value = self.energy.value_of(self._deformation)
        self._cut, self._idle = True, 0

    def relax_barrier(self) -> bool:
        """Make what only guards the map count for less; False if it cannot."""
        return False

    @cached_property
    def _turning(self) -> Turning | None:
        return Turning.of(self.energy.F, self.energy.g, self.w.size, self.fixed, self._linear_solver)

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """As of `NewtonDescent`; where full steps are many and short, first along a path that turns."""
        last, higher = self._last
        slow = not self._cut and expected_decrease > _SLOW * last and self.value > _LITTLE * higher
        self._last, self._slow = (expected_decrease, self.value), self._slow + 1 if slow else 0
        return (self._slow >= _SLOW_STEPS and self._turned(direction, expected_decrease)) or super()._search(
            direction, expected_decrease
        )

    def _turned(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """Take a step in full, or more, along a path that turns; False if the energy does not fall enough there."""
        full = np.zeros_like(self.w)
        full[self.system.free] = direction
        rate = rates(self.energy.F, self.energy.g, self.w, full)
        turning = np.median(np.abs(rate.imag)) > _TURNED * np.median(np.abs(rate.real))
        if not (expected_decrease > 0 and turning) or self._turning is None:
            return False
        path = self._turning.path(self.w, full)

        def trial(t: float, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
            try:
                there = path(t)
            except NotPositiveDefinite:
                # Rest triangles so thin that the path's own system has no solution to any digit.
                return np.inf, None
            return self.evaluate_trial(there, bound)

        taken = backtrack(trial, self.value, expected_decrease, tries=1)
        if taken is None:
            return False
        _, self.value, (self.w, self._deformation) = extend(trial, taken)
        return True


class GuardedDescent(FreeDescent):
    """Steps of a map that stays bijective.

    Parameters
    ----------
    energy, uv, linear_solver, fixed
        As `FreeDescent` has them; the map is bijective.
    rim : Rim
        The surface's boundary.
    """

    energy: GuardedEnergy

    def __init__(
        self,
        energy: NewtonObjective,
        uv: FloatArray,
        linear_solver: str,
        rim: Rim,
        fixed: Sequence[int] | IntArray = (0,),
    ) -> None:
        self._rim = rim
        self._stages = iter(_STAGES)
        self._weight, self._slack = next(self._stages)
        super().__init__(GuardedEnergy(energy), uv, linear_solver, fixed)
        self._near = self._ahead = rim.contacts(self.w)
        self._room = self._near.room(self.w)
        self._known = Contacts.none().corners

    @property
    def surface(self) -> NewtonObjective:
        """The energy of the surface alone."""
        return self.energy.surface

    @property
    def distortion(self) -> float:
        """The value of the surface's energy alone."""
        return self.energy.surface.value_of(self._deformation.surface)

    def relax_barrier(self) -> bool:
        """Lower the weight of the contacts; False at the last."""
        following = next(self._stages, None)
        if following is None:
            return False
        (self._weight, self._slack), self._idle = following, 0
        return True

    def _check_numbers(self) -> None:
        """As of `NewtonDescent`, of the surface's energy."""
        if isinstance(self.surface, DeformationEnergy):
            self.surface.check_numbers(self._deformation.surface)

    def step(self, tolerance: float) -> Status | None:
        """Take one step, with the contacts there are now."""
        known, strangers = self._near.split(self._known, self.w.size)
        repelling = self._near.within(self.w, 1.0).reach.size
        if strangers.within(self.w, 1.0).reach.size > _STRANGE * repelling:
            # A new pattern gets those that may come as well, or come again, so that it lasts a while.
            self._known = _united(self._known, self._near.corners, self.w.size)
            F = np.concatenate([self.energy.F, self._known.T])
            g = np.concatenate([self.energy.g, np.repeat(HATS[:, None], len(self._known.T), axis=1)], axis=1)
            self.system = NewtonSystem(F, g, self.w.size, self.fixed, self._linear_solver)
            known, strangers = self._near.split(self._known, self.w.size)
        self.energy.contacts, self.energy.strangers = known, strangers
        self.energy.stiffness = self._weight * max(self.distortion, _LEAST_ENERGY) / len(self.energy.F)
        self.value = self.energy.value_of(self._deformation)
        return super().step(self._slack * tolerance)

    def assemble(self, negative: float) -> None:
        """Fill in the system's matrix, with strangers on its diagonal alone."""
        super().assemble(negative)
        if self.energy.strangers.reach.size:
            stiffness, free = self.energy.stiffness, self.system.free
            self.system.add_blocks(*(stiffness * part[free] for part in self.energy.strangers.blocks(self.w)))

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """As of `NewtonDescent`; besides, the boundary does not meet itself, and no gap becomes much narrower."""
        value, there = super().evaluate_trial(w, bound)
        if there is not None:
            near = self._rim.contacts(w)
            # Pairs that only face each other since count by how near they were, or no step might be short enough.
            before = min(self._room, near.room(self.w), _NARROWER)
            if near.room(w) < _NARROWER * before or self._rim.meets_itself(self.positions(w)):
                return value, None
            self._ahead = near
        return value, there

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        moved = super()._search(direction, expected_decrease)
        if moved:
            # The last map that was accepted is the one that was gone to.
            self._near = self._ahead
            self._room = self._near.room(self.w)
        return moved


def _united(older: IntArray, newer: IntArray, n: int) -> IntArray:
    """Pairs (3, c) of either set, without the older ones where these are the most; ``n`` is above all vertices."""
    both = np.concatenate([newer, older], axis=1)
    _, first = np.unique(both[0] * n + both[1], return_index=True)
    return newer if first.size > 2 * newer.shape[1] else both[:, first]


def descend(descent: FreeDescent, density: Energy, tolerance: float) -> Iterator[Status | None]:
    """Take steps until there is no other to take.

    Parameters
    ----------
    descent : FreeDescent
        At its start. If its energy's density is `ReweightedDirichlet`, it is held to that as long as two steps
        together at least halve it.
    density : Energy
        What is lowered.
    tolerance : float
        As `quasiharmonic.polish` has it.

    Yields
    ------
    Status or None
        After every step; a status after the last.
    """
    values = [np.inf, descent.distortion]
    surface = descent.surface
    far = isinstance(surface, DeformationEnergy) and isinstance(surface.energy, ReweightedDirichlet)
    while True:
        if far:
            assert isinstance(surface, DeformationEnergy)
            surface.energy = ReweightedDirichlet.at(descent.distortion / float(surface.share.sum()))
        with np.errstate(all="ignore"):
            outcome = descent.step(tolerance)
        values.append(descent.distortion)
        if far and (outcome is not None or not values[-1] < 0.5 * values[-3]):
            far, outcome = False, None
            descent.turn_to(density)
        elif outcome is not None and descent.relax_barrier():
            outcome = None
        yield outcome
        if outcome is not None:
            return
