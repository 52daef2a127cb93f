"""Strategies: lists of stages. The default strategy is fast and reliable; the other is the pipeline of the paper.

Most stages are a plain `Descent`. The others run on a coarse mesh, tentatively, or under a condition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import takewhile
from math import inf
from typing import Any, ClassVar, NamedTuple, TypeAlias

from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.solver.methods import (
    Alternating,
    Composite,
    Descent,
    LineShift,
    Newton,
    RandomRestarts,
    Untangling,
    VectorAdam,
    WideRepair,
)
from quasiharmonic.solver.methods.base import SearchStage, StageRunner
from quasiharmonic.util.arrays import describe
from quasiharmonic.util.hints import suggest

#: Stages of a strategy.
Stages: TypeAlias = Sequence[SearchStage]


class StageThresholds(NamedTuple):
    """Sizes of problems from which stages run, and fractions of inverted triangles."""

    # Number of vertices from which a coarse-to-fine start pays. Making, solving and refining the coarse mesh is then
    # faster than ten iterations on the fine mesh.
    coarse: int = 6000
    # Number of triangles from which wide patches are tried before the whole mesh is untangled.
    wide: int = 4000
    # Number of triangles from which an iteration takes so long that only stages with a good chance follow a composite.
    brief: int = 8000
    # Up to this number of triangles the composite costs more time than it saves.
    composite: int = 1000
    # The same number per boundary edge.
    composite_per_edge: int = 4
    # Fraction of inverted triangles up to which early repairs run; above it, Newton's method precedes line shifts.
    many_inverted: float = 0.02
    # Fraction of inverted triangles up to which the last repairs of a large mesh run.
    few_inverted: float = 0.002
    # Above this fraction, the map is no better than without the composite.
    hardly_untangled: float = 0.1


_THRESHOLDS = StageThresholds()


@dataclass(frozen=True)
class _DescentStage(SearchStage):
    """Stage that runs one descent in its own way."""

    descent: Descent

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return self.descent.name

    @property
    def begins_with(self) -> Descent:
        """``descent``."""
        return self.descent


class CoarseToFine(_DescentStage):
    """Stage that searches on a coarse mesh and transfers the map to the fine mesh; skipped if the mesh is small.

    ``descent`` is the first stage on the coarse mesh; line shift and untangling follow.
    """

    coarse: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return f"coarse-to-fine, {self.descent.name}"

    def run(self, search: StageRunner) -> None:
        """See `SearchStage`."""
        search.search_on_coarse(self.name, self.descent)


class TentativeStage(_DescentStage):
    """Stage whose iterations are discarded if it finds no map (§9.2). Later stages continue from the earlier state."""

    def run(self, search: StageRunner) -> None:
        """See `SearchStage`."""
        lowest_energy = search.lowest_energy
        if search.attempt(self.descent) is not Status.INJECTIVE:
            search.lowest_energy = lowest_energy


@dataclass(frozen=True)
class OnlyIf(_DescentStage):
    """Stage that runs only if the fraction of inverted triangles is ``above`` one limit and at most ``up_to`` another.

    With few inverted triangles, line shifts are faster than other descents. With many, repairs are slow or hopeless.
    """

    above: float = -inf
    up_to: float = inf

    def run(self, search: StageRunner) -> None:
        """See `SearchStage`."""
        if self.above < search.best[0] / len(search.problem.F) <= self.up_to:
            search.attempt(self.descent)


class EarlyRepair(OnlyIf):
    """Repair before a descent that it may make needless."""

    quick: ClassVar[bool] = True


def speed(problem: Problem) -> Stages:
    """Return the stages of the default strategy, which finds a map fastest; the first stage usually suffices.

    The order of stages follows from these observations:

    - Without pins tanh is best. With pins si-log is best: the spike at a pinned vertex needs distortion that grows
      slowly towards it, which tanh does not reach.
    - With one boundary loop and no pins, the composite through a disk starts close to a solution.
    - After the first stage a few triangles in narrow regions may be inverted; moving vertices untangles them faster
      than changing tensors. Otherwise parts of the map are far from a solution, and Newton's method is used.
    - On a large mesh a coarse mesh is searched first; on a small mesh it is searched after the first repairs.
    - On a large mesh, wide patches are untangled before the whole mesh.
    - On a large mesh with a composite, continuing the descent takes a fifth of the time of Newton's method and leaves
      fewer triangles inverted. If more than a few are left then, later stages hardly ever succeed, but take minutes.
    """
    domain = problem.domain
    pinned, triangles = bool(domain.pins.size), len(problem.F)
    is_disk = len(domain.loops) == 1 and not pinned
    composed = is_disk and triangles > max(_THRESHOLDS.composite, _THRESHOLDS.composite_per_edge * domain.loops[0].size)
    large, wide = problem.n >= _THRESHOLDS.coarse, triangles >= _THRESHOLDS.wide
    if composed and wide:
        return list(_speed_by_composite(large, triangles >= _THRESHOLDS.brief))
    return list(_speed(pinned, is_disk, composed, large, wide))


@cache
def _speed(pinned: bool, is_disk: bool, composed: bool, large: bool, wide: bool) -> Stages:
    """Return the stages of `speed` for these properties of a mesh.

    It has pins, is a disk without pins, is mapped by the composite first, or is large; ``wide`` adds wide patches
    before the whole mesh is untangled.
    """
    other: Stages = ()
    if pinned:
        first: Descent = VectorAdam(parameterisation="si-log", iterations=400, relocation=True)
        newton = Newton(parameterisation="si-log", iterations=60, resume=True)
    else:
        first, newton = VectorAdam(iterations=100, relocation=True), Newton(iterations=300, resume=True)
    shift = LineShift(resume=True)
    if is_disk:
        # Two different starts: if one fails, the other may succeed.
        composite = Composite(iterations=100, relocation=True)
        first, second = (composite, first) if composed else (first, composite)
        other = (second, shift)
    coarse = CoarseToFine(first)
    first_stages: Stages = (first, shift, coarse)
    if large:
        # Newton steps untangle thousands of triangles at once, line shifts only a few.
        first_stages = (coarse, first, *((OnlyIf(newton, above=_THRESHOLDS.many_inverted),) if is_disk else ()), shift)
    return (
        *first_stages,
        *((WideRepair(resume=True),) if wide else ()),
        Untangling(iterations=400, resume=True),
        LineShift(max_failures=10, resume=True),
        *other,
        newton,
        Untangling(iterations=600, resume=True),
        LineShift(max_failures=10, resume=True),
        RandomRestarts(max_failures=30, resume=True),
        RandomRestarts(max_failures=30),
        RandomRestarts(max_failures=60, resume=True),
    )


@cache
def _speed_by_composite(large: bool, brief: bool) -> Stages:
    """Return the stages of `speed` for a mesh of at least `StageThresholds.wide` triangles that has a composite.

    It is ``large`` enough for a coarse mesh at first, and so large that the list of stages is ``brief``.
    """
    first, second = Composite(iterations=100, relocation=True), VectorAdam(iterations=100, relocation=True)
    coarse, shift, wide = CoarseToFine(first), LineShift(resume=True), WideRepair(resume=True)
    # Close to the composite a fold moves little in an iteration: a longer memory adds up many short steps.
    steps = (0, 0.1), (100, 0.1), (200, 0.02)
    again = VectorAdam(iterations=200, momenta=(0.9, 0.9), schedule=steps, relocation=True, resume=True)
    many, few = _THRESHOLDS.many_inverted, _THRESHOLDS.few_inverted
    first_stages: Stages = (first, shift, coarse, wide)
    if large:
        first_stages = (coarse, first, EarlyRepair(shift, up_to=many), EarlyRepair(wide, up_to=many))
    elif brief:
        first_stages = (first, EarlyRepair(shift, up_to=many), coarse, EarlyRepair(wide, up_to=many))
    if brief:
        middle: Stages = (
            OnlyIf(Newton(iterations=60, resume=True), up_to=few),
            OnlyIf(LineShift(max_failures=20, resume=True), up_to=few),
            OnlyIf(wide, up_to=few),
            OnlyIf(Untangling(iterations=400, resume=True), above=_THRESHOLDS.hardly_untangled),
        )
        last: Stages = (
            OnlyIf(Untangling(iterations=100, resume=True), up_to=few),
            OnlyIf(LineShift(max_failures=10, resume=True), up_to=few),
            OnlyIf(RandomRestarts(max_failures=10, resume=True), up_to=few),
        )
    else:
        middle = Untangling(iterations=400, resume=True), LineShift(max_failures=10, resume=True)
        last = (
            OnlyIf(Newton(iterations=300, resume=True), up_to=few),
            OnlyIf(Untangling(iterations=200, resume=True), up_to=few),
            OnlyIf(LineShift(max_failures=10, resume=True), up_to=few),
            OnlyIf(RandomRestarts(max_failures=30, resume=True), up_to=few),
        )
    return (*first_stages, again, shift, wide, *middle, second, shift, *last)


def paper(_: Problem) -> Stages:
    """Return the stages of the paper's evaluation (§9.2, §10.1).

    The stages are si-log for at most 1000 iterations, then tanh from ξ = 0. Alternation and Newton's method then take
    turns for the last few triangles, and failed alternations are discarded. All stages run on the mesh itself, with the
    surface's triangles as reference and angles below π/6 corrected (§F.1). The paper does not give the iterations of
    tanh and of each turn; those used here add up to 2000. The steps are the defaults of `VectorAdam`.
    """
    # Repetitions of alternation and Newton's method in the paper's pipeline.
    repetitions = 10
    turn: list[SearchStage] = [
        TentativeStage(Alternating(reference="corrected", iterations=20, resume=True)),
        Newton(reference="corrected", iterations=20, resume=True),
    ]
    return [
        VectorAdam(parameterisation="si-log", reference="corrected", iterations=1000),
        VectorAdam(reference="corrected", iterations=600),
        *repetitions * turn,
    ]


STRATEGIES: dict[str, Callable[[Problem], Stages]] = {"speed": speed, "paper": paper}


def select_strategy(strategy: str, **descent: Any) -> str | Stages:
    """Return a strategy, or a single descent in its place if one of the `DescentOptions` is given."""
    given = {name: value for name, value in descent.items() if value is not None}
    if given and strategy != "speed":
        raise ValueError(f"a single descent replaces the strategy: omit {next(iter(given))}, or strategy")
    return [VectorAdam(**given)] if given else strategy


def stages_of(strategy: str | Stages, problem: Problem) -> Stages:
    """Return the stages of a named strategy, or the given list of stages; raise a ValueError if neither is valid."""
    if isinstance(strategy, str) and strategy in STRATEGIES:
        return STRATEGIES[strategy](problem)
    given = list(strategy) if isinstance(strategy, Sequence) else []
    stages = [stage for stage in given if isinstance(stage, SearchStage)]
    if not stages or len(stages) < len(given):
        found = repr(strategy) if isinstance(strategy, Sequence) else describe(strategy)
        raise ValueError(
            f"strategy must be one of {', '.join(STRATEGIES)} or a non-empty list of Descent, not {found}"
            f"{suggest(strategy, STRATEGIES)}"
        )
    return stages


def quick_stages(stages: Stages) -> Stages:
    """Return the first stages of a strategy: up to the first on the mesh itself, and the quick ones after it.

    A descent that continues the first one also counts as quick.
    """

    def is_quick(stage: SearchStage) -> bool:
        return stage.quick or (isinstance(stage, VectorAdam) and stage.resume)

    before = list(takewhile(lambda stage: stage.coarse, stages))
    first = stages[len(before) : len(before) + 1]
    rest = [stage for stage in stages[len(before) + 1 :] if not (isinstance(stage, OnlyIf) and stage.above > 0)]
    return [*before, *first, *takewhile(is_quick, rest)]


def without_restarts(stages: Stages) -> Stages:
    """Return a strategy without random restarts, whose failed tries cost many iterations each."""
    return [stage for stage in stages if not isinstance(stage, RandomRestarts)] or stages
