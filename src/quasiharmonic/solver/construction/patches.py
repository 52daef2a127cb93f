"""Construction in patches: where a map has few inverted triangles, only their surroundings are constructed again.

A patch is a connected set of triangles whose boundary the map takes to simple loops. It is a problem of its own with a
simple target, so a construction exists. The rest of the map stays::

    inverted triangles ──▶ rings around them ──▶ connected patches ──▶ simple images? ──▶ constructions
                                ▲                                     │ no
                                └─────── another ring around these ◀──┘
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.coarsening import mark_rings
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.geometry.mesh.topology import group_by_label, label_components
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.solver.construction.constructing import Construction, constructions, is_simple
from quasiharmonic.solver.methods.local_repair import Patch
from quasiharmonic.util.arrays import FloatArray, IntArray, mark


class PatchLimits(NamedTuple):
    """Limits of the patches."""

    # Minimum and maximum number of rings of triangles around an inverted one.
    min_rings: int = 2
    max_rings: int = 100
    # Maximum fractions of the triangles that may be inverted, and that all patches together may contain.
    max_inverted: float = 0.05
    max_share: float = 0.6


_LIMITS = PatchLimits()


class _PatchProblem(NamedTuple):
    """Triangles (p,) of a mesh, the mesh's index of each of their vertices (v,), and the problem that they make."""

    rows: IntArray
    vertices: IntArray
    problem: Problem


def construct_patches(problem: Problem, uv: FloatArray) -> Construction | None:
    """Return a construction that differs from a map (n, 2) only around its inverted triangles.

    Return None if too many triangles are inverted, if there are no suitable patches, or if a construction is not
    certified.
    """
    inverted = inverted_triangles(problem.F, uv)
    if not 0 < inverted.size <= _LIMITS.max_inverted * len(problem.F):
        return None
    patches = _find_patches(problem, uv, inverted)
    if patches is None:
        return None
    F, w, n = problem.F.copy(), uv.copy(), problem.n
    # The added triangles with their parents, and the added vertices with their images, parents and weights.
    added: list[Refined] = []
    images = [w]
    for rows, vertices, patch in patches:
        *_, made = constructions(patch, uv[vertices], patch=True)
        if not made.certificate.bijective:
            return None
        refined, old = made.refined, len(vertices)
        triangles = np.append(vertices, n + np.arange(len(refined.parents)))[refined.F]
        n += len(refined.parents)
        F[rows], w[vertices] = triangles[: len(rows)], made.uv[:old]
        images.append(made.uv[old:])
        parent, parents = rows[refined.parent[len(rows) :]], vertices[refined.parents]
        added.append(Refined(refined.V[old:], triangles[len(rows) :], parent, parents, refined.weights))
    whole = Refined(
        np.concatenate([problem.V, *(one.V for one in added)]),
        np.concatenate([F, *(one.F for one in added)]),
        np.concatenate([np.arange(len(F)), *(one.parent for one in added)]),
        np.concatenate([one.parents for one in added]),
        np.concatenate([one.weights for one in added]),
    )
    image = np.concatenate(images)
    certificate = certify(whole.F, image, loops=problem.domain.loops)
    return Construction(whole, image, certificate, np.empty(0, dtype=np.int64)) if certificate.bijective else None


def _find_patches(problem: Problem, uv: FloatArray, inverted: IntArray) -> list[_PatchProblem] | None:
    """Return patches around the inverted triangles as rows, vertices and problems; None if they are too large."""
    F, n = problem.F, problem.n
    inside = mark_rings(F, mark(n, F[inverted]), _LIMITS.min_rings)
    # A set of triangles grows or stays, so its first triangle and its size identify it.
    known: dict[tuple[int, int], _PatchProblem | None] = {}
    for _ in range(_LIMITS.min_rings, _LIMITS.max_rings):
        rows = np.flatnonzero(inside[F].all(axis=1))
        if rows.size > _LIMITS.max_share * len(F):
            return None
        T = F[rows]
        label = label_components(T[:, :2], T[:, 1:], n)[T[:, 0]]
        found: list[_PatchProblem] = []
        poor = np.zeros(n, dtype=bool)
        for group in group_by_label(label):
            some = rows[group]
            key = int(some[0]), some.size
            if key not in known:
                known[key] = _as_problem(problem, uv, some)
            patch = known[key]
            if patch is None:
                poor[F[some]] = True
            else:
                found.append(patch)
        if not poor.any():
            return found
        inside |= mark_rings(F, poor)
    return None


def _as_problem(problem: Problem, uv: FloatArray, rows: IntArray) -> _PatchProblem | None:
    """Return the problem of some triangles, or None if they are no surface or its target is not simple."""
    patch = Patch.of(problem.F[rows], problem.fixed)
    try:
        domain = Domain(problem.V[patch.vertices], patch.F, np.flatnonzero(patch.fixed))
    except ValueError:
        return None
    own = Problem.on(domain, uv[patch.vertices[domain.fixed]], reference="equilateral")
    return _PatchProblem(rows, patch.vertices, own) if is_simple(own) else None
