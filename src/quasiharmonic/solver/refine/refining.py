"""Meshes that are too coarse for a target: edges are split, those that the caller or that a diagnosis names."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.refinement import Refined, composed, split_edges
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis, diagnose


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


@accepts_mesh
def refine(V: ArrayLike, F: ArrayLike, edges: ArrayLike, *, boundary: bool = False) -> Refined:
    """Split edges of a mesh at their midpoints, and the triangles beside them to match.

    A triangle with one split edge becomes two, with two three (along the shorter diagonal of the
    quadrilateral that remains), with three four. No other triangle changes, and no old vertex moves
    or changes its index, so that fixed vertices stay as they are.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices.
    F : (f, 3) array of int
        Triangles, no edge in more than two of them.
    edges : (s, 2) array of int
        Edges to split, as pairs of vertices in any order; naming one twice does no harm.
        `Diagnosis.split` names those that stand in the way of a map.
    boundary : bool
        Also split edges on the boundary. Their midpoints are new boundary vertices, which need a
        position in the target: `Refined.extend` finds them one.

    Returns
    -------
    Refined

    Raises
    ------
    ValueError
        When a pair is not an edge of the mesh, or is on its boundary and ``boundary`` is false; when
        indices are no integers, have the wrong shape or refer to no vertex; when positions are no real
        numbers, not finite or of the wrong shape.

    See Also
    --------
    refine_problem : splits what a diagnosis names.

    Examples
    --------
    >>> V = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    >>> refined = refine(V, [[0, 1, 2], [0, 2, 3]], [[0, 2]])
    >>> refined.F.tolist(), refined.parent.tolist()
    ([[4, 1, 2], [4, 3, 0], [4, 0, 1], [4, 2, 3]], [0, 1, 0, 1])
    """
    return split_edges(V, F, edges, boundary=boundary)


def refine_problem(problem: Problem, *, max_rounds: int = 20) -> RefinedProblem:
    """Split the edges that a diagnosis names, and no others, until it names none.

    Parameters
    ----------
    problem : Problem
    max_rounds : int
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
    whole = split_edges(problem.V, problem.F, [])
    diagnosis = diagnose(problem)
    rounds = 0
    while rounds < max_rounds and len(diagnosis.split):
        whole = composed(whole, split_edges(whole.V, whole.F, diagnosis.split))
        problem = Problem(whole.V, whole.F, problem.fixed, problem.target, reference=problem.reference)
        diagnosis = diagnose(problem)
        rounds += 1
    return RefinedProblem(problem, whole, diagnosis, rounds)
