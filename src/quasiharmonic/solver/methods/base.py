"""Base classes of descent methods: settings, and a generator of maps.

A method is one module with one frozen class. Its fields are its settings, and `Descent.iterates` yields one map after
another. The search (`quasiharmonic.solver.search`) examines each map and decides when to stop.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeAlias

import numpy as np

from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS
from quasiharmonic.util.arrays import ComplexArray, check_choice
from quasiharmonic.util.options import Options, option, positive, reference_name

Iterates: TypeAlias = Generator[Iterate, None, bool]


@dataclass(frozen=True)
class SearchState:
    """State of a search before a stage begins.

    Attributes
    ----------
    given : (n,) complex128 or None
        The caller's initial map, for the very first stage only.
    best_map : (n,) complex128
        The map with the fewest inverted triangles.
    lowest_energy : Iterate or None
        The iterate of lowest V₃ among those of tensor descents.
    """

    given: ComplexArray | None
    best_map: ComplexArray
    lowest_energy: Iterate | None


class StageRunner(Protocol):
    """What a stage of a strategy needs of a search; see `quasiharmonic.solver.search.search.Search`."""

    problem: Problem
    best: tuple[int, float]
    lowest_energy: Iterate | None

    def attempt(self, descent: Descent) -> Status:
        """Run a descent on the mesh itself and return the status of the search after it."""

    def search_on_coarse(self, name: str, first: Descent) -> None:
        """Search on a coarse mesh, beginning with a descent, and transfer the map to the mesh itself."""


class SearchStage(ABC):
    """One stage of a strategy."""

    #: Whether the stage searches on a coarse mesh instead of the mesh itself.
    coarse: ClassVar[bool] = False
    #: Whether the stage is no slower than a diagnosis, which is therefore deferred until after the stage.
    quick: ClassVar[bool] = False

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of this stage in reports."""

    @property
    @abstractmethod
    def begins_with(self) -> Descent:
        """The first descent of the stage, on the coarse mesh or the mesh itself."""

    @abstractmethod
    def run(self, search: StageRunner) -> None:
        """Run the stage as a part of a search."""


@dataclass(frozen=True, kw_only=True)
class Descent(SearchStage, Options):
    """One stage of a search, on the mesh itself.

    Attributes
    ----------
    resume : bool
        Start from the best map so far instead of ξ = 0.

    Raises
    ------
    ValueError
        If a setting is invalid.

    See Also
    --------
    injective_map : Takes a sequence of descents as its strategy.
    quasiharmonic.solver.methods : The descents.

    Examples
    --------
    >>> from quasiharmonic import Descent
    >>> from quasiharmonic.solver.methods import Newton
    >>> isinstance(Newton(resume=True), Descent)
    True
    """

    resume: bool = False

    #: Name of the method in reports.
    label: ClassVar[str]
    #: Whether the method moves vertices and derives the tensors from them.
    moves_vertices: ClassVar[bool] = False
    #: Number of iterates and relative decrease that define a stall. The count restarts at each improvement: a triangle
    #: is untangled, or the objective falls by at least that fraction. The stage has stalled after more than that many
    #: iterates without one. None for methods that detect the end themselves.
    patience: ClassVar[tuple[int, float] | None] = None

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return self.label

    @property
    def begins_with(self) -> Descent:
        """The stage itself."""
        return self

    def run(self, search: StageRunner) -> None:
        """See `SearchStage`."""
        search.attempt(self)

    def objective(self, problem: Problem, linear_solver: str) -> Objective:
        """Return the objective that is descended, or that measures the maps."""
        return Objective(problem, linear_solver=linear_solver)

    @abstractmethod
    def start(self, objective: Objective, found: SearchState) -> Iterate:
        """Return the iterate at which the stage begins.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If the Laplacian is not positive definite after rounding.
        """

    @abstractmethod
    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """Yield every map on the way, without ``start``.

        Return True if the method converged or stalled, False if its iterations are used up. An iterate with the same
        ``w`` object as the previous one reports failed work worth one iteration; a search counts these separately.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If even short steps do not give a positive definite Laplacian.
        """


class Patience:
    """Counter of consecutive steps without progress, with the limits of `Descent.patience`."""

    def __init__(self, limits: tuple[int, float] | None) -> None:
        self._limit: float
        self._limit, self._progress = limits or (np.inf, 0.0)
        self._inverted = self._value = self._threshold = np.inf
        self._failures = 0

    def is_over(self, inverted: int, value: float) -> bool:
        """Whether too many consecutive steps untangled no triangle and lowered the objective too little."""
        if inverted < self._inverted or value < self._threshold:
            self._inverted, self._value = min(inverted, self._inverted), min(value, self._value)
            # V₄ may be negative.
            fraction = self._progress * abs(self._value) if np.isfinite(self._value) else 0.0
            self._threshold = self._value - fraction
            self._failures = 0
        else:
            self._failures += 1
        return self._failures > self._limit


class Steps:
    """Iterates of a descent; after the last one, ``converged`` tells whether the descent converged or stalled."""

    def __init__(self, iterates: Iterates) -> None:
        self._iterates = iterates
        self.converged = False

    def __iter__(self) -> Iterator[Iterate]:
        self.converged = yield from self._iterates


@dataclass(frozen=True, kw_only=True)
class TensorDescent(Descent):
    """Stage that descends an objective over ξ.

    Attributes
    ----------
    parameterisation : str
        A name of `quasiharmonic.solver.field.tensor.PARAMETERISATIONS`: the function from ξ to a tensor (§8.2).
        ``"tanh"`` is fast, ``"si-log"`` preserves angles.
    reference : {"equilateral", "rest", "corrected"}
        Reference triangles. A reference set in the problem takes precedence.
    iterations : int
        Maximum number of steps.
    resume : bool
        Start from the tensors of the lowest V₃ so far instead of ξ = 0. (The map with the fewest inverted triangles may
        be an early one that is far from any solution.)
    """

    parameterisation: str = option("tanh", check=lambda name, value: check_choice(name, value, PARAMETERISATIONS))
    reference: Reference = option("equilateral", check=reference_name)
    iterations: int = option(1000, check=positive)
    patience: ClassVar[tuple[int, float] | None] = (300, 1e-3)

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return f"{self.label}, {self.parameterisation}"

    def objective(self, problem: Problem, linear_solver: str) -> Objective:
        """Return the objective V₃."""
        return Objective(problem, "dirichlet", self.parameterisation, self.reference, linear_solver)

    def start(self, objective: Objective, found: SearchState) -> Iterate:
        """Start at the caller's map if given, at the tensors of the lowest V₃ so far, or at ξ = 0."""
        best = found.lowest_energy if self.resume else None
        if found.given is not None:
            return objective.near_map(found.given)
        if best is None:
            mu = np.zeros(len(objective.problem.F), dtype=np.complex128)
        elif best.objective.reference == objective.reference:
            mu = best.field.mu
        else:
            mu = objective.own_tensor(best.w)
        return objective.evaluate(objective.clip_xi(objective.parameterisation.invert(mu)))


@dataclass(frozen=True, kw_only=True)
class FunctionalDescent(TensorDescent):
    """Stage that descends any of the functionals.

    Attributes
    ----------
    functional : str
        A name of `quasiharmonic.solver.field.functionals.FUNCTIONALS`: the functional to descend (§7.3).
    """

    functional: str = option("dirichlet", check=lambda name, value: check_choice(name, value, FUNCTIONALS))

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return f"{self.label}, {self.parameterisation}, {self.functional}"

    def objective(self, problem: Problem, linear_solver: str) -> Objective:
        """Return the objective of the chosen functional."""
        return Objective(problem, self.functional, self.parameterisation, self.reference, linear_solver)


@dataclass(frozen=True, kw_only=True)
class VertexDescent(Descent):
    """Stage that moves vertices and derives the tensors from them; it detects its end itself.

    Attributes
    ----------
    resume : bool
        Start from the map to repair instead of ξ = 0.
    """

    moves_vertices: ClassVar[bool] = True

    def start(self, objective: Objective, found: SearchState) -> Iterate:
        """Start at the map with the fewest inverted triangles, or at Tutte's embedding."""
        if self.resume and found.lowest_energy is not None:
            return objective.of_map(self.select_start(found.best_map, found.lowest_energy))
        if found.given is not None:
            return objective.near_map(found.given)
        return objective.evaluate(np.zeros(len(objective.problem.F), dtype=np.complex128))

    def select_start(self, best_map: ComplexArray, lowest_energy: Iterate) -> ComplexArray:
        """Return which of two maps to continue from."""
        return best_map
