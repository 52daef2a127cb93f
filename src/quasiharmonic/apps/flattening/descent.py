"""Newton steps for the energy of a map with a free boundary, optionally without overlaps on the way.

One vertex is fixed to prevent drift. Rotation remains possible; a raised diagonal keeps the Newton system regular.
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

# Stages of a guarded descent: the weight of each contact, relative to the surface's mean energy per triangle, and a
# factor on the tolerance. Early stages stop sooner, as they only prepare the later ones.
_STAGES = (1e-2, 30.0), (1e-3, 5.0), (1e-4, 1.0)
# The system's sparsity pattern is rebuilt when this fraction of the repelling contacts is not in it.
_STRANGE = 0.3
# Lower bound of the energy for the contacts' weight.
_LEAST_ENERGY = 1e-4
# A step may reduce the smallest gap to this fraction of its old value, or of its reach.
_NARROWER = 0.3
# Full Newton steps converge quadratically. After _SLOW_STEPS slow steps in a row, which leave this fraction of the
# decrement and this fraction of the energy, triangles probably rotate, which limits straight steps,
_SLOW, _LITTLE, _SLOW_STEPS = 0.3, 0.8, 4
# if the median rotation is this many times the median growth. Otherwise a straight step is as good, and needs no solve.
_TURNED = 12.0


class _Moment(NamedTuple):
    """The evaluation of a map by `GuardedEnergy`."""

    surface: Any
    w: ComplexArray


class GuardedEnergy:
    """The energy of a surface and of the contacts of its boundary with itself, for `NewtonDescent`.

    Parameters
    ----------
    surface : NewtonObjective

    Attributes
    ----------
    contacts : Contacts
        Contacts that couple their vertices in the Newton system.
    strangers : Contacts
        Contacts that are not in the system's sparsity pattern.
    stiffness : float
        Factor on each contact's barrier.
    """

    def __init__(self, surface: NewtonObjective) -> None:
        self.surface = surface
        self.F, self.g = surface.F, surface.g
        self.contacts, self.strangers, self.stiffness = Contacts.none(), Contacts.none(), 0.0

    def deform(self, w: ComplexArray) -> _Moment:
        """Evaluate the quantities of a map that the other methods need."""
        return _Moment(self.surface.deform(w), w)

    def value_of(self, moment: _Moment) -> float:
        """The mean energy of the surface plus the barriers."""
        return self.surface.value_of(moment.surface) + self.stiffness * (
            self.contacts.value(moment.w) + self.strangers.value(moment.w)
        )

    def gradient_of(self, moment: _Moment, n: int) -> ComplexArray:
        """The derivative with respect to ``n`` positions; (n,) complex128."""
        return self.surface.gradient_of(moment.surface, n) + self.stiffness * (
            self.contacts.gradient(moment.w) + self.strangers.gradient(moment.w)
        )

    def curvature_of(self, moment: _Moment, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives on the surface's triangles, then on those of the contacts."""
        surface = self.surface.curvature_of(moment.surface, negative=negative)
        between = self.contacts.curvature(moment.w).scaled(np.full(self.contacts.reach.shape, self.stiffness))
        fields = zip(vars(surface).values(), vars(between).values(), strict=True)
        return QuadraticForm(*(np.concatenate(both) for both in fields))

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """The step along a direction at which each of the surface's triangles first becomes degenerate."""
        return self.surface.steps_to_collapse(w, direction)


class FreeDescent(NewtonDescent):
    """Newton steps of a map with a free boundary; usually only one vertex is fixed.

    Parameters
    ----------
    energy : NewtonObjective
    uv : (n, 2) float64
        An injective map, of about unit size.
    linear_solver : str
    fixed : sequence of int
        Vertices fixed at their positions; at least one, to prevent drift.
    """

    def __init__(
        self, energy: NewtonObjective, uv: FloatArray, linear_solver: str, fixed: Sequence[int] | IntArray = (0,)
    ) -> None:
        super().__init__(energy, uv, np.asarray(fixed, dtype=np.int64), 0, linear_solver)
        self._linear_solver = linear_solver
        self._last, self._slow = (np.inf, np.inf), 0

    @property
    def uv(self) -> FloatArray:
        """The current map; (n, 2) float64."""
        return self.positions(self.w)

    @property
    def surface(self) -> NewtonObjective:
        """The energy of the surface, without contacts."""
        return self.energy

    @property
    def distortion(self) -> float:
        """The value of the surface's energy, without contacts."""
        return self.value

    def turn_to(self, density: Energy) -> None:
        """Continue with another density on the same triangles; the energy must be a `DeformationEnergy`."""
        assert isinstance(self.surface, DeformationEnergy)
        self.surface.energy = density
        self.value = self.energy.value_of(self._deformation)
        self._cut, self._idle = True, 0

    def relax_barrier(self) -> bool:
        """Lower the weight of the barrier that guards the map; return False if this is not possible."""
        return False

    @cached_property
    def _turning(self) -> Turning | None:
        return Turning.of(self.energy.F, self.energy.g, self.w.size, self.fixed, self._linear_solver)

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """As in `NewtonDescent`; after several slow full steps, first try a path along which triangles rotate."""
        last, higher = self._last
        slow = not self._cut and expected_decrease > _SLOW * last and self.value > _LITTLE * higher
        self._last, self._slow = (expected_decrease, self.value), self._slow + 1 if slow else 0
        return (self._slow >= _SLOW_STEPS and self._turned(direction, expected_decrease)) or super()._search(
            direction, expected_decrease
        )

    def _turned(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """Take a full or longer step along a rotating path; return False if the energy does not decrease enough."""
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
                # With very thin rest triangles, the path's own system can be numerically singular.
                return np.inf, None
            return self.evaluate_trial(there, bound)

        taken = backtrack(trial, self.value, expected_decrease, tries=1)
        if taken is None:
            return False
        _, self.value, (self.w, self._deformation) = extend(trial, taken)
        return True


class GuardedDescent(FreeDescent):
    """Newton steps of a map that stays bijective.

    Parameters
    ----------
    energy, uv, linear_solver, fixed
        As for `FreeDescent`; the map must be bijective.
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
        """The energy of the surface, without contacts."""
        return self.energy.surface

    @property
    def distortion(self) -> float:
        """The value of the surface's energy, without contacts."""
        return self.energy.surface.value_of(self._deformation.surface)

    def relax_barrier(self) -> bool:
        """Lower the weight of the contacts; return False if it is the last one."""
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
        """Take one step with the current contacts."""
        known, strangers = self._near.split(self._known, self.w.size)
        repelling = self._near.within(self.w, 1.0).reach.size
        if strangers.within(self.w, 1.0).reach.size > _STRANGE * repelling:
            # The new pattern includes possible and earlier contacts, so that it lasts for several steps.
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
        """Assemble the system's matrix; contacts outside its pattern only add to the diagonal."""
        super().assemble(negative)
        if self.energy.strangers.reach.size:
            stiffness, free = self.energy.stiffness, self.system.free
            self.system.add_blocks(*(stiffness * part[free] for part in self.energy.strangers.blocks(self.w)))

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """As in `NewtonDescent`; also reject maps whose boundary meets itself or whose gaps shrink too much."""
        value, there = super().evaluate_trial(w, bound)
        if there is not None:
            near = self._rim.contacts(w)
            # New pairs are compared with _NARROWER at most, as otherwise no step might be short enough.
            before = min(self._room, near.room(self.w), _NARROWER)
            if near.room(w) < _NARROWER * before or self._rim.meets_itself(self.positions(w)):
                return value, None
            self._ahead = near
        return value, there

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        moved = super()._search(direction, expected_decrease)
        if moved:
            # The last evaluated map is the accepted one.
            self._near = self._ahead
            self._room = self._near.room(self.w)
        return moved


def _united(older: IntArray, newer: IntArray, n: int) -> IntArray:
    """Unite pairs (3, c), or return the newer ones if they are less than half; ``n`` exceeds all vertices."""
    both = np.concatenate([newer, older], axis=1)
    _, first = np.unique(both[0] * n + both[1], return_index=True)
    return newer if first.size > 2 * newer.shape[1] else both[:, first]


def descend(descent: FreeDescent, density: Energy, tolerance: float) -> Iterator[Status | None]:
    """Take steps until converged or stalled.

    Parameters
    ----------
    descent : FreeDescent
        The descent at its start. If its density is `ReweightedDirichlet`, it is used as long as two steps together at
        least halve the energy.
    density : Energy
        The energy density to minimise.
    tolerance : float
        As for `quasiharmonic.polish`.

    Yields
    ------
    Status or None
        After every step; None until the last step, which yields a status.
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
