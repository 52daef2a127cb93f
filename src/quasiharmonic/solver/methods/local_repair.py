"""Local repair: solve only a patch around the last inverted triangles again.

At the end of a search typically one or two triangles at the boundary are inverted, with a millionth of a triangle's
area available. All vertices outside a few rings around them are fixed, and the interior is untangled
(`quasiharmonic.solver.methods.untangling`). If a patch fails, a larger one is tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from quasiharmonic.geometry.coarsening import mark_rings
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates, VertexDescent
from quasiharmonic.solver.methods.untangling import untangle
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, mark
from quasiharmonic.util.options import option, positive

# Maximum number of inverted triangles for which local repair begins.
MAX_INVERTED = 50
# Maximum number of triangles of a patch,
MAX_TRIANGLES = 1000


class RepairTuning(NamedTuple):
    """Numbers that tune patches and the count of their cost."""

    # Maximum size of a patch as a fraction of the mesh: above it, untangling the whole mesh is as fast.
    max_share: float = 0.25
    # Rings of triangles around an inverted one, tried in this order.
    rings: tuple[int, ...] = (2, 4, 8, 16)
    # Rings around an inverted triangle in a wide patch.
    wide_rings: int = 24
    # Maximum number of triangles of a wide patch.
    max_wide: int = 5000
    # Maximum size of a wide patch as a fraction of the mesh.
    max_wide_share: float = 0.5
    # The grading of untangling that solves most wide patches.
    wide_grading: float = 0.5
    # Overhead of a step on a patch, as an equivalent number of triangles.
    step_overhead: int = 400
    # Overhead of an iteration on a mesh, as an equivalent number of triangles.
    iteration_overhead: int = 200
    # Maximum mesh size in the cost of an iteration, because patches do not grow with the mesh.
    large: int = 4 * MAX_TRIANGLES


_TUNING = RepairTuning()


class Patch(NamedTuple):
    """Some triangles of a mesh, with their own vertex indices.

    Attributes
    ----------
    F : (p, 3) int64
        The triangles.
    vertices : (v,) int64
        The mesh's index of each vertex.
    fixed : (v,) bool
        Fixed vertices: those of the problem and those on the patch's boundary.
    """

    F: IntArray
    vertices: IntArray
    fixed: BoolArray

    @classmethod
    def of(cls, F: IntArray, fixed: IntArray) -> Patch:
        """Return the patch of triangles (p, 3) of a mesh with these fixed vertices."""
        vertices, renumbered = np.unique(F, return_inverse=True)
        renumbered = renumbered.reshape(-1, 3).astype(np.int64)
        stays = np.isin(vertices, fixed)
        stays[boundary_edges(renumbered, vertices.size)] = True
        return cls(renumbered, vertices, stays)


class RepairEffort:
    """Cost of patch repairs, in units of iterations on the whole mesh with this number of triangles.

    The cost is counted in steps and triangles and not in seconds, so that a search is reproducible.
    """

    def __init__(self, triangles: int) -> None:
        self._iteration = min(triangles, _TUNING.large) + _TUNING.iteration_overhead
        self._spent = 0.0

    def count(self, triangles: int, steps: int = 1) -> None:
        """Add the cost of steps on a patch with this number of triangles."""
        self._spent += steps * (triangles + _TUNING.step_overhead) / self._iteration

    def take_iterations(self) -> int:
        """Return the full iterations spent since the last call."""
        iterations = int(self._spent)
        self._spent -= iterations
        return iterations


#: Function from a map and its inverted triangles to a patch and another map of it.
Attempt: TypeAlias = Callable[[ComplexArray, IntArray], tuple[Patch, ComplexArray] | None]


@dataclass(frozen=True, kw_only=True)
class LocalRepair(VertexDescent):
    """Untangle the last inverted triangles one patch at a time.

    Attributes
    ----------
    tries : int
        Maximum number of patches; failed ones yield nothing.
    """

    tries: int = option(30, check=positive)

    label: ClassVar[str] = "local repair"
    quick: ClassVar[bool] = True

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; yields a map after every patch that reduces the number of inverted triangles."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        w, tries = start.w, self.tries
        left = inverted_triangles(problem.F, problem.positions(w))
        max_triangles = min(MAX_TRIANGLES, int(_TUNING.max_share * len(problem.F)))
        for rings in _TUNING.rings:
            for triangle in left.tolist():
                if not 0 < left.size <= MAX_INVERTED or tries <= 0:
                    return True
                patch = patch_around(problem, triangle, rings, max_triangles) if triangle in left else None
                if patch is None:
                    continue
                tries -= 1
                moved, remaining = _untangle_patch(problem, w, patch, 0.0, solver)
                if remaining.size < left.size:
                    w, left = moved, remaining
                    yield objective.of_map(w)
        return True


@dataclass(frozen=True, kw_only=True)
class WideRepair(VertexDescent):
    """Untangle a wide patch around the inverted triangles that local repair leaves.

    It runs before the whole mesh is untangled.

    Attributes
    ----------
    tries : int
        Maximum number of patches.
    """

    tries: int = option(2, check=positive)

    label: ClassVar[str] = "wide patches"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """Yield a map after every patch that leaves fewer inverted triangles."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        w, left = start.w, inverted_triangles(problem.F, problem.positions(start.w))
        max_triangles = min(_TUNING.max_wide, int(_TUNING.max_wide_share * len(problem.F)))
        tried = np.zeros(len(problem.F), dtype=bool)
        for _ in range(self.tries):
            untried = left[~tried[left]]
            if left.size > MAX_INVERTED or not untried.size:
                return True
            patch = patch_around(problem, int(untried[0]), _TUNING.wide_rings, max_triangles)
            tried[untried[0]] = True
            if patch is None:
                continue
            tried |= np.isin(problem.F, patch.vertices).all(axis=1)
            moved, remaining = _untangle_patch(problem, w, patch, _TUNING.wide_grading, solver)
            if remaining.size < left.size:
                w, left = moved, remaining
                yield objective.of_map(w)
        return True


def _untangle_patch(
    problem: Problem, w: ComplexArray, patch: Patch, grading: float, solver: str
) -> tuple[ComplexArray, IntArray]:
    """Return the map with one patch untangled, and the triangles that are then inverted."""
    moved = w.copy()
    moved[patch.vertices] = untangle_fully(patch, w[patch.vertices], patch.fixed, grading, solver)
    return moved, inverted_triangles(problem.F, problem.positions(moved))


def patch_around(problem: Problem, triangle: int, rings: int, max_triangles: int) -> Patch | None:
    """Return the triangles within some rings of one; None if they are too many or have no free vertex."""
    inside = mark(problem.n, problem.F[triangle])
    for _ in range(rings):
        inside = mark_rings(problem.F, inside)
        # Connected triangles have at most two vertices each, plus one; this bound avoids visiting all triangles at a
        # hub.
        if np.count_nonzero(inside) > 2 * max_triangles + 1:
            return None
    F = problem.F[inside[problem.F].all(axis=1)]
    patch = Patch.of(F, problem.fixed)
    return None if len(F) > max_triangles or patch.fixed.all() else patch


def remap_patches(
    objective: Objective,
    w: ComplexArray,
    left: IntArray,
    attempt: Attempt,
    *,
    patience: int,
    max_inverted: int | None = None,
    tries: int | None = None,
    effort: RepairEffort | None = None,
) -> Iterator[Iterate]:
    """Accept other maps of patches, one after another, if they do not increase the number of inverted triangles.

    Parameters
    ----------
    objective : Objective
    w : (n,) complex128
        Initial map.
    left : (k,) int64
        Its inverted triangles.
    attempt : callable
        Function from a map and its inverted triangles to a patch and another map (v,) complex128 of it, or None.
    patience : int
        Maximum number of consecutive patches that untangle no triangle.
    max_inverted : int, optional
        Maximum number of inverted triangles.
    tries : int, optional
        Maximum number of patches.
    effort : RepairEffort, optional
        Cost account of ``attempt``.

    Yields
    ------
    Iterate
        A map after every patch that reduces the number of inverted triangles. The last such map (or that of ``w``) is
        yielded again for every iteration that the cost amounts to.
    """
    problem, effort = objective.problem, effort or RepairEffort(len(objective.problem.F))
    first, here = w, None
    failures, done = 0, 0
    while left.size and (max_inverted is None or left.size <= max_inverted) and failures < patience and done != tries:
        failures, done = failures + 1, done + 1
        found = attempt(w, left)
        if found is not None:
            patch, there = found
            moved = w.copy()
            moved[patch.vertices] = there
            remaining = inverted_triangles(problem.F, problem.positions(moved))
            if remaining.size <= left.size:
                fewer, w, left = remaining.size < left.size, moved, remaining
                if fewer:
                    failures, here = 0, objective.of_map(w)
                    yield here
        for _ in range(effort.take_iterations()):
            here = here or objective.of_map(first)
            yield here


def untangle_fully(
    patch: Patch,
    w: ComplexArray,
    fixed: BoolArray,
    grading: float,
    linear_solver: str,
    weights: FloatArray | None = None,
    effort: RepairEffort | None = None,
) -> ComplexArray:
    """Untangle a map of a patch (v,) complex128 with fixed vertices (v,) bool and weights (p,); return the last map."""
    last, steps = w, 1
    for step in untangle(
        patch.F, w, np.flatnonzero(fixed), grading=grading, linear_solver=linear_solver, weights=weights
    ):
        last = step
        steps += 1
    if effort is not None:
        # The setup costs as much as a step.
        effort.count(len(patch.F), steps)
    return last
