"""Local repair from random starts, for inverted triangles that no descent from a regular start untangles.

A free vertex must lie to the left of every fixed edge with which it forms a triangle, in the intersection of their
half-planes. If the target folds back, the intersection may be a wedge a millionth as wide as long, which begins at the
fold and opens away from it. A vertex on the near side of the fold misses it narrowly, and no descent leads around the
fold.

A patch around an inverted triangle is therefore restarted many times. One kind of start is a quasi-harmonic map of
random tensors. Another moves a vertex of that triangle into its intersection and fixes it while the other vertices
make space. If a chain of vertices must go around the fold, the inverted triangles get more weight
(`quasiharmonic.solver.methods.reweighting`). A patch is accepted if it does not increase the number of inverted
triangles, so the map may drift until all triangles fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.solver.methods.base import Iterates, Patience, VertexDescent
from quasiharmonic.solver.methods.local_repair import (
    MOST_FLIPS,
    MOST_TRIANGLES,
    Effort,
    Patch,
    last_untangled,
    patch_around,
    remapped,
)
from quasiharmonic.solver.methods.reweighting import reweighted
from quasiharmonic.solver.methods.untangling import GRADINGS, untangled
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray, whole_number

Generator: TypeAlias = np.random.Generator

# Rings around an inverted triangle, and sizes of the random ξ; one of each is drawn.
_RINGS = 2, 3, 4, 6, 8, 12
_SPREADS = 0.0, 0.5, 1.5
# V₃ over the target's area below which a problem gets more tries, and their factor. Of ten thousand generated problems,
# those without a solution end above 1e-4. Those with a solution that needs many tries end below 1e-6.
_NEXT_TO_NOTHING, _DILIGENCE = 1e-5, 10
# Fraction of tries that use weights; these take several times as long as the others.
_REWEIGHTED = 0.5
# A moved vertex lies at a fraction of the way from a corner of the intersection to its centre; range of its decimal
# logarithm.
_DEPTHS = -3.5, 0.0


@dataclass(frozen=True, kw_only=True)
class RandomRestarts(VertexDescent):
    """Untangle the last inverted triangles by solving patches around them from random starts.

    The random numbers come from a generator with a fixed seed. If too many triangles are inverted for local repair, the
    whole mesh is untangled first.

    Attributes
    ----------
    in_vain : int
        Maximum number of consecutive patches without progress; ten times as many if V₃ is almost zero.
    tries : int, optional
        Maximum number of patches.
    """

    in_vain: int = 30
    tries: int | None = None

    word: ClassVar[str] = "random restarts"

    def __post_init__(self) -> None:
        whole_number("in_vain", self.in_vain, least=1)
        if self.tries is not None:
            whole_number("tries", self.tries, least=1)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; yields a map after every patch that reduces the number of inverted triangles."""
        problem, solver = objective.problem, objective.laplacian.solver.name
        rng = np.random.default_rng(0)
        w = start.w
        left = inverted_triangles(problem.F, problem.positions(w))
        if left.size > MOST_FLIPS:
            # End untangling of the whole mesh if it makes no progress.
            whole = Patience((self.in_vain, 0.0))
            whole.is_over(start.inverted, start.value)
            for w in untangled(problem.F, start.w, problem.fixed, grading=0.0, linear_solver=solver):
                here = objective.of_map(w)
                yield here
                if whole.is_over(here.inverted, here.value):
                    return True
            left = inverted_triangles(problem.F, problem.positions(w))
        patience, effort = self.in_vain, Effort(len(problem.F))
        if 0 < left.size <= MOST_FLIPS and objective.of_map(w).energy < _NEXT_TO_NOTHING:
            patience *= _DILIGENCE

        def other(w: ComplexArray, left: IntArray) -> tuple[Patch, ComplexArray] | None:
            effort.count(0)
            patch = patch_around(problem, int(rng.choice(left)), int(rng.choice(_RINGS)), MOST_TRIANGLES)
            if patch is None:
                return None
            try:
                return patch, _restarted(rng, problem, patch, w[patch.vertices], solver, effort)
            except NotPositiveDefinite:
                return None

        yield from remapped(
            objective, w, left, other, patience=patience, most=MOST_FLIPS, tries=self.tries, effort=effort
        )
        return True


def _restarted(
    rng: Generator, problem: Problem, patch: Patch, w: ComplexArray, solver: str, effort: Effort
) -> ComplexArray:
    """Return another map of a patch, found from a random start."""
    if rng.random() < _REWEIGHTED:
        return reweighted(rng, patch, w, solver, effort)
    grading = float(rng.choice(GRADINGS))
    place = _place(rng, problem, patch, w) if rng.random() < 0.5 else None
    held = patch.held.copy()
    if place is not None:
        vertex, there = place
        w, held[vertex] = w.copy(), True
        w[vertex] = there
    w = last_untangled(patch, _random_map(rng, patch, w, held, solver), held, grading, solver, None, effort)
    if place is not None and signed_areas(patch.F, w).min() <= 0:
        w = last_untangled(patch, w, patch.held, grading, solver, None, effort)
    return w


def _random_map(rng: Generator, patch: Patch, w: ComplexArray, held: BoolArray, linear_solver: str) -> ComplexArray:
    """Return a quasi-harmonic map of random tensors with the ``held`` vertices at their positions in ``w``."""
    xi = rng.choice(_SPREADS) * (rng.standard_normal(len(patch.F)) + 1j * rng.standard_normal(len(patch.F)))
    mesh = ReferenceMesh(np.zeros((len(w), 2)), patch.F, "equilateral")
    laplacian = Laplacian(patch.F, len(w), np.flatnonzero(held), linear_solver)
    return laplacian.factor(mesh.edge_stiffness(TANH.field(xi).entries())).extend(w)


def _place(rng: Generator, problem: Problem, patch: Patch, w: ComplexArray) -> tuple[int, complex] | None:
    """Choose a free vertex near an inverted triangle and a random position to the left of its opposite fixed edges.

    None if there is no such vertex or position.
    """
    near = np.zeros(len(w), dtype=bool)
    near[patch.F[signed_areas(patch.F, w) <= 0]] = True
    if rng.random() < 0.5:
        near[patch.F[near[patch.F].any(axis=1)]] = True
    candidates = np.flatnonzero(near & ~patch.held)
    if not candidates.size:
        return None
    vertex = int(rng.choice(candidates))
    fixed = np.isin(patch.vertices, problem.fixed)
    t, k = np.nonzero(np.equal(patch.F, vertex))
    tails, heads = patch.F[t, (k + 1) % 3], patch.F[t, (k + 2) % 3]
    both = fixed[tails] & fixed[heads]
    within = w if rng.random() < 0.5 else problem.frame.inward(problem.target)
    low, high = complex(within.real.min(), within.imag.min()), complex(within.real.max(), within.imag.max())
    area = np.array([low, complex(high.real, low.imag), high, complex(low.real, high.imag)])
    for tail, head in zip(w[tails[both]], w[heads[both]], strict=True):
        area = left_of(area, tail, head)
        if len(area) < 3:
            return None
    depth = 10 ** rng.uniform(*_DEPTHS)
    corner = rng.choice(np.append(area, nearest(area, w[vertex])))
    return vertex, complex((1 - depth) * corner + depth * area.mean())


def left_of(area: ComplexArray, tail: complex, head: complex) -> ComplexArray:
    """Return the corners of the part of a convex polygon to the left of a line."""
    side = (np.conj(head - tail) * (area - tail)).imag
    kept = []
    for p, q, s, t in zip(area, np.roll(area, -1), side, np.roll(side, -1), strict=True):
        if s > 0:
            kept.append(p)
        if (s > 0) != (t > 0):
            kept.append(p + (q - p) * (s / (s - t)))
    return np.array(kept, dtype=np.complex128)


def nearest(area: ComplexArray, point: complex) -> complex:
    """Return the point of a convex polygon's outline that is nearest to a given point."""
    side = np.roll(area, -1) - area
    square = np.maximum(np.abs(side) ** 2, np.finfo(np.float64).tiny)
    along = np.clip((np.conj(side) * (point - area)).real / square, 0, 1)
    on = area + along * side
    return complex(on[np.argmin(np.abs(on - point))])
