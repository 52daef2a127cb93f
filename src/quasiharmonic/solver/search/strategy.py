"""What is tried, in which order: what gets through soonest and most often, and the pipeline of the paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import takewhile

from quasiharmonic.problem import Problem
from quasiharmonic.solver.methods import (
    Alternating,
    Composite,
    Descent,
    LineShift,
    LocalRepair,
    Newton,
    RandomRestarts,
    Untangling,
    VectorAdam,
)
from quasiharmonic.solver.methods.base import SearchStage
from quasiharmonic.solver.search.stages import CoarseToFine, Stages, TentativeStage, WhereMany
from quasiharmonic.util.arrays import kind_of

# Vertices from which on a coarse-to-fine start pays: the coarse mesh, made, solved and refined again, takes less time
# than ten iterations on the mesh.
_LARGE = 6000
# Up to so many triangles, or so many for each edge of the boundary, the composite takes longer than what it saves.
_SMALL, _SLIM = 1000, 4
# Turns of alternation and Newton's method in the paper's pipeline.
_TURNS = 10


def speed(problem: Problem) -> Stages:
    """The stages that find a map soonest, the first of which usually suffices.

    Boundaries alone want tanh, pins want si-log: the spike that a pinned point draws needs distortion that
    grows slowly towards it, and tanh never gets there. One loop without pins is near to a solution at once by way of
    a disk. What is left then are a few triangles in tight places, which moving vertices rights sooner than moving
    tensors does; or else the map is far from any solution in parts, and Newton's method brings it nearer. All of this
    is tried on a coarse mesh first if the mesh is large, and soon if it is not.

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    list of Descent or CoarseToFine
        In the order in which they are run.
    """
    domain = problem.domain
    pinned, triangles = bool(domain.pins.size), len(problem.F)
    alone = len(domain.loops) == 1 and not pinned
    composed = alone and triangles > max(_SMALL, _SLIM * domain.loops[0].size)
    return list(_speed(pinned, alone, composed, problem.n >= _LARGE))


@cache
def _speed(pinned: bool, alone: bool, composed: bool, large: bool) -> Stages:
    """The stages with pins or not, for one loop without pins or not, the composite first or not, of a large mesh."""
    other: Stages = ()
    if pinned:
        first: Descent = VectorAdam(parameterisation="si-log", iterations=400, placing=True)
        newton = Newton(parameterisation="si-log", iterations=60, resume=True)
    else:
        first, newton = VectorAdam(iterations=100, placing=True), Newton(iterations=300, resume=True)
    # Most tries at local repair succeed in the first few, and a failing one costs as much as many Newton steps.
    repair: Stages = (LineShift(resume=True), LocalRepair(tries=15, resume=True))
    if alone:
        # From one of the two starts or the other.
        composite = Composite(iterations=100, placing=True)
        first, second = (composite, first) if composed else (first, composite)
        other = (second, *repair)
    coarse = CoarseToFine(first)
    soon: Stages = (first, *repair, coarse)
    if large:
        # Newton's steps right by the thousand what repair takes patch by patch.
        soon = (coarse, first, *((WhereMany(newton),) if alone else ()), *repair)
    return (
        *soon,
        Untangling(iterations=400, resume=True),
        LineShift(in_vain=10, resume=True),
        *other,
        newton,
        Untangling(iterations=600, resume=True),
        LineShift(in_vain=10, resume=True),
        RandomRestarts(in_vain=30, resume=True),
        RandomRestarts(in_vain=30),
        RandomRestarts(in_vain=60, resume=True),
    )


def paper(_: Problem) -> Stages:
    """The pipeline of the paper's evaluation (§9.2, §10.1), and nothing else.

    si-log for at most 1000 iterations; then tanh from the start again; then for the last few triangles the
    alternation and Newton's method in turn, the alternation's iterations discarded where it fails. All on the mesh
    itself, and on the surface's own triangles, angles below π/6 corrected (§F.1). How many iterations tanh and each
    turn have the paper does not say; these make up 2000. Its steps are VectorAdam's own here.

    Returns
    -------
    list of Descent or TentativeStage
    """
    turn: list[SearchStage] = [
        TentativeStage(Alternating(reference="corrected", iterations=20, resume=True)),
        Newton(reference="corrected", iterations=20, resume=True),
    ]
    return [
        VectorAdam(parameterisation="si-log", reference="corrected", iterations=1000),
        VectorAdam(reference="corrected", iterations=600),
        *_TURNS * turn,
    ]


STRATEGIES: dict[str, Callable[[Problem], Stages]] = {"speed": speed, "paper": paper}


def stages_of(strategy: str | Stages, problem: Problem) -> Stages:
    """The stages that a strategy's name, or the user's own list, stands for.

    Raises
    ------
    ValueError
        When there is no such strategy.
    """
    if isinstance(strategy, str):
        if strategy not in STRATEGIES:
            raise ValueError(f"strategy must be one of {', '.join(STRATEGIES)} or a list of Descent, not {strategy!r}")
        return STRATEGIES[strategy](problem)
    given = list(strategy) if isinstance(strategy, Sequence) else []
    stages = [stage for stage in given if isinstance(stage, SearchStage)]
    if not stages or len(stages) < len(given):
        raise ValueError(
            f"strategy must be one of {', '.join(STRATEGIES)} or a list of Descent, not {kind_of(strategy)}"
        )
    return stages


def soonest(stages: Stages) -> Stages:
    """The first stages of a strategy: up to the first descent on the mesh itself, and what is quick right after it."""
    before = list(takewhile(lambda stage: stage.coarse, stages))
    first = stages[len(before) : len(before) + 1]
    rest = [stage for stage in stages[len(before) + 1 :] if not isinstance(stage, WhereMany)]
    return [*before, *first, *takewhile(lambda stage: stage.quick, rest)]


def without_restarts(stages: Stages) -> Stages:
    """A strategy without the stages that start again at random, whose failing tries take many times an iteration."""
    return [stage for stage in stages if not isinstance(stage, RandomRestarts)] or stages
