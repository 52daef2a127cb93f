"""Refine meshes that are too coarse for a target: split edges that the caller or a diagnosis names."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.splitting import Refined, compose, split_edges
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.problem.diagnosis import Diagnosis, diagnose
from quasiharmonic.util.arrays import check_integer
from quasiharmonic.util.outcome import BaseOutcome


@dataclass(frozen=True, eq=False, repr=False)
class RefinedProblem(BaseOutcome):
    """A problem on a refined mesh.

    Attributes
    ----------
    problem : Problem
        The same vertices are fixed, at the same positions.
    refined : Refined
        Relation of its mesh to the original one.
    diagnosis : Diagnosis
        Obstructions to a map; refinement does not remove these.
    rounds : int
        Number of rounds of edge splitting.

    See Also
    --------
    refine_problem : Makes it.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, refine_problem
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> refine_problem(Problem(V, F, rim, V[rim])).diagnosis.obstructions
    ()
    """

    problem: Problem
    refined: Refined
    diagnosis: Diagnosis
    rounds: int

    @property
    def success(self) -> bool:
        """Whether no known obstruction to an injective map remains."""
        return not self.diagnosis.forbids_injective

    @property
    def message(self) -> str:
        """The summary of the diagnosis."""
        return self.diagnosis.summary()


@accepts_mesh
def refine(V: ArrayLike, F: ArrayLike, edges: ArrayLike, *, boundary: bool = False) -> Refined:
    """Split edges of a mesh at their midpoints, and divide the triangles beside these edges.

    A triangle with one split edge becomes two, with two split edges three (along the shorter diagonal of the remaining
    quadrilateral), with three split edges four. Other triangles do not change. Original vertices keep their positions
    and indices, so ``fixed`` remains valid.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices.
    F : (f, 3) array of int
        Triangles, no edge in more than two of them.
    edges : (s, 2) array of int
        Edges to split, as pairs of vertices in any order; duplicates are allowed. `Diagnosis.split` names the edges
        that prevent a map.
    boundary : bool
        Also split edges on the boundary. Their midpoints are new boundary vertices, which need a position in the
        target; `Refined.extend` computes one.

    Returns
    -------
    Refined

    Raises
    ------
    ValueError
        If a pair is not an edge of the mesh, or is on its boundary and ``boundary`` is false. If indices are not
        integers, have the wrong shape or are out of range. If positions are not real, not finite or of the wrong shape.

    See Also
    --------
    refine_problem : Splits the edges that a diagnosis names.
    diagnose : Names edges that prevent a map.

    Examples
    --------
    >>> V = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    >>> refined = refine(V, [[0, 1, 2], [0, 2, 3]], [[0, 2]])
    >>> refined.F.tolist(), refined.parent.tolist()
    ([[4, 1, 2], [4, 3, 0], [4, 0, 1], [4, 2, 3]], [0, 1, 0, 1])
    """
    return split_edges(V, F, edges, boundary=boundary)


def refine_problem(problem: Problem, *, max_rounds: int = 20) -> RefinedProblem:
    """Split the edges that a diagnosis names until it names none.

    Parameters
    ----------
    problem : Problem
    max_rounds : int
        Maximum number of rounds of diagnosis and splitting. One round usually suffices. If the mesh is much too coarse,
        split edges may have to be split again.

    Returns
    -------
    RefinedProblem
        If no edge is named, the original problem on the original mesh.

    See Also
    --------
    refine : Splits edges that the caller names.
    diagnose : Names the edges.
    injective_map : Splits edges itself with ``refine=True``.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, refine_problem
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> refined = refine_problem(Problem(V, F, rim, V[rim]))
    >>> refined.success, refined.rounds
    (True, 0)
    """
    check_problem("refine_problem", problem)
    check_integer("max_rounds", max_rounds, minimum=0)
    refined = split_edges(problem.V, problem.F, [])
    diagnosis = diagnose(problem)
    rounds = 0
    while rounds < max_rounds and len(diagnosis.split):
        refined = compose(refined, split_edges(refined.V, refined.F, diagnosis.split))
        problem = Problem(refined.V, refined.F, problem.fixed, problem.target, reference=problem.reference)
        diagnosis = diagnose(problem)
        rounds += 1
    return RefinedProblem(problem, refined, diagnosis, rounds)
