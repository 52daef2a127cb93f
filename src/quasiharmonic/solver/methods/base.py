"""What every way to descend is: a few settings, and a generator of maps.

A method is one file with one frozen class. Its fields are its settings, `Descent.iterates` yields map after map, and
whoever runs it (`quasiharmonic.solver.search`) looks at each and stops when it has seen enough.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeAlias, get_args

import numpy as np

from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS
from quasiharmonic.util.arrays import ComplexArray, check_choice, whole_number

Iterates: TypeAlias = Generator[Iterate, None, bool]


@dataclass(frozen=True)
class SearchState:
    """What a search has found before a stage begins.

    Attributes
    ----------
    given : (n,) complex128 or None
        The caller's first map, for the very first stage.
    best_map : (n,) complex128
        The map of the fewest inverted triangles.
    lowest_energy : Iterate or None
        The one of the lowest V₃ among those that tensors were descended to.
    """

    given: ComplexArray | None
    best_map: ComplexArray
    lowest_energy: Iterate | None


class StageRunner(Protocol):
    """What a stage asks of the search that runs it. Either call says how the search stands after the stage."""

    def attempt(self, stage: Descent, before: Status) -> Status:
        """Descend on the mesh itself; ``before`` is how the search stood."""

    def attempt_on_coarse(self, stage: SearchStage, before: Status) -> Status:
        """Search on a coarse mesh, beginning with what the stage ``begins_with``, and carry the map to the mesh."""

    def attempt_tentatively(self, stage: Descent, before: Status) -> Status:
        """Descend on the mesh itself; where that finds no map, later stages go on from where this one began."""

    def attempt_where_many(self, stage: Descent, before: Status) -> Status:
        """Descend on the mesh itself if many triangles are inverted."""

    def take_over(self, begun: Any) -> Status:
        """Go on from what was found elsewhere by the stage that the search would begin with."""


class SearchStage(ABC):
    """What a strategy is a list of."""

    #: Whether it searches on a coarse mesh, and not on the mesh itself.
    coarse: ClassVar[bool] = False
    #: Whether it takes no longer than finding out whether there is a map at all, which is put off until after it.
    quick: ClassVar[bool] = False

    @property
    @abstractmethod
    def name(self) -> str:
        """How reports call this stage."""

    @property
    @abstractmethod
    def begins_with(self) -> Descent:
        """The first descent, on whichever mesh."""

    @abstractmethod
    def run(self, search: StageRunner, before: Status) -> Status:
        """Have a search run this stage; how the search stands afterwards."""


@dataclass(frozen=True, kw_only=True)
class Descent(SearchStage):
    """One stage of a search, on the mesh itself.

    Attributes
    ----------
    resume : bool
        Start from the best so far instead of ξ = 0.

    Raises
    ------
    ValueError
        When a setting has no such value.
    """

    resume: bool = False

    #: How reports call the method.
    word: ClassVar[str]
    #: Whether positions are what moves, and tensors only follow.
    moves_vertices: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """How reports call this stage."""
        return self.word

    @property
    def begins_with(self) -> Descent:
        """Itself."""
        return self

    def run(self, search: StageRunner, before: Status) -> Status:
        """As of `SearchStage`."""
        return search.attempt(self, before)

    @property
    def patience(self) -> tuple[int, float] | None:
        """The stage has settled when within so many iterates none was righted and the objective fell by less.

        As a fraction of itself. None for methods that know by themselves when to end.
        """
        return None

    def objective(self, problem: Problem, linear_solver: str) -> Objective:
        """What is descended, or what the maps are judged by."""
        return Objective(problem, linear_solver=linear_solver)

    @abstractmethod
    def start(self, objective: Objective, found: SearchState) -> Iterate:
        """Where the stage begins.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When rounding leaves no positive definite Laplacian.
        """

    @abstractmethod
    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """Descend.

        Parameters
        ----------
        objective : Objective
        start : Iterate

        Yields
        ------
        Iterate
            Every map on the way, ``start`` excepted. One of the same ``w`` as the last says that what took as long as
            an iteration was of no use: a search counts these apart.

        Returns
        -------
        bool
            Whether the method has come to rest, and not to the end of its iterations.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When even short steps leave no positive definite Laplacian.
        """


class Patience:
    """How long a stage has made no progress.

    Parameters
    ----------
    limits : (int, float) or None
        As of `Descent.patience`.
    """

    def __init__(self, limits: tuple[int, float] | None) -> None:
        self._most: float
        self._most, self._progress = limits or (np.inf, 0.0)
        self._flipped, self._value, self._low_enough, self._in_vain = np.inf, np.inf, np.inf, 0

    def is_over(self, inverted: int, value: float) -> bool:
        """Whether too many steps in a row have righted no triangle and lowered the objective by too little."""
        if inverted < self._flipped or value < self._low_enough:
            self._flipped, self._value = min(inverted, self._flipped), min(value, self._value)
            # V₄ may be negative.
            fraction = self._progress * abs(self._value) if np.isfinite(self._value) else 0.0
            self._low_enough = self._value - fraction
            self._in_vain = 0
        else:
            self._in_vain += 1
        return self._in_vain > self._most


class Steps:
    """The iterates of a descent, and when they have ended whether it came to rest.

    Attributes
    ----------
    at_rest : bool
    """

    def __init__(self, iterates: Iterates) -> None:
        self._iterates = iterates
        self.at_rest = False

    def __iter__(self) -> Iterator[Iterate]:
        self.at_rest = yield from self._iterates


@dataclass(frozen=True, kw_only=True)
class TensorDescent(Descent):
    """A stage that descends an objective over ξ.

    Attributes
    ----------
    parameterisation : str
        A name of `quasiharmonic.solver.field.tensor.PARAMETERISATIONS`: how ξ becomes a tensor (§8.2); ``"tanh"`` is
        fast, ``"si-log"`` keeps angles.
    reference : {"equilateral", "rest", "corrected"}
        Shape of the triangles, unless the problem itself names one.
    iterations : int
        Steps to take at most.
    resume : bool
        Start from the tensors of the lowest V₃ so far instead of ξ = 0. (Not from those of the map of the fewest
        inverted triangles, which may have been passed by early on, far from any solution.)
    """

    parameterisation: str = "tanh"
    reference: Reference = "equilateral"
    iterations: int = 1000

    def __post_init__(self) -> None:
        check_choice("parameterisation", self.parameterisation, PARAMETERISATIONS)
        check_choice("reference", self.reference, get_args(Reference))
        whole_number("iterations", self.iterations, least=1)

    @property
    def name(self) -> str:
        """How reports call this stage."""
        return f"{self.word}, {self.parameterisation}"

    @property
    def patience(self) -> tuple[int, float] | None:
        """As of `Descent`."""
        return 300, 1e-3

    def objective(self, problem: Problem, linear_solver: str) -> Objective:
        """What is descended: V₃."""
        return Objective(problem, "dirichlet", self.parameterisation, self.reference, linear_solver)

    def start(self, objective: Objective, found: SearchState) -> Iterate:
        """At the caller's map if there is one, at the tensors of the lowest V₃ so far, or at ξ = 0."""
        best = found.lowest_energy if self.resume else None
        if found.given is not None:
            return objective.near_map(found.given)
        if best is None:
            mu = np.zeros(len(objective.problem.F), dtype=np.complex128)
        elif best.objective.mesh is objective.mesh:
            mu = best.field.mu
        else:
            mu = objective.own_tensor(best.w)
        return objective.evaluate(objective.bounded(objective.parameterisation.invert(mu)))


@dataclass(frozen=True, kw_only=True)
class FunctionalDescent(TensorDescent):
    """A stage that descends any of the functionals.

    Attributes
    ----------
    functional : str
        A name of `quasiharmonic.solver.field.functionals.FUNCTIONALS`: what is descended (§7.3).
    """

    functional: str = "dirichlet"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("functional", self.functional, FUNCTIONALS)

    @property
    def name(self) -> str:
        """How reports call this stage."""
        return f"{self.word}, {self.parameterisation}, {self.functional}"

    def objective(self, problem: Problem, linear_solver: str) -> Objective:
        """What is descended."""
        return Objective(problem, self.functional, self.parameterisation, self.reference, linear_solver)


@dataclass(frozen=True, kw_only=True)
class VertexDescent(Descent):
    """A stage that moves vertices, tensors following; it knows by itself when to end.

    Attributes
    ----------
    resume : bool
        Start from the map to repair instead of ξ = 0.
    """

    moves_vertices: ClassVar[bool] = True

    def start(self, objective: Objective, found: SearchState) -> Iterate:
        """At the map of the fewest inverted triangles, or at Tutte's embedding."""
        if self.resume and found.lowest_energy is not None:
            return objective.of_map(self.resumed(found.best_map, found.lowest_energy))
        if found.given is not None:
            return objective.near_map(found.given)
        return objective.evaluate(np.zeros(len(objective.problem.F), dtype=np.complex128))

    def resumed(self, best_map: ComplexArray, lowest_energy: Iterate) -> ComplexArray:
        """Which of two maps to go on from."""
        return best_map
