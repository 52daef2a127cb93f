"""Newton steps for the energy of a map with a free boundary, optionally without overlaps on the way.

One vertex is fixed to prevent drift. Rotation remains possible; a raised diagonal keeps the Newton system regular.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from quasiharmonic.apps.flattening.contacts import HATS, Rim, RimContacts
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Energy, QuadraticForm
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.line_search import RotationPath, backtrack, extend, rates
from quasiharmonic.energies.newton.map_model import Coordinates, MapModel, NewtonObjective, NewtonState, in_units
from quasiharmonic.energies.newton.newton_descent import IteratedDescent
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray


class GuardTuning(NamedTuple):
    """Numbers that tune descents with a guarded boundary, and slow steps."""

    # Stages of a guarded descent: the weight of each contact, relative to the surface's mean energy per triangle, and a
    # factor on the tolerance. Early stages stop sooner, as they only prepare the later ones.
    stages: tuple[tuple[float, float], ...] = ((1e-2, 30.0), (1e-3, 5.0), (1e-4, 1.0))
    # The system's sparsity pattern is rebuilt when this fraction of the repelling contacts is not in it.
    max_uncoupled: float = 0.3
    # Lower bound of the energy for the contacts' weight.
    min_energy: float = 1e-4
    # A step may reduce the smallest gap to this fraction of its old value, or of its reach.
    narrower: float = 0.3
    # Full Newton steps converge quadratically. A slow step leaves more than the first fraction of the decrement, and
    # more than the second one of the energy.
    slow_decrement: float = 0.3
    slow_energy: float = 0.8
    # Number of slow steps in a row after which rotating triangles probably limit straight steps.
    slow_steps: int = 4
    # Minimum ratio of median rotation to median growth of such triangles. Below it a straight step is as good, and
    # needs no solve.
    turned: float = 12.0


_TUNING = GuardTuning()
#: Below this mean energy Newton steps converge faster than those of `ReweightedDirichlet`.
NEAR_ENERGY = 0.1


class _Evaluation(NamedTuple):
    """The evaluation of a map by `GuardedEnergy`."""

    surface: Any
    w: ComplexArray


class GuardedEnergy:
    """The energy of a surface and of the contacts of its boundary with itself, for `NewtonDescent`.

    ``contacts`` couple their vertices in the Newton system. ``uncoupled`` are not in the system's sparsity pattern.
    ``stiffness`` is a factor on each contact's barrier.
    """

    def __init__(self, surface: NewtonObjective) -> None:
        self.surface = surface
        self.F, self.g = surface.F, surface.g
        self.contacts, self.uncoupled, self.stiffness = RimContacts.none(), RimContacts.none(), 0.0

    def deform(self, w: ComplexArray) -> _Evaluation:
        """Evaluate the quantities of a map that the other methods need."""
        return _Evaluation(self.surface.deform(w), w)

    def value_of(self, derivatives: _Evaluation) -> float:
        """The mean energy of the surface plus the barriers."""
        return self.surface.value_of(derivatives.surface) + self.stiffness * (
            self.contacts.value(derivatives.w) + self.uncoupled.value(derivatives.w)
        )

    def gradient_of(self, derivatives: _Evaluation, n: int) -> ComplexArray:
        """The derivative with respect to ``n`` positions; (n,) complex128."""
        return self.surface.gradient_of(derivatives.surface, n) + self.stiffness * (
            self.contacts.gradient(derivatives.w) + self.uncoupled.gradient(derivatives.w)
        )

    def curvature_of(self, derivatives: _Evaluation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives on the surface's triangles, then on those of the contacts."""
        surface = self.surface.curvature_of(derivatives.surface, negative=negative)
        between = self.contacts.curvature(derivatives.w).scaled(np.full(self.contacts.reach.shape, self.stiffness))
        fields = zip(surface, between, strict=True)
        return QuadraticForm(*(np.concatenate(both) for both in fields))

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """The step along a direction at which each of the surface's triangles first becomes degenerate."""
        return self.surface.steps_to_collapse(w, direction)


class _StepRecord(NamedTuple):
    """How the last step went, and the contacts at a map; the ``extra`` of a `NewtonState`.

    ``decrease`` and ``value`` are the expected decrease and the objective of the last step, and ``slow`` is the number
    of successive slow steps. ``near`` are contacts of the boundary with itself, none without a guard, and ``gap`` is
    their `Contacts.smallest_gap`.
    """

    decrease: float
    value: float
    slow: int
    near: RimContacts
    gap: float


class Pairs(Protocol):
    """Second derivatives between distant vertices, for which the system has no entries."""

    def add_to(self, system: NewtonSystem, w: ComplexArray) -> None:
        """Add the diagonal blocks at a map (n,) to an assembled system."""

    def solve(self, system: NewtonSystem, load: ComplexArray) -> ComplexArray:
        """Solve with the factored system and the entries that it lacks."""


class SurfaceModel(MapModel):
    """The model of a map with a free boundary, which may overlap itself; see `SurfaceDescent`.

    ``surface`` is the energy of the surface, and ``energy`` the objective.
    """

    def __init__(
        self,
        energy: NewtonObjective,
        uv: FloatArray,
        linear_solver: str,
        fixed: IntArray,
        pairs: Pairs | None,
        surface: NewtonObjective | None = None,
    ) -> None:
        self.surface, self._pairs = energy if surface is None else surface, pairs
        self._for_systems = len(uv), fixed, linear_solver
        super().__init__(energy, Coordinates.of(uv, fixed, 0), NewtonSystem(energy.F, energy.g, *self._for_systems))

    def start(self, uv: FloatArray) -> NewtonState:
        """Return the state of a map (n, 2)."""
        return self.evaluate(in_units(uv, 0))._replace(extra=_StepRecord(np.inf, np.inf, 0, RimContacts.none(), np.inf))

    def distortion(self, state: NewtonState) -> float:
        """The value of the surface's energy, without contacts."""
        return state.value

    def relax_barrier(self) -> bool:
        """Lower the weight of the barrier that guards the map; return False if there is none or it is the last."""
        return False

    def assemble(self, state: NewtonState, negative: float) -> None:
        """See `MapModel`."""
        super().assemble(state, negative)
        if self._pairs is not None:
            self._pairs.add_to(self.system, state.w)

    def solve(self, load: ComplexArray) -> ComplexArray:
        """See `MapModel`."""
        return super().solve(load) if self._pairs is None else self._pairs.solve(self.system, load)

    def search(
        self, state: NewtonState, direction: ComplexArray, expected_decrease: float, shortened: bool
    ) -> tuple[NewtonState, bool] | None:
        """See `MapModel`; after several slow full steps, first try a path along which triangles rotate."""
        course: _StepRecord = state.extra
        less = expected_decrease > _TUNING.slow_decrement * course.decrease
        less = less and state.value > _TUNING.slow_energy * course.value
        slow = course.slow + 1 if less and not shortened else 0
        state = state._replace(extra=course._replace(decrease=expected_decrease, value=state.value, slow=slow))
        full = self.displacement(direction, state.w.size)
        if slow >= _TUNING.slow_steps:
            rotated = self._search_rotating(state, full, expected_decrease)
            if rotated is not None:
                return rotated, False

        def trial(t: float, bound: float) -> tuple[float, NewtonState | None]:
            return self._evaluate_step(state, state.w + t * full, bound)

        return self.search_straight(state, full, expected_decrease, trial)

    @cached_property
    def _rotation_path(self) -> RotationPath | None:
        return RotationPath.of(self.surface.F, self.surface.g, *self._for_systems)

    def _search_rotating(self, state: NewtonState, full: ComplexArray, expected_decrease: float) -> NewtonState | None:
        """Take a full or longer step along a rotating path; None if the energy does not decrease enough."""
        rate = rates(self.surface.F, self.surface.g, state.w, full)
        rotates = np.median(np.abs(rate.imag)) > _TUNING.turned * np.median(np.abs(rate.real))
        if not rotates or self._rotation_path is None:
            return None
        path = self._rotation_path.path(state.w, full)

        def trial(t: float, bound: float) -> tuple[float, NewtonState | None]:
            try:
                there = path(t)
            except NotPositiveDefinite:
                # With very thin rest triangles, the path's own system can be numerically singular.
                return np.inf, None
            return self._evaluate_step(state, there, bound)

        taken = backtrack(trial, state.value, expected_decrease, tries=1)
        return None if taken is None else extend(trial, taken).state

    def _evaluate_step(self, state: NewtonState, w: ComplexArray, bound: float) -> tuple[float, NewtonState | None]:
        """Return the objective at a map reached from ``state``, and its state if it is accepted."""
        value, there = self.evaluate_trial(w, bound)
        return value, None if there is None else there._replace(extra=state.extra)


class GuardedModel(SurfaceModel):
    """The model of a map whose boundary ``rim`` must not overlap itself.

    RimContacts of the boundary with itself repel each other. ``slack`` is a factor on the tolerance; early stages stop
    sooner.
    """

    energy: GuardedEnergy

    def __init__(
        self,
        surface: NewtonObjective,
        uv: FloatArray,
        linear_solver: str,
        fixed: IntArray,
        pairs: Pairs | None,
        rim: Rim,
    ) -> None:
        super().__init__(GuardedEnergy(surface), uv, linear_solver, fixed, pairs, surface)
        self._rim = rim
        self._stages = iter(_TUNING.stages)
        self._weight, self.slack = next(self._stages)
        self._known = RimContacts.none().corners

    def start(self, uv: FloatArray) -> NewtonState:
        state = super().start(uv)
        near = self._rim.contacts(state.w)
        return state._replace(extra=state.extra._replace(near=near, gap=near.smallest_gap(state.w)))

    def distortion(self, state: NewtonState) -> float:
        return self.surface.value_of(state.derivatives.surface)

    def relax_barrier(self) -> bool:
        following = next(self._stages, None)
        if following is not None:
            self._weight, self.slack = following
        return following is not None

    def prepare(self, state: NewtonState) -> NewtonState:
        """Update the contacts and their weight, and the system if too many contacts are outside its pattern."""
        energy, near, n = self.energy, state.extra.near, state.w.size
        known, uncoupled = near.split(self._known, n)
        repelling = near.within(state.w, 1.0).reach.size
        if uncoupled.within(state.w, 1.0).reach.size > _TUNING.max_uncoupled * repelling:
            # The new pattern includes possible and earlier contacts, so that it lasts for several steps.
            self._known = _unite_pairs(self._known, near.corners, n)
            g = np.concatenate([energy.g, np.repeat(HATS[:, None], len(self._known.T), axis=1)], axis=1)
            self.system = NewtonSystem(np.concatenate([energy.F, self._known.T]), g, *self._for_systems)
            known, uncoupled = near.split(self._known, n)
        energy.contacts, energy.uncoupled = known, uncoupled
        energy.stiffness = self._weight * max(self.distortion(state), _TUNING.min_energy) / len(energy.F)
        return state._replace(value=energy.value_of(state.derivatives))

    def assemble(self, state: NewtonState, negative: float) -> None:
        """See `MapModel`; contacts outside the system's pattern are added to its diagonal."""
        super().assemble(state, negative)
        uncoupled, stiffness = self.energy.uncoupled, self.energy.stiffness
        if uncoupled.reach.size:
            self.system.add_blocks(*(stiffness * part[self.system.free] for part in uncoupled.blocks(state.w)))

    def check_numbers(self, state: NewtonState) -> None:
        """See `MapModel`."""
        if isinstance(self.surface, DeformationEnergy):
            self.surface.check_numbers(state.derivatives.surface)

    def _evaluate_step(self, state: NewtonState, w: ComplexArray, bound: float) -> tuple[float, NewtonState | None]:
        """A map is also rejected if the boundary meets itself or gaps shrink too much."""
        value, there = super()._evaluate_step(state, w, bound)
        if there is None:
            return value, None
        near = self._rim.contacts(w)
        gap = near.smallest_gap(w)
        # New pairs are compared with `narrower` at most, as otherwise no step might be short enough.
        before = min(state.extra.gap, near.smallest_gap(state.w), _TUNING.narrower)
        if gap < _TUNING.narrower * before or self._rim.meets_itself(self.positions(w)):
            return value, None
        return value, there._replace(extra=there.extra._replace(near=near, gap=gap))


class SurfaceDescent(IteratedDescent):
    """Newton steps of a map with a free boundary, from an injective map ``uv`` (n, 2) of about unit size.

    ``fixed`` has at least one vertex, to prevent drift; usually exactly one. With the surface's boundary as ``rim`` the
    map stays bijective. ``pairs`` are further second derivatives of the energy. Without rim and pairs,
    ``iterate`` is that of `IteratedDescent`. ``rotations`` are those of the surface, if the map is almost an isometry.
    """

    model: SurfaceModel

    def __init__(
        self,
        energy: NewtonObjective,
        uv: FloatArray,
        linear_solver: str,
        fixed: Sequence[int] | IntArray = (0,),
        *,
        rim: Rim | None = None,
        pairs: Pairs | None = None,
        iterate: bool = False,
        rotations: RotationPath | None = None,
    ) -> None:
        options = uv, linear_solver, np.asarray(fixed, dtype=np.int64), pairs
        model = SurfaceModel(energy, *options) if rim is None else GuardedModel(energy, *options, rim)
        self._rotations = rotations
        super().__init__(
            model,
            model.start(uv),
            iterate=iterate and rim is None and pairs is None,
            inverse_near=None if rotations is None else rotations.inverse_near,
        )

    @property
    def uv(self) -> FloatArray:
        """The current map; (n, 2) float64."""
        return self.model.positions(self.w)

    @property
    def distortion(self) -> float:
        """The value of the surface's energy, without contacts."""
        return self.model.distortion(self.state)

    @property
    def linear_solver(self) -> str:
        """Name of the linear solver."""
        return self.model.system.solver.name if self._rotations is None else self._rotations.linear_solver

    def move_to(self, uv: FloatArray) -> None:
        """Continue from another map (n, 2) without contacts."""
        self.model.coordinates = Coordinates.of(uv, self.model.coordinates.fixed, 0)
        self.state = self.model.start(uv)

    def use_density(self, density: Energy) -> None:
        """Continue with another density on the same triangles; the energy must be a `DeformationEnergy`."""
        assert isinstance(self.model.surface, DeformationEnergy)
        self.model.surface.energy = density
        self.state = self.state._replace(value=self.model.energy.value_of(self.state.derivatives))
        self.memory = replace(self.memory, shortened=True, idle=0)

    def relax_barrier(self) -> bool:
        """Lower the weight of the barrier that guards the map; return False if there is none or it is the last."""
        if not self.model.relax_barrier():
            return False
        self.memory = replace(self.memory, idle=0)
        return True


def _unite_pairs(older: IntArray, newer: IntArray, n: int) -> IntArray:
    """Unite pairs (3, c), or return the newer ones if they are less than half; ``n`` exceeds all vertices."""
    both = np.concatenate([newer, older], axis=1)
    _, first = np.unique(both[0] * n + both[1], return_index=True)
    return newer if first.size > 2 * newer.shape[1] else both[:, first]


def descend(
    descent: SurfaceDescent,
    density: Energy,
    tol: float,
    improve: Callable[[FloatArray], FloatArray | None] | None = None,
) -> Iterator[Status | None]:
    """Take steps until converged or stalled; yield None after every step but the last, which yields a status.

    If the density of the descent, at its start, is `ReweightedDirichlet`, it is used until the mean energy is small, as
    long as two steps together at least halve it. ``density`` is the one to minimise, and ``tol`` is that of
    `quasiharmonic.polish`. ``improve`` is called before each step. It takes the map and returns a better one or None.
    """
    values = [np.inf, descent.distortion]
    surface = descent.model.surface
    far = isinstance(surface, DeformationEnergy) and isinstance(surface.energy, ReweightedDirichlet)
    area = float(surface.share.sum()) if isinstance(surface, DeformationEnergy) else 1.0
    while True:
        better = None if improve is None else improve(descent.uv)
        if better is not None:
            descent.move_to(better)
            if far and descent.distortion < NEAR_ENERGY * area:
                far = False
                descent.use_density(density)
        if far:
            assert isinstance(surface, DeformationEnergy)
            surface.energy = ReweightedDirichlet.at(descent.distortion / area)
        with np.errstate(all="ignore"):
            outcome = descent.step(tol)
        values.append(descent.distortion)
        near = values[-1] < NEAR_ENERGY * area
        if far and (outcome is not None or near or not values[-1] < 0.5 * values[-3]):
            far, outcome = False, None
            descent.use_density(density)
        elif outcome is not None and descent.relax_barrier():
            outcome = None
        yield outcome
        if outcome is not None:
            return
