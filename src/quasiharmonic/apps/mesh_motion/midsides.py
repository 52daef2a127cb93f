"""Positions of the mid-side nodes of six-node triangles: they follow their sides, or move aside for valid elements.

An element is valid if its Jacobian determinant is positive everywhere. That is certain if its control values, the
coefficients of the determinant in the Bernstein basis, are positive.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.mesh.elements import FORMS, MIDDLES, SIDES, jacobian_coefficients
from quasiharmonic.util.arrays import FloatArray, IntArray, invert_indices, to_complex, to_points


class MidsideTuning(NamedTuple):
    """Numbers that tune the tries for mid-side nodes."""

    # Required least control value of every element with a movable node, relative to that of the triangle of its
    # corners.
    margin: float = 0.1
    # Weight of displacements in the first try, and its factor from each try to the next.
    displacement_weight: float = 1e-2
    weight_factor: float = 0.1
    max_tries: int = 8
    # Steps per try.
    steps: int = 30
    # Lengths tried per step: the full step, then half of the previous length each time.
    step_lengths: int = 6
    # Attempts in order. First value: rings of elements around inverted ones whose nodes move; None moves only mid-side
    # nodes of inverted elements. Second value: initial positions, as a fraction of the way from ``straight`` to
    # ``searched``. Further attempts start from the best result.
    attempts: tuple[tuple[int | None, float], ...] = (None, 0.0), (0, 0.0), (1, 0.0), (3, 0.0), (3, 0.5), (3, 1.0)
    further: tuple[int, ...] = (1, 2, 4, 8)


_TUNING = MidsideTuning()


def find_sides(F: IntArray) -> tuple[IntArray, IntArray]:
    """Return the mid-side nodes of six-node triangles (f, 6), (s,) ascending, and the ends of their sides, (s, 2)."""
    middle, first = np.unique(F[:, MIDDLES], return_index=True)
    return middle, F[:, SIDES].reshape(-1, 2)[first]


def follow_sides(before: FloatArray, after: FloatArray, middle: IntArray, ends: IntArray) -> FloatArray:
    """Return positions of mid-side nodes that follow their sides with the same rotation and scaling; (s, 2) float64.

    Nodes of straight sides keep their relative position. If both ends are unchanged, the node is exactly unchanged.
    """
    z, w = (to_complex(points) for points in (before, after))
    (a, b), (p, q) = z[ends].T, w[ends].T
    ratio = np.divide(q - p, b - a, out=np.zeros_like(a), where=a != b)
    place = 0.5 * (p + q) + ratio * (z[middle] - 0.5 * (a + b))
    place = np.where((a == p) & (b == q), z[middle], place)
    return to_points(place)


def restore_midsides(F: IntArray, rest: FloatArray, points: FloatArray, fixed: IntArray) -> FloatArray:
    """Move the free mid-side nodes to their relative position on their sides at rest; (n, 2) float64.

    ``rest`` and ``points`` (n, 2) are the rest mesh and the current mesh.
    """
    middle, ends = find_sides(F)
    free = ~np.isin(middle, fixed)
    there = points.copy()
    there[middle[free]] = follow_sides(rest, points, middle[free], ends[free])
    return there


def centre_midsides(F: IntArray, points: FloatArray, slid: IntArray, curves: Sequence[Curve]) -> FloatArray:
    """Move mid-side nodes that have slid along curves to the middle of their sides; (n, 2) float64.

    A mid-side node outside the middle half of a straight side inverts its element, whatever the other nodes. ``slid``
    (k,) are nodes that have slid, of which only mid-side nodes are used. Each node stays on its nearest curve.
    """
    middle, ends = find_sides(F)
    of = np.isin(middle, slid)
    nodes, half = middle[of], points[ends[of]].mean(axis=1)
    own = np.argmin([curve.nearest(points[nodes])[1] for curve in curves], axis=0)
    there = points.copy()
    for k, curve in enumerate(curves):
        there[nodes[own == k]] = curve.position(curve.nearest(half[own == k])[0])
    return there


def untangle_elements(F: IntArray, straight: FloatArray, searched: FloatArray, fixed: IntArray) -> FloatArray:
    """Move nodes around inverted elements as little as possible until no element is inverted; (n, 2) float64.

    In ``straight`` (n, 2) the mid-side nodes are at their preferred positions, and in ``searched`` (n, 2) at other,
    perhaps better ones. Some elements of the result may still be inverted.
    """
    best, bad = straight, inverted_elements(F, straight)
    for rings, share in (*_TUNING.attempts, *((rings, None) for rings in _TUNING.further)):
        if not bad.size:
            break
        if share and searched is straight:
            continue
        begin = best if share is None else straight + share * (searched - straight)
        found = _untangle_near(F, begin, rings, fixed)
        left = inverted_elements(F, found)
        if left.size < bad.size:
            best, bad = found, left
    return best


def _untangle_near(F: IntArray, points: FloatArray, rings: int | None, fixed: IntArray) -> FloatArray:
    """Move nodes within ``rings`` rings around inverted elements, or only the mid-side nodes of these if it is None."""
    near = inverted_elements(F, points)
    for _ in range(rings or 0):
        near = np.flatnonzero(np.isin(F[:, :3], F[near, :3]).any(axis=1))
    movable = F[near][:, MIDDLES] if rings is None else F[near]
    return _move_nodes(F, points, np.setdiff1d(movable, fixed))


def _move_nodes(F: IntArray, points: FloatArray, free: IntArray) -> FloatArray:
    """Move nodes as little as possible so that control values become positive.

    Minimise ``μ Σ |xᵢ − x̂ᵢ|²/h² + Σ max(0, margin − cᵢⱼ/c₀)²`` with initial positions x̂ by Levenberg–Marquardt steps
    with falling μ.
    """
    if not free.size:
        return points
    near = F[np.isin(F, free).any(axis=1)]
    objective = _Displacement(near, points, free)
    now = points.copy()
    weight = _TUNING.displacement_weight
    for _ in range(_TUNING.max_tries):
        for _ in range(_TUNING.steps):
            step = objective.find_step(now, weight)
            if step is None:
                break
            now = now.copy()
            now[free] += step
        if not inverted_elements(near, now).size:
            break
        weight *= _TUNING.weight_factor
    return now


def _chords(F: IntArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coordinates of the nodes as if all sides were straight, relative to the first node."""
    corners = points[F[:, :3]] - points[F[:, :1]]
    nodes = np.concatenate([corners, 0.5 * corners[:, SIDES].sum(axis=2)], axis=1)
    return nodes[..., 0], nodes[..., 1]


class _Displacement:
    """The weighted displacement of the nodes ``free`` (k,) from ``first`` (n, 2), and what control values lack."""

    def __init__(self, F: IntArray, first: FloatArray, free: IntArray) -> None:
        self._F, self._first, self._free = F, first, free
        unit = np.abs(jacobian_coefficients(*_chords(F, first))[:, 0])
        mean = unit.mean() or 1.0
        # Elements whose corners coincide or are collinear are compared with the mean.
        self._unit = np.where(unit > 0, unit, mean)
        self._size = np.sqrt(mean)
        self._number = invert_indices(len(first), free)

    def _find_displacement(self, now: FloatArray) -> FloatArray:
        """Return the displacements (k, 2) of the free nodes, relative to the size of elements."""
        return np.asarray((now[self._free] - self._first[self._free]) / self._size)

    def _find_deficits(self, now: FloatArray) -> FloatArray:
        """Return how far control values are below the margin; (f, 6)."""
        x, y = (now[self._F] - now[self._F[:, :1]]).transpose(2, 0, 1)
        return np.maximum(_TUNING.margin - jacobian_coefficients(x, y) / self._unit[:, None], 0.0)

    def _value(self, now: FloatArray, weight: float) -> float:
        return float(weight * (self._find_displacement(now) ** 2).sum() + (self._find_deficits(now) ** 2).sum())

    def find_step(self, now: FloatArray, weight: float) -> FloatArray | None:
        """Return one Levenberg–Marquardt step (k, 2), or None if no step lowers the objective."""
        from scipy.sparse import csr_array, dia_array
        from scipy.sparse.linalg import splu

        number, unknowns = self._number, 2 * self._free.size
        deficits = self._find_deficits(now)
        element, which = np.nonzero(deficits)
        if not element.size:
            return None
        nodes = self._F[element]
        x, y = (now[nodes] - now[nodes[:, :1]]).transpose(2, 0, 1)
        forms = FORMS[which].astype(np.float64)
        scale = self._size / self._unit[element][:, None]
        by_nodes = np.einsum("mab,mb->ma", forms, y), -np.einsum("mab,mb->ma", forms, x)
        slopes = np.stack(by_nodes, axis=2) * scale[..., None]
        column = 2 * number[nodes][..., None] + np.array([0, 1])
        row = np.broadcast_to(np.arange(len(element))[:, None, None], column.shape)
        known = np.broadcast_to(number[nodes][..., None] >= 0, column.shape)
        jacobian = csr_array((slopes[known], (row[known], column[known])), shape=(len(element), unknowns))
        load = jacobian.T @ deficits[element, which] - weight * self._find_displacement(now).ravel()
        matrix = jacobian.T @ jacobian + dia_array((np.full((1, unknowns), weight), [0]), shape=(unknowns, unknowns))
        try:
            direction = splu(matrix.tocsc()).solve(load).reshape(-1, 2)
        except RuntimeError:  # singular: in very bad elements the weight is lost to rounding
            return None
        there, before = now.copy(), self._value(now, weight)
        for halving in range(_TUNING.step_lengths):
            step = 0.5**halving * self._size * direction
            there[self._free] = now[self._free] + step
            if self._value(there, weight) < before:
                return np.asarray(step)
        return None
