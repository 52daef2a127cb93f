"""Simple reasons why no valid tetrahedral mesh with some fixed vertices exists, each verified exactly."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np

from quasiharmonic.apps.tetrahedra.contacts import edges_meeting_triangles
from quasiharmonic.apps.tetrahedra.elements import FACES, SignArray, find_mesh_edges
from quasiharmonic.apps.tetrahedra.result import TetrahedraObstruction
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# Maximum number of obstructions of each kind.
_MAX_LISTED = 20

_Vector = list[Fraction]


def find_obstructions(
    T: IntArray, X: FloatArray, fixed: BoolArray, boundary: IntArray | None, sign: SignArray
) -> tuple[TetrahedraObstruction, ...]:
    """Find obstructions to a valid mesh with the fixed vertices at their positions in ``X``.

    ``boundary`` (b, 3) are the boundary triangles if all their vertices are fixed and they do not cross, otherwise
    None. ``sign`` (t,) are the orientations at ``X``, which limit where to look for a free vertex without a position.
    """
    whole = np.flatnonzero(fixed[T].all(axis=1) & (sign <= 0))[:_MAX_LISTED]
    found = [
        TetrahedraObstruction(
            f"Tetrahedron {k} is {'inverted' if sign[k] < 0 else 'degenerate'}, and its four vertices are fixed.",
            tuple(T[k].tolist()),
        )
        for k in whole.tolist()
    ]
    if boundary is not None:
        edges = find_mesh_edges(T)
        sides = np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        n = len(X)
        inner = fixed[edges].all(axis=1) & ~np.isin(edges[:, 0] * n + edges[:, 1], sides[:, 0] * n + sides[:, 1])
        edges = edges[inner]
        for edge, triangle in edges_meeting_triangles(edges, boundary, X)[:_MAX_LISTED]:
            a, b = edges[edge].tolist()
            found.append(
                TetrahedraObstruction(
                    f"The inner edge {a}–{b} between fixed vertices meets the boundary triangle "
                    f"{tuple(boundary[triangle].tolist())}.",
                    (a, b),
                )
            )
    bad = T[sign <= 0]
    for vertex in np.unique(bad[~fixed[bad]])[: 50 * _MAX_LISTED].tolist():
        if len(found) >= 3 * _MAX_LISTED:
            break
        reason = _find_empty_kernel(T[(vertex == T).any(axis=1)], X, fixed, vertex)
        if reason is not None:
            found.append(reason)
    return tuple(found)


def _find_empty_kernel(T: IntArray, X: FloatArray, fixed: BoolArray, vertex: int) -> TetrahedraObstruction | None:
    """Decide whether a free vertex has no position for which all its tetrahedra with three fixed vertices are positive.

    By Helly's theorem, open half-spaces have no common point if and only if four of them have none. A linear programme
    in floating point finds candidates, and rational numbers decide.
    """
    from scipy.optimize import linprog

    T = T[(fixed[T] | (vertex == T)).all(axis=1)]
    if len(T) < 2:
        return None
    planes = [_half_space(X[row], row.tolist().index(vertex)) for row in T]
    unit = []
    for normal, offset in planes:
        longest = max(map(abs, normal))
        if not longest:
            return TetrahedraObstruction(f"A face opposite free vertex {vertex} is degenerate.", (vertex,))
        unit.append([float(x / longest) for x in (*normal, offset)])
    A = np.array(unit)
    # Largest s with normal · x − s |normal| ≥ offset.
    length = np.linalg.norm(A[:, :3], axis=1)
    size = float(np.abs(A[:, 3]).max()) or 1.0
    b = A[:, 3] / size
    solution = linprog([0, 0, 0, -1], np.column_stack([-A[:, :3], length]), -b, bounds=[(None, None)] * 3 + [(None, 1)])
    if solution.status != 0 or solution.x[3] > 1e-9:
        return None
    weights = -np.asarray(solution.ineqlin.marginals)
    active = np.argsort(-weights)[:8]
    for count in (2, 3, 4):
        for some in combinations(active.tolist(), min(count, len(active))):
            if _has_no_common_point([planes[k] for k in some]):
                faces = ", ".join(str(tuple(v for v in T[k].tolist() if v != vertex)) for k in some)
                return TetrahedraObstruction(
                    f"Free vertex {vertex} has no position on the inner side of the fixed faces {faces}.", (vertex,)
                )
    return None


def _half_space(points: FloatArray, corner: int) -> tuple[_Vector, Fraction]:
    """The open half-space ``normal · x > offset`` in which a corner of a tetrahedron (4, 3) makes it positive."""
    a, b, c = ([Fraction(value) for value in point] for point in points[FACES[corner]].tolist())
    u, v = ([y - x for x, y in zip(a, end, strict=True)] for end in (b, c))
    # The face is counterclockwise seen from outside, so its normal is turned inwards.
    normal = [-(u[1] * v[2] - u[2] * v[1]), -(u[2] * v[0] - u[0] * v[2]), -(u[0] * v[1] - u[1] * v[0])]
    return normal, sum((x * y for x, y in zip(normal, a, strict=True)), Fraction(0))


def _has_no_common_point(planes: list[tuple[_Vector, Fraction]]) -> bool:
    """Return whether open half-spaces have no common point.

    This holds if weights y ≥ 0 with Σ y normal = 0 and Σ y offset ≥ 0 exist (Farkas). Only weights that are unique up
    to a factor are considered.
    """
    weights = _null_vector([normal for normal, _ in planes])
    if weights is None:
        return False
    if all(y <= 0 for y in weights):
        weights = [-y for y in weights]
    if any(y < 0 for y in weights):
        return False
    return sum((y * offset for y, (_, offset) in zip(weights, planes, strict=True)), Fraction(0)) >= 0


def _null_vector(normals: list[_Vector]) -> list[Fraction] | None:
    """The weights y, unique up to a factor, with Σ y normal = 0; None if there are none or several."""
    m = len(normals)
    rows = [[normals[k][axis] for k in range(m)] for axis in range(3)]
    pivots: list[int] = []
    for column in range(m):
        rank = len(pivots)
        pivot = next((i for i in range(rank, 3) if rows[i][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        rows[rank] = [x / rows[rank][column] for x in rows[rank]]
        for i in range(3):
            if i != rank and rows[i][column]:
                rows[i] = [x - rows[i][column] * y for x, y in zip(rows[i], rows[rank], strict=True)]
        pivots.append(column)
    free = [column for column in range(m) if column not in pivots]
    if len(free) != 1:
        return None
    weights = [Fraction(0)] * m
    weights[free[0]] = Fraction(1)
    for i, column in enumerate(pivots):
        weights[column] = -rows[i][free[0]]
    return weights
