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

from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.mesh.splitting import Shares
from quasiharmonic.geometry.mesh.topology import label_components
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.solver.construction.constructing import Construction, constructions, is_simple
from quasiharmonic.solver.construction.thinning import as_refined
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark


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
    F, n = problem.F, problem.n
    inverted = inverted_triangles(F, uv)
    if not 0 < inverted.size <= _LIMITS.max_inverted * len(F):
        return None
    patches = _find_patches(problem, uv, inverted)
    if patches is None:
        return None
    uv, moved, triangles, shares = uv.copy(), [], [], list[Shares]()
    whole = np.ones(len(F), dtype=bool)
    for rows, vertices, patch in patches:
        *_, made = constructions(patch, uv[vertices])
        if not made.certificate.bijective:
            return None
        refined = made.refined
        numbers = np.append(vertices, n + len(shares) + np.arange(len(refined.parents)))
        triangles.append(numbers[refined.F])
        shares += [{int(vertices[old]): share for old, share in row.items()} for row in refined.shares()]
        uv[vertices] = made.uv[: len(vertices)]
        moved.append(made.uv[len(vertices) :])
        whole[rows] = False
    refined = as_refined(problem.V, F, np.concatenate([F[whole], *triangles]), shares)
    uv = np.concatenate([uv, *moved])
    certificate = certify(refined.F, uv, loops=problem.domain.loops)
    return Construction(refined, uv, certificate, np.empty(0, dtype=np.int64)) if certificate.bijective else None


def _find_patches(problem: Problem, uv: FloatArray, inverted: IntArray) -> list[_PatchProblem] | None:
    """Return patches around the inverted triangles as rows, vertices and problems; None if they are too large."""
    F, n = problem.F, problem.n
    inside = mark(n, F[inverted])
    for _ in range(_LIMITS.min_rings):
        inside |= _add_ring(F, inside)
    for _ in range(_LIMITS.min_rings, _LIMITS.max_rings):
        rows = np.flatnonzero(inside[F].all(axis=1))
        if rows.size > _LIMITS.max_share * len(F):
            return None
        T = F[rows]
        label = label_components(T[:, :2], T[:, 1:], n)[T[:, 0]]
        order = np.argsort(label, kind="stable")
        found: list[_PatchProblem] = []
        poor = np.zeros(n, dtype=bool)
        for some in np.split(rows[order], np.flatnonzero(np.diff(label[order])) + 1):
            vertices, corners = np.unique(F[some], return_inverse=True)
            patch = _as_problem(problem, uv, vertices, corners.reshape(-1, 3))
            if patch is None:
                poor[vertices] = True
            else:
                found.append(_PatchProblem(some, vertices, patch))
        if not poor.any():
            return found
        inside |= _add_ring(F, poor)
    return None


def _add_ring(F: IntArray, inside: BoolArray) -> BoolArray:
    """Mark the vertices (n,) of all triangles that have a marked one."""
    return mark(inside.size, F[inside[F].any(axis=1)])


def _as_problem(problem: Problem, uv: FloatArray, vertices: IntArray, F: IntArray) -> Problem | None:
    """Return the problem of a patch, or None if it is no surface or its target is not simple."""
    fixed = mark(problem.n, problem.fixed)[vertices]
    try:
        domain = Domain(problem.V[vertices], F, None)
        fixed[domain.fixed] = True
        domain = Domain(problem.V[vertices], F, np.flatnonzero(fixed))
    except ValueError:
        return None
    patch = Problem.on(domain, uv[vertices[domain.fixed]], reference="equilateral")
    return patch if is_simple(patch) else None
