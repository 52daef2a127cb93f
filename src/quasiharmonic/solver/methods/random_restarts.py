"""Local repair from random starts, for inverted triangles that no descent from a regular start untangles.

A free vertex must lie to the left of every fixed edge with which it forms a triangle, in the intersection of their
half-planes. If the target folds back, the intersection may be a wedge a millionth as wide as long, which begins at the
fold and opens away from it. A vertex on the near side of the fold misses it narrowly, and no descent leads around the
fold.

A patch around an inverted triangle is therefore restarted many times. One kind of start is a quasi-harmonic map of
random tensors. Another moves a vertex of that triangle into its intersection and fixes it while the other vertices
make space. If a chain of vertices must go around the fold, the inverted triangles get more weight (`reweight`). A patch
is accepted if it does not increase the number of inverted triangles, so the map may drift until all triangles fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, TypeAlias

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.coarsening import mark_rings
from quasiharmonic.geometry.curves.arcs import nearest_on_segments
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.solver.methods.base import Iterates, Patience, VertexDescent
from quasiharmonic.solver.methods.local_repair import (
    MAX_INVERTED,
    MAX_TRIANGLES,
    Patch,
    RepairEffort,
    patch_around,
    remap_patches,
    untangle_fully,
)
from quasiharmonic.solver.methods.untangling import GRADINGS, untangle
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray, mark, to_points
from quasiharmonic.util.options import option, positive, positive_or_none

Generator: TypeAlias = np.random.Generator


class RestartTuning(NamedTuple):
    """Numbers that tune the random starts of patches."""

    # Rings around an inverted triangle, and sizes of the random ξ; one of each is drawn.
    rings: tuple[int, ...] = (2, 3, 4, 6, 8, 12)
    spreads: tuple[float, ...] = (0.0, 0.5, 1.5)
    # V₃ over the target's area below which a problem gets more tries. Of ten thousand generated problems, those without
    # a solution end above 1e-4. Those with a solution that needs many tries end below 1e-6.
    promising_energy: float = 1e-5
    # Factor by which such a problem gets more tries.
    more_tries: int = 10
    # Fraction of tries that use weights; these take several times as long as the others.
    reweighted: float = 0.5
    # A moved vertex lies at a fraction of the way from a corner of the intersection to its centre; range of its decimal
    # logarithm.
    depths: tuple[float, float] = (-3.5, 0.0)


_TUNING = RestartTuning()


@dataclass(frozen=True, kw_only=True)
class RandomRestarts(VertexDescent):
    """Untangle the last inverted triangles by solving patches around them from random starts.

    The random numbers come from a generator with a fixed seed. If too many triangles are inverted for local repair, the
    whole mesh is untangled first.

    Attributes
    ----------
    max_failures : int
        Maximum number of consecutive patches without progress; ten times as many if V₃ is almost zero.
    tries : int, optional
        Maximum number of patches.
    """

    max_failures: int = option(30, check=positive)
    tries: int | None = option(None, check=positive_or_none)

    label: ClassVar[str] = "random restarts"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; yields a map after every patch that reduces the number of inverted triangles."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        rng = np.random.default_rng(0)
        w = start.w
        left = inverted_triangles(problem.F, problem.positions(w))
        if left.size > MAX_INVERTED:
            # End untangling of the whole mesh if it makes no progress.
            mesh_patience = Patience((self.max_failures, 0.0))
            mesh_patience.is_over(start.inverted, start.value)
            for w in untangle(problem.F, start.w, problem.fixed, grading=0.0, linear_solver=solver):
                here = objective.of_map(w)
                yield here
                if mesh_patience.is_over(here.inverted, here.value):
                    return True
            left = inverted_triangles(problem.F, problem.positions(w))
        patience, effort = self.max_failures, RepairEffort(len(problem.F))
        if 0 < left.size <= MAX_INVERTED and objective.of_map(w).energy < _TUNING.promising_energy:
            patience *= _TUNING.more_tries

        def attempt(w: ComplexArray, left: IntArray) -> tuple[Patch, ComplexArray] | None:
            effort.count(0)
            patch = patch_around(problem, int(rng.choice(left)), int(rng.choice(_TUNING.rings)), MAX_TRIANGLES)
            if patch is None:
                return None
            try:
                return patch, _restart(rng, problem, patch, w[patch.vertices], solver, effort)
            except NotPositiveDefinite:
                return None

        yield from remap_patches(
            objective, w, left, attempt, patience=patience, max_inverted=MAX_INVERTED, tries=self.tries, effort=effort
        )
        return True


def _restart(
    rng: Generator, problem: Problem, patch: Patch, w: ComplexArray, solver: str, effort: RepairEffort
) -> ComplexArray:
    """Return another map of a patch, found from a random start."""
    if rng.random() < _TUNING.reweighted:
        return reweight(rng, patch, w, solver, effort)
    grading = float(rng.choice(GRADINGS))
    choice = _choose_position(rng, problem, patch, w) if rng.random() < 0.5 else None
    fixed = patch.fixed.copy()
    if choice is not None:
        vertex, there = choice
        w, fixed[vertex] = w.copy(), True
        w[vertex] = there
    w = untangle_fully(patch, _random_map(rng, patch, w, fixed, solver), fixed, grading, solver, None, effort)
    if choice is not None and signed_areas(patch.F, w).min() <= 0:
        w = untangle_fully(patch, w, patch.fixed, grading, solver, None, effort)
    return w


def _random_map(rng: Generator, patch: Patch, w: ComplexArray, fixed: BoolArray, linear_solver: str) -> ComplexArray:
    """Return a quasi-harmonic map of random tensors with the ``fixed`` vertices at their positions in ``w``."""
    xi = rng.choice(_TUNING.spreads) * (rng.standard_normal(len(patch.F)) + 1j * rng.standard_normal(len(patch.F)))
    mesh = ReferenceMesh(np.zeros((len(w), 2)), patch.F, "equilateral")
    laplacian = Laplacian(patch.F, len(w), np.flatnonzero(fixed), linear_solver)
    return laplacian.factor(mesh.edge_stiffness(TANH.field(xi).entries())).extend(w)


def _choose_position(rng: Generator, problem: Problem, patch: Patch, w: ComplexArray) -> tuple[int, complex] | None:
    """Choose a free vertex near an inverted triangle and a random position to the left of its opposite fixed edges.

    None if there is no such vertex or position.
    """
    near = mark(len(w), patch.F[signed_areas(patch.F, w) <= 0])
    if rng.random() < 0.5:
        near = mark_rings(patch.F, near)
    candidates = np.flatnonzero(near & ~patch.fixed)
    if not candidates.size:
        return None
    vertex = int(rng.choice(candidates))
    fixed = np.isin(patch.vertices, problem.fixed)
    t, k = np.nonzero(np.equal(patch.F, vertex))
    tails, heads = patch.F[t, (k + 1) % 3], patch.F[t, (k + 2) % 3]
    both = fixed[tails] & fixed[heads]
    within = w if rng.random() < 0.5 else problem.frame.inward(problem.target)
    low, high = complex(within.real.min(), within.imag.min()), complex(within.real.max(), within.imag.max())
    region = np.array([low, complex(high.real, low.imag), high, complex(low.real, high.imag)])
    for tail, head in zip(w[tails[both]], w[heads[both]], strict=True):
        region = left_of(region, tail, head)
        if len(region) < 3:
            return None
    depth = 10 ** rng.uniform(*_TUNING.depths)
    corner = rng.choice(np.append(region, find_nearest(region, w[vertex])))
    return vertex, complex((1 - depth) * corner + depth * region.mean())


def left_of(region: ComplexArray, tail: complex, head: complex) -> ComplexArray:
    """Return the corners of the part of a convex polygon to the left of a line."""
    side = (np.conj(head - tail) * (region - tail)).imag
    corners = []
    for p, q, s, t in zip(region, np.roll(region, -1), side, np.roll(side, -1), strict=True):
        if s > 0:
            corners.append(p)
        if (s > 0) != (t > 0):
            corners.append(p + (q - p) * (s / (s - t)))
    return np.array(corners, dtype=np.complex128)


def find_nearest(region: ComplexArray, point: complex) -> complex:
    """Return the point of a convex polygon's outline that is nearest to a given point."""
    ahead = np.roll(region, -1)
    share, distance = nearest_on_segments(to_points(np.array([point])), to_points(region), to_points(ahead))
    k = int(np.argmin(distance))
    return complex(region[k] + share[k] * (ahead[k] - region[k]))


class ReweightingTuning(NamedTuple):
    """Numbers that tune the rounds of reweighting."""

    # Possible factors of an inverted triangle's weight per round; one is drawn for all rounds.
    factors: tuple[float, ...] = (3.0, 10.0)
    # Maximum number of rounds.
    rounds: int = 15
    # If a map has this many more inverted triangles than the first, it does not recover, and the rounds end.
    max_extra: int = 15


_REWEIGHTING = ReweightingTuning()


def reweight(
    rng: Generator, patch: Patch, w: ComplexArray, linear_solver: str, effort: RepairEffort | None = None
) -> ComplexArray:
    """Return another map of a patch, found by weighting its inverted triangles.

    Untangling starts with a large ε, for which its energy has hardly more than one minimum. From any start a patch
    therefore ends in one of the same few maps, and another result needs another energy. Triangles that stay inverted
    get more weight in every round, as constraints do in searches for satisfying assignments. They are untangled at the
    expense of others, which gain weight in turn, until all triangles fit.

    It is the first map without inverted triangles, or else the last one with no more of them than ``w`` (v,). ``rng``
    draws the factor and the grading of every round.
    """
    factor = float(rng.choice(_REWEIGHTING.factors))
    weights = np.ones(len(patch.F))
    inverted = signed_areas(patch.F, w) <= 0
    first, last = inverted.sum(), w
    for _ in range(_REWEIGHTING.rounds):
        weights[inverted] *= factor
        w = untangle_fully(patch, w, patch.fixed, float(rng.choice(GRADINGS)), linear_solver, weights, effort)
        inverted = signed_areas(patch.F, w) <= 0
        if inverted.sum() <= first:
            last = w
        if not inverted.any() or inverted.sum() > first + _REWEIGHTING.max_extra:
            break
    return last
