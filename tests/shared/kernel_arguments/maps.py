"""Arguments of kernels for maps: derivatives, energies, tensors and linear systems."""

from __future__ import annotations

from typing import Any

import numpy as np

from quasiharmonic.surfaces import disk
from shared.kernel_arguments.registry import Arguments, arguments_of, field_on, numbers, soup


@arguments_of("wirtinger")
def _(rng):
    V, F = disk(4)
    f = len(F)
    return numbers(rng, len(V)), F, numbers(rng, 2, f), numbers(rng, f), numbers(rng, f), np.empty(f)


@arguments_of("wirtinger")
def _(rng):
    """Constant gradients, and a subset of the triangles."""
    V, F = disk(4)
    gamma = np.broadcast_to(numbers(rng, 2, 1), (2, len(F)))[:, 5:40]
    return numbers(rng, len(V)), F[5:40], gamma, numbers(rng, 35), numbers(rng, 35), np.empty(35)


def pattern_of(F: Any, place: Any) -> Arguments:
    """Arguments with output arrays of the maximum size of a pattern."""
    size, halves = int(place.max(initial=-1)) + 1, F.size
    lengths = size + 1, size + halves, halves, halves, halves, halves + 1, halves, halves, halves
    kinds = np.int32, np.int32, np.int64, np.int64, np.int32, np.int32, np.int64, np.int64, np.int64
    return F, place, *(np.zeros(k, dtype=kind) for k, kind in zip(lengths, kinds, strict=True)), np.zeros(3, np.int64)


@arguments_of("find_pattern")
def _(rng):
    """A mesh with fixed vertices, and unknowns in random order."""
    V, F = disk(4)
    free = rng.permutation(len(V))[: len(V) - 20]
    place = np.full(len(V), -1, dtype=np.int32)
    place[free] = np.arange(free.size)
    return pattern_of(F, place)


@arguments_of("find_pattern")
def _(rng):
    """Edges shared by many triangles, among few vertices; about half of the vertices are fixed."""
    place = rng.permutation([-1, -1, -1, -1, 0, 1, 2, 3, 4]).astype(np.int32)
    return pattern_of(soup(rng, 9, 200), place)


@arguments_of("find_pattern")
def _(rng):
    """All vertices fixed, with triangles or without."""
    return pattern_of(soup(rng, 9, rng.integers(2) * 20), np.full(9, -1, dtype=np.int32))


def gradients(rng, f: int) -> Any:
    """Gradients of the hat functions of triangles (3, f), which sum to nearly zero."""
    g = numbers(rng, 3, f)
    g[0] = -g[1] - g[2]
    return g


@arguments_of("jacobians")
def _(rng):
    """Triangles with repeated corners, whose areas are rounding errors; and a NaN position."""
    n, f = 30, 1 + rng.integers(400)
    F = soup(rng, n, f)
    F[::5, 2] = F[::5, 1]
    w = numbers(rng, n)
    w[3] = np.nan
    return w, F, gradients(rng, f), rng.uniform(1, 2, f), numbers(rng, f), numbers(rng, f), np.zeros(f)


@arguments_of("pulls")
def _(rng):
    """Vertices without triangles, and triangles with zero weight."""
    n, f = 40, rng.integers(300)
    share = rng.uniform(0, 1, f) * rng.integers(2, size=f)
    return numbers(rng, f), numbers(rng, f), share, soup(rng, n - 5, f), gradients(rng, f), numbers(rng, n)


@arguments_of("collapses")
def _(rng):
    """Steps of many lengths, zero at some vertices, overflow at one; positive, inverted and degenerate triangles."""
    n, f = 60, rng.integers(400)
    step = numbers(rng, n) * rng.integers(2, size=n)
    step[7] = 1e300
    return rng.normal(size=(n, 2)) @ (1, 1j), step, soup(rng, n, f), np.zeros(f)


def strained(rng) -> Arguments:
    """Derivatives p, q and determinants, with p = 0, q = 0, NaN, inverted and nearly degenerate triangles."""
    f = rng.integers(400)
    p, q = np.array([[1], [0]]) + 0.4 * (rng.normal(size=(2, f, 2)) @ (1, 1j))
    p[::7], q[::5] = 0, 0
    p[3::50] = np.nan
    det = np.abs(p) ** 2 - np.abs(q) ** 2
    det[1::9], det[2::31] = 0, 1e-3
    return p, q, det


MIXTURES = np.concatenate(
    [
        np.eye(4, 6),
        [[127 / 128, 0, 0, 1 / 128, 0, 0], [0, 0, 1, 0.1, 0, 0], [0.5, 2, 0.25, 3, 0, 0], [0, 1, 0, 0, 4, np.inf]],
        [[1, 0, 2, 0.5, 0.3, np.inf], [0, 1, 0, 0, 4, 0.2], [1, 0, 2, 0.5, 0.3, 2]],
    ]
)


@arguments_of("mixed_energy")
def _(rng):
    """Sometimes with a triangle of infinite energy."""
    p, q, det = strained(rng)
    keep = np.isfinite(p) & (det > -rng.integers(2))
    return MIXTURES[rng.integers(len(MIXTURES))], p[keep], q[keep], det[keep], rng.uniform(size=int(keep.sum()))


@arguments_of("mixed_slopes")
def _(rng):
    p, q, det = strained(rng)
    return MIXTURES[rng.integers(len(MIXTURES))], p, q, det, numbers(rng, p.size), numbers(rng, p.size)


@arguments_of("mixed_curvature")
def _(rng):
    p, q, det = strained(rng)
    share, negative = rng.uniform(size=p.size), float(rng.integers(-1, 2))
    fields = rng.normal(size=(2, p.size)), numbers(rng, 4, p.size)
    return MIXTURES[rng.integers(len(MIXTURES))], p, q, det, share, negative, *fields[0], *fields[1]


@arguments_of("rigid_proxies")
def _(rng):
    p, q, det = strained(rng)
    return p, q, np.maximum(det, 1e-6), 10.0 ** rng.uniform(0.5, 3), rng.normal(size=p.size), numbers(rng, p.size)


@arguments_of("add_up")
def _(rng):
    """Pairs of entries at random positions, often repeated."""
    f, size = rng.integers(200), 50
    form = *rng.normal(size=(2, f)), *numbers(rng, 4, f)
    slots = rng.integers(size - 1, size=(2, 2, 3, f)).astype(np.int32)
    return *form, gradients(rng, f), slots, rng.choice([-1.0, 1.0], (3, f)), rng.normal(size=size)


@arguments_of("fill_stiffness")
def _(rng):
    return field_on(rng, 50, 2.0), 0, rng.normal(size=(9, 50)), np.empty((3, 50))


@arguments_of("fill_stiffness")
def _(rng):
    """Identical triangles, and NaN and infinite ξ."""
    xi = field_on(rng, 20, 1e4)
    xi[3], xi[4] = np.nan, np.inf
    return xi, 1, np.broadcast_to(rng.normal(size=(9, 1)), (9, 20)), np.empty((3, 20))


@arguments_of("fill_stiffness")
def _(rng):
    return np.empty(0, dtype=complex), 0, np.empty((9, 0)), np.empty((3, 0))


def swept(rng, number: int, scale: float, starts: list[int]) -> Arguments:
    """The triangles of a perturbed mesh, in runs."""
    V, F = disk(6)
    w, f = (V[:, 0] + 1j * V[:, 1]) + 0.1 * rng.normal(size=len(V)), starts[-1]
    gamma = np.broadcast_to(0.5 * (rng.normal(size=(2, 1)) + 1j * rng.normal(size=(2, 1))), (2, f))
    m = np.broadcast_to(np.sqrt(0.1875), (f,))
    xi = field_on(rng, f, scale)
    return w, F[:f], gamma, m, xi, number, np.array(starts), numbers(rng, f), np.empty((len(starts) - 1, 4))


@arguments_of("dirichlet_sweep")
def _(rng):
    return swept(rng, 0, 1.0, [0, 80])


@arguments_of("dirichlet_sweep")
def _(rng):
    return swept(rng, 1, 10.0, [0, 1, 30, 31, 70])


@arguments_of("dirichlet_sweep")
def _(rng):
    """A vertex with NaN position; separate weights and gradients for each triangle."""
    w, F, gamma, _, xi, *rest = swept(rng, 0, 1.0, [0, 40, 60])
    w[F[50, 1]] = np.nan
    return w, F, rng.normal() * gamma.copy(), rng.uniform(1, 2, 60), xi, *rest


@arguments_of("at_own_tensors")
def _(rng):
    """Triangles of all shapes: one of zero area, one of zero size, and a vertex with NaN position."""
    w, F, gamma, m, _, _, starts, gradient, _ = swept(rng, 0, 1.0, [0, 1, 40, 60])
    w[F[50, 1]] = np.nan
    w[F[3]] = 0.5
    w[F[5]] = 0.1, 0.2, 0.6
    return w, F, gamma, m, starts, gradient, np.empty((3, 2))


@arguments_of("at_own_tensors")
def _(rng):
    """A map with few or no inverted triangles; separate weights and gradients for each triangle."""
    V, F = disk(4)
    f, gamma = len(F), np.broadcast_to(numbers(rng, 2, 1), (2, len(F))).copy()
    w = V[:, 0] + 1j * V[:, 1] + rng.normal(size=len(V)) / 30
    return w, F, gamma, rng.uniform(1, 2, f), np.array([0, f]), numbers(rng, f), np.empty((1, 2))


@arguments_of("clip_moduli")
def _(rng):
    xi = field_on(rng, 30, 8.0)
    xi[5], xi[6] = np.nan, 1e150
    return xi, 8.8


@arguments_of("assemble")
def _(rng):
    """Three edges between four unknowns, one of them with two half-edges."""
    halves, offsets = np.array([0, 5, 7, 2], dtype=np.int32), np.array([0, 2, 3, 4], dtype=np.int32)
    row, column, border = np.array([0, 0, 2]), np.array([1, 2, 3]), np.array([1, 3, 4])
    border_row, indptr = np.array([3, 1, 3]), np.array([0, 3, 4, 6, 7], dtype=np.int32)
    return rng.normal(size=9), indptr, row, column, halves, offsets, border, border_row, rng.normal(size=7)


@arguments_of("assemble")
def _(rng):
    """One unknown whose neighbours are all fixed."""
    none, border = np.empty(0, dtype=np.int64), np.array([0, 2, 3, 5])
    indptr, offsets, border_row = np.arange(2, dtype=np.int32), np.zeros(1, dtype=np.int32), np.zeros(4, dtype=np.int64)
    return rng.normal(size=6), indptr, none, none, none.astype(np.int32), offsets, border, border_row, np.empty(1)


@arguments_of("boundary_load")
def _(rng):
    rows = np.array([3, 1, 3])
    return rng.normal(size=9), np.array([1, 3, 4]), rows, np.array([5, 0, 2]), numbers(rng, 6), np.full((2, 4), np.nan)


@arguments_of("put_at")
def _(rng):
    return rng.normal(size=(2, 3)), np.array([4, 0, 2]), numbers(rng, 6)


def upper_triangle(rng, size: int) -> Any:
    """An upper triangular pattern with a diagonal, and positive values."""
    full = np.triu(rng.random((size, size)) < 0.2, 1) | np.eye(size, dtype=bool)
    indptr = np.append(0, np.cumsum(full.sum(axis=1))).astype(np.int32)
    return indptr, np.nonzero(full)[1].astype(np.int32), rng.uniform(0.1, 2, indptr[-1])


@arguments_of("probe_matrix")
def _(rng):
    return *upper_triangle(rng, 12), rng.choice([-1.0, 1.0], 12), np.empty(12), np.empty(12), np.empty(12)


@arguments_of("probe_matrix")
def _(rng):
    """A diagonal with a zero and a NaN."""
    indptr, indices, values = upper_triangle(rng, 12)
    values[indptr[[5, 9]]] = 0.0, np.nan
    return indptr, indices, values, np.ones(12), np.zeros(12), np.zeros(12), np.zeros(12)


@arguments_of("probe_matrix")
def _(rng):
    return *upper_triangle(rng, 1), np.ones(1), np.empty(1), np.empty(1), np.empty(1)


@arguments_of("scaled_sizes")
def _(rng):
    return *rng.normal(size=(3, 20)), rng.normal(size=(2, 20)), rng.normal(size=(2, 20)), np.empty((3, 2))


@arguments_of("adam_step")
def _(rng):
    """Triangles, some of which never had a gradient."""
    gradient, square = field_on(rng, 40, 1.0), rng.uniform(0, 1, 40)
    mean = numbers(rng, 40)
    mean[::14] = square[::14] = 0
    return gradient, 0.6, 0.9, 0.2, mean, square, numbers(rng, 40)


for _indptr, _indices in (
    ([0, 2, 4, 5], [0, 2, 1, 2, 2]),
    ([0, 1, 1], [0]),
    ([0, 1, 2], [0, 0]),
    ([0, 3, 4, 5], [0, 2, 1, 1, 2]),
    ([0, 2, 3], [0, 2, 1]),
    ([0], []),
):
    arguments_of("wrong_pattern")(
        lambda _, one=_indptr, other=_indices: (np.array(one, dtype=np.int32), np.array(other, dtype=np.int32))
    )
