"""Local repair: only a patch around the last inverted triangles is solved again.

What is left at the end is typically a triangle or two against the boundary whose room is a millionth of a triangle's.
Everything outside a few rings around them stays, and the inside is untangled
(`quasiharmonic.solver.methods.untangling`). A patch that fails is grown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates, VertexDescent
from quasiharmonic.solver.methods.untangling import untangled
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, whole_number

# Inverted triangles at most for local repair to begin at all.
MOST_FLIPS = 50
# Triangles of a patch at most,
MOST_TRIANGLES = 1000
# and at most as a fraction of the mesh's: above it untangling the whole mesh takes no longer.
_MOST_SHARE = 0.25
# Rings of triangles around an inverted one, tried in turn.
_RINGS = 2, 4, 8, 16
# To how many triangles the time amounts that a step on a patch takes besides, and that an iteration on a mesh does;
# and the most triangles that a mesh's iteration is counted with: patches do not grow with the mesh.
_BESIDES, _BESIDES_AN_ITERATION, _LARGE = 400, 200, 4 * MOST_TRIANGLES


class Patch(NamedTuple):
    """Some triangles of a mesh, with vertices numbered anew.

    Attributes
    ----------
    F : (p, 3) int64
        The triangles.
    vertices : (v,) int64
        The mesh's number of each vertex.
    held : (v,) bool
        Vertices that stay: fixed ones, and those on the patch's boundary.
    """

    F: IntArray
    vertices: IntArray
    held: BoolArray


class Effort:
    """What tries at patches cost, in iterations on the whole mesh.

    It is counted in steps and triangles and not in seconds, so that a search ends at the same map every time.

    Parameters
    ----------
    triangles : int
        Of the whole mesh.
    """

    def __init__(self, triangles: int) -> None:
        self._iteration = min(triangles, _LARGE) + _BESIDES_AN_ITERATION
        self._spent = 0.0

    def count(self, triangles: int, steps: int = 1) -> None:
        """Count steps on a patch of so many triangles."""
        self._spent += steps * (triangles + _BESIDES) / self._iteration

    def due(self) -> int:
        """Whole iterations that were spent and not yet asked for."""
        whole = int(self._spent)
        self._spent -= whole
        return whole


#: From a map and its inverted triangles to a patch and another map of it.
Attempt: TypeAlias = Callable[[ComplexArray, IntArray], tuple[Patch, ComplexArray] | None]


@dataclass(frozen=True, kw_only=True)
class LocalRepair(VertexDescent):
    """Right the last inverted triangles one patch at a time.

    Attributes
    ----------
    tries : int
        Patches to try at most; those of no use yield nothing.
    """

    tries: int = 30

    word: ClassVar[str] = "patches"
    quick: ClassVar[bool] = True

    def __post_init__(self) -> None:
        whole_number("tries", self.tries, least=1)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """As of `Descent`; a map after every patch that left fewer inverted triangles."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        w, tries = start.w, self.tries
        left = inverted_triangles(problem.F, problem.positions(w))
        most = min(MOST_TRIANGLES, int(_MOST_SHARE * len(problem.F)))
        for rings in _RINGS:
            for triangle in left.tolist():
                if not 0 < left.size <= MOST_FLIPS or tries <= 0:
                    return True
                patch = patch_around(problem, triangle, rings, most) if triangle in left else None
                if patch is None:
                    continue
                tries -= 1
                moved = w.copy()
                moved[patch.vertices] = last_untangled(patch, w[patch.vertices], patch.held, 0.0, solver)
                now = inverted_triangles(problem.F, problem.positions(moved))
                if now.size < left.size:
                    w, left = moved, now
                    yield objective.of_map(w)
        return True


def patch_around(problem: Problem, triangle: int, rings: int, most: int) -> Patch | None:
    """Triangles within some rings of one, or None where those are too many or have no vertex that may move."""
    inside = np.zeros(problem.n, dtype=bool)
    inside[problem.F[triangle]] = True
    for _ in range(rings):
        inside[problem.F[inside[problem.F].any(axis=1)]] = True
        # Triangles that hang together have at most two vertices each, and one more: a hub's need not all be seen.
        if np.count_nonzero(inside) > 2 * most + 1:
            return None
    F = problem.F[inside[problem.F].all(axis=1)]
    vertices, renumbered = np.unique(F, return_inverse=True)
    renumbered = renumbered.reshape(-1, 3).astype(np.int64)
    held = np.isin(vertices, problem.fixed)
    held[boundary_edges(renumbered, vertices.size)] = True
    return None if len(F) > most or held.all() else Patch(renumbered, vertices, held)


def remapped(
    objective: Objective,
    w: ComplexArray,
    left: IntArray,
    other: Attempt,
    *,
    patience: int,
    most: int | None = None,
    tries: int | None = None,
    effort: Effort | None = None,
) -> Iterator[Iterate]:
    """Take other maps of patches, one after the other, as long as they leave no more inverted triangles.

    Parameters
    ----------
    objective : Objective
    w : (n,) complex128
        The map to begin with.
    left : (k,) int64
        Its inverted triangles.
    other : callable
        From a map and what is left inverted to a patch and another map (v,) complex128 of it, or None.
    patience : int
        So many in a row may right no triangle.
    most : int, optional
        Inverted triangles at most for it to be worth a try.
    tries : int, optional
        Patches at most.
    effort : Effort, optional
        What ``other`` counts its steps in.

    Yields
    ------
    Iterate
        A map after every patch that left fewer inverted triangles, and the last of them (or else that of ``w``) again
        for every iteration that the tries amount to.
    """
    problem, effort = objective.problem, effort or Effort(len(objective.problem.F))
    first, here = w, None
    in_vain, done = 0, 0
    while left.size and (most is None or left.size <= most) and in_vain < patience and done != tries:
        in_vain, done = in_vain + 1, done + 1
        found = other(w, left)
        if found is not None:
            patch, there = found
            moved = w.copy()
            moved[patch.vertices] = there
            now = inverted_triangles(problem.F, problem.positions(moved))
            if now.size <= left.size:
                fewer, w, left = now.size < left.size, moved, now
                if fewer:
                    in_vain, here = 0, objective.of_map(w)
                    yield here
        for _ in range(effort.due()):
            here = here or objective.of_map(first)
            yield here


def last_untangled(
    patch: Patch,
    w: ComplexArray,
    held: BoolArray,
    grading: float,
    linear_solver: str,
    weights: FloatArray | None = None,
    effort: Effort | None = None,
) -> ComplexArray:
    """Where untangling a map of a patch (v,) complex128 ends, some vertices (v,) bool held, triangles weighed (p,)."""
    last, stay, steps = w, np.flatnonzero(held), 1
    for step in untangled(patch.F, w, stay, grading=grading, linear_solver=linear_solver, weights=weights):
        last = step
        steps += 1
    if effort is not None:
        # To begin takes as long as a step.
        effort.count(len(patch.F), steps)
    return last
