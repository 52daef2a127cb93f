"""A problem whose mesh is too coarse for its target: the edges that a diagnosis names are split."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from quasiharmonic.mesh.refinement import Refined, composed, refine
from quasiharmonic.problem import Problem

if TYPE_CHECKING:
    from quasiharmonic.exact.diagnosis import Diagnosis


@dataclass(frozen=True, eq=False)
class RefinedProblem:
    """A problem on a refined mesh.

    Attributes
    ----------
    problem : Problem
        The same vertices are fixed, at the same positions.
    refined : Refined
        How its mesh came from the old one.
    diagnosis : Diagnosis
        What is known to forbid a map of it; no refinement cures that.
    rounds : int
        How often edges were split.
    """

    problem: Problem
    refined: Refined
    diagnosis: Diagnosis
    rounds: int


def refine_problem(problem: Problem, *, most_rounds: int = 20) -> RefinedProblem:
    """Split the edges that a diagnosis names, and no others, until it names none.

    Parameters
    ----------
    problem : Problem
    most_rounds : int
        Diagnoses to act upon at most. One is enough as a rule; where much room is lacking, edges that
        were split may have to be split again.

    Returns
    -------
    RefinedProblem
        The problem as it was, on the same mesh, when no edge is named.

    See Also
    --------
    refine : splits edges that the caller names.
    quasiharmonic.diagnose : names them.
    """
    from quasiharmonic.exact.diagnosis import diagnose

    whole = refine(problem.V, problem.F, [])
    diagnosis = diagnose(problem)
    rounds = 0
    while rounds < most_rounds and len(diagnosis.split):
        whole = composed(whole, refine(whole.V, whole.F, diagnosis.split))
        problem = Problem(whole.V, whole.F, problem.fixed, problem.target, reference=problem.reference)
        diagnosis = diagnose(problem)
        rounds += 1
    return RefinedProblem(problem, whole, diagnosis, rounds)
