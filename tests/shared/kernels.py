"""Arguments for kernels, by name, to compare their NumPy and C implementations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from quasiharmonic import boundary_loops
from quasiharmonic.apps.atlas.packing.contact import list_runs
from quasiharmonic.geometry.coarsening.removal import allocate_round, remove_vertices
from quasiharmonic.surfaces import annulus, disk
from quasiharmonic.targets.cuts.graph import edge_graph
from shared.meshes import tangled

Arguments = tuple[Any, ...]
ARGUMENTS: dict[str, list[Callable[[np.random.Generator], Arguments]]] = {}


def arguments_of(name: str) -> Callable[[Callable[[np.random.Generator], Arguments]], object]:
    """Register a function that makes arguments of a kernel, of which there may be several; outputs hold any values."""
    return lambda make: ARGUMENTS.setdefault(name, []).append(make)


def numbers(rng: np.random.Generator, *shape: int) -> Any:
    """Random complex numbers of many magnitudes."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * 2.0 ** rng.uniform(-20, 20, shape)


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


def soup(rng, n: int, f: int) -> Any:
    """Random triangles: edges with one or more triangles, of equal and opposite orientation, and repeated corners."""
    return rng.integers(0, n, (f, 3))


@arguments_of("sort_edges")
def _(rng):
    V, F = disk(4)
    return F, len(V), np.empty((F.size, 2), dtype=np.int64), np.empty(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    return soup(rng, 9, 70), 9, np.zeros((210, 2), dtype=np.int64), np.empty(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    """A fan around the first vertex."""
    F = np.stack([np.zeros(99, dtype=np.int64), np.arange(1, 100), rng.permutation(np.arange(2, 101))], axis=1)
    return F, 101, np.zeros((297, 2), dtype=np.int64), np.empty(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    return soup(rng, 9, 5), 4, np.zeros((15, 2), dtype=np.int64), np.zeros(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    return soup(rng, 9, 0), 0, np.zeros((0, 2), dtype=np.int64), np.zeros(4, dtype=np.int64)


@arguments_of("link_nodes")
def _(rng):
    """Columns of triangles, as for connected components."""
    F = soup(rng, 200, 40)
    return F[:, :2], F[:, 1:], np.empty(200, dtype=np.int64)


@arguments_of("link_nodes")
def _(rng):
    return rng.integers(0, 50, 30), rng.integers(0, 50, 30), np.empty(50, dtype=np.int64)


@arguments_of("link_nodes")
def _(rng):
    """A node index out of range, in the first link."""
    return np.array([9, 0]), np.array([0, 1]), np.arange(9)


@arguments_of("follow_loops")
def _(rng):
    """A short loop and a long one."""
    around = rng.permutation(60)
    loops = np.concatenate([np.stack([some, np.roll(some, 1)], axis=1) for some in (around[:4], around[4:])])
    return rng.permutation(loops), np.zeros(60, dtype=np.int64), np.zeros(60, dtype=np.int64)


@arguments_of("follow_loops")
def _(rng):
    """A vertex that the loop visits twice."""
    loops = np.array([[0, 1], [1, 2], [2, 0], [2, 3], [3, 4], [4, 2]])
    return rng.permutation(loops), np.zeros(6, dtype=np.int64), np.zeros(6, dtype=np.int64)


@arguments_of("sure_signs")
def _(rng):
    """Integer triangles, many of zero area, and some with NaN or infinite coordinates."""
    uv = rng.integers(0, 4, (30, 2)) * rng.choice([1.0, 1e200, 1e-320, 0.1], (30, 1))
    uv[rng.integers(0, 30, 3), rng.integers(0, 2, 3)] = np.nan, np.inf, -np.inf
    return soup(rng, 30, 400), uv, np.zeros(400, dtype=np.int8)


@arguments_of("sure_signs")
def _(rng):
    """Slivers whose area is zero up to rounding."""
    uv = np.ldexp(np.linspace(0, 1, 40)[:, None] * [1, 3] + rng.integers(-2, 3, (40, 2)) * 2.0**-52, 3)
    return soup(rng, 40, 500), uv, np.zeros(500, dtype=np.int8)


@arguments_of("sure_signs")
def _(rng):
    """A vertex index out of range, in the first triangle."""
    F = soup(rng, 7, 5)
    F[0] = -1, 6, 7
    return F, rng.normal(size=(7, 2)), np.zeros(5, dtype=np.int8)


@arguments_of("count_turns")
def _(rng):
    """Integer coordinates, so many corners have equal heights; one vertex has a NaN coordinate."""
    uv = np.append(rng.integers(0, 5, (29, 2)), [[0, np.nan]], axis=0)
    return soup(rng, 30, 400), uv, rng.integers(0, 3, 30)


def curves(places: Any, lengths: Any) -> Arguments:
    """Closed curves stored consecutively, and an output array for pairs of edges."""
    starts = np.cumsum([0, *lengths])
    tails, heads = np.arange(len(places)), np.arange(1, len(places) + 1)
    heads[starts[1:] - 1] = starts[:-1]
    return places, tails, heads, starts, np.zeros((9 * len(places), 2), dtype=np.int64)


@arguments_of("doubtful_pairs")
def _(rng):
    """Points on a coarse grid: edges cross, touch, overlap, turn back and have zero length."""
    return curves(rng.integers(0, 9, (60, 2)) * 0.1, [3, 4, 53])


@arguments_of("doubtful_pairs")
def _(rng):
    """A star-shaped curve, and the same curve flattened to a line up to rounding."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, 300))
    star = rng.uniform(0.5, 1, (300, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return curves(np.concatenate([star, star[::5] * [1, 1e-17] + [0, 0.5]]), [300, 60])


@arguments_of("doubtful_pairs")
def _(rng):
    """Segments between a few points, some of zero length, in one group; or no segment."""
    tails, heads = rng.integers(0, 20, (2, 40 * rng.integers(2)))
    places = rng.integers(0, 9, (20, 2)) * 0.1
    return places, tails, heads, np.array([0, len(tails)]), np.zeros((800, 2), dtype=np.int64)


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


MIXTURES = np.concatenate([np.eye(4), [[127 / 128, 0, 0, 1 / 128], [0, 0, 1, 0.1], [0.5, 2, 0.25, 3]]])


@arguments_of("mixed_energy")
def _(rng):
    """Sometimes with a triangle of infinite energy."""
    p, q, det = strained(rng)
    keep = np.isfinite(p) & (det > -rng.integers(2))
    return MIXTURES[rng.integers(7)], p[keep], q[keep], det[keep], rng.uniform(size=int(keep.sum()))


@arguments_of("mixed_slopes")
def _(rng):
    p, q, det = strained(rng)
    return MIXTURES[rng.integers(7)], p, q, det, numbers(rng, p.size), numbers(rng, p.size)


@arguments_of("mixed_curvature")
def _(rng):
    p, q, det = strained(rng)
    share, negative = rng.uniform(size=p.size), float(rng.integers(-1, 2))
    fields = rng.normal(size=(2, p.size)), numbers(rng, 4, p.size)
    return MIXTURES[rng.integers(7)], p, q, det, share, negative, *fields[0], *fields[1]


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


def field_on(rng, triangles: int, scale: float) -> Any:
    """Random ξ of triangles, of few magnitudes, some of them zero."""
    xi = scale * (rng.normal(size=triangles) + 1j * rng.normal(size=triangles))
    xi[::7] = 0
    xi[1::7] *= 1e-9
    return xi


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


def stirred_disks(rng, stirred: list[int]) -> Arguments:
    """Copies of a disk; in each copy, a given number of interior vertices is moved far."""
    V, F = disk(6)
    n, count = len(V), len(stirred)
    w = np.tile((V[:, 0] + 1j * V[:, 1]) + 0.01 * rng.normal(size=n), count)
    inner = np.setdiff1d(np.arange(n), np.concatenate(boundary_loops(F, n)))
    for k, some in enumerate(stirred):
        thrown = rng.choice(inner, some, replace=False) + k * n
        w[thrown] += 0.4 * (rng.normal(size=some) + 1j * rng.normal(size=some))
    moves = np.tile(np.isin(np.arange(n), inner), count)
    F, mesh = np.concatenate([F + k * n for k in range(count)]), np.repeat(np.arange(count), len(F))
    return F, moves, mesh, w, np.empty_like(w), np.empty(count, dtype=bool)


@arguments_of("place_inverted")
def _(rng):
    return stirred_disks(rng, [3])


@arguments_of("place_inverted")
def _(rng):
    return stirred_disks(rng, [2, 0, 30, 5, 1])


@arguments_of("place_inverted")
def _(rng):
    """An inverted triangle with all vertices fixed, a vertex with NaN position, and a vertex of high degree."""
    F, moves, mesh, w, *_ = stirred_disks(rng, [1, 2])
    w[np.flatnonzero(moves)[-4]] = np.nan
    n, spokes = w.size, 20
    rim = n + 1 + np.arange(spokes)
    fan = np.stack([np.full(spokes, n), rim, np.roll(rim, -1)], axis=1)
    alone = n + spokes + 1 + np.arange(3)[None]
    F = np.concatenate([F, fan, alone])
    moves = np.concatenate([moves, [True], np.zeros(spokes + 3, dtype=bool)])
    mesh = np.concatenate([mesh, np.full(spokes, 2), [3]])
    w = np.concatenate([w, [3], np.exp(2j * np.pi * np.arange(spokes) / spokes), [0, 1j, 1]])
    return F, moves, mesh, w, np.empty_like(w), np.empty(4, dtype=bool)


def divided_cells(rng, triangles: int, parents: int, room: int) -> Arguments:
    """Small and large triangles in the unit box, some in a corner of it, to be listed by subcells."""
    corners = np.clip(rng.random((triangles, 1, 2)) + 0.2 * rng.normal(size=(triangles, 3, 2)), 0, 1 - 2.0**-40)
    corners[::3] *= 2.0**-6
    tail, head = corners, np.roll(corners, -1, axis=1)
    nx, ny = tail[..., 1] - head[..., 1], head[..., 0] - tail[..., 0]
    finest, shift = (corners * 2.0**40).astype(np.int64), 36
    corner = 4 * np.stack(np.divmod(rng.permutation(16)[:parents], 4), axis=1)
    low, high = finest.min(axis=1), finest.max(axis=1)
    touch = (low[None] >> shift <= corner[:, None] + 3) & (high[None] >> shift >= corner[:, None])
    parent, triangle = np.array(np.nonzero(touch.all(axis=2)))
    return (
        low, high, nx, ny, nx * tail[..., 0] + ny * tail[..., 1],
        triangle, parent, corner, 4, 4, shift,
        np.empty(16 * parents, dtype=np.int64), np.zeros(room, dtype=np.int64),
    )  # fmt: skip


@arguments_of("divide_cells")
def _(rng):
    return divided_cells(rng, 40, 9, 4000)


@arguments_of("divide_cells")
def _(rng):
    """Output lists that are too short."""
    return divided_cells(rng, 40, 9, 3)


@arguments_of("divide_cells")
def _(rng):
    return divided_cells(rng, 0, 1, 0)


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


@arguments_of("lay_flat")
def _(rng):
    """Triangles in space, some of zero area, some with coincident corners."""
    V = rng.integers(-3, 4, (30, 3)) / 10
    return V, soup(rng, 30, 200), -1, np.empty(200), np.empty(200, dtype=np.complex128)


@arguments_of("lay_flat")
def _(rng):
    """Planar triangles in a strided array, near the largest or smallest doubles."""
    exponent = (1024, -1070)[rng.integers(2)]
    V = np.ldexp(rng.uniform(-0.5, 0.5, (60, 2)), exponent)[::2]
    return V, soup(rng, 30, 200), exponent, np.empty(200), np.empty(200, dtype=np.complex128)


@arguments_of("find_cells")
def _(rng):
    """3 × 2 cells, of which two are divided, and one subcell divided again."""
    parts = np.full(6 + 3 * 16, -1)
    parts[[1, 4, 6 + 7]] = 6 + 16 * np.arange(3)
    points = rng.random((50, 2)) * [3 / 4, 2 / 4]
    points[:3] = [0, 0], [0.25, 0.25], [0.75 - 2.0**-53, 0.5 - 2.0**-53]
    return points, 3, 38, parts, np.empty(50, dtype=np.int64)


@arguments_of("sure_hits")
def _(rng):
    """Points include corners of triangles and midpoints of sides; some points have no triangle listed."""
    rows, begin = rng.integers(0, 9, (30, 6)) / 8.0, rng.integers(0, 40, 60)
    points = np.concatenate([rng.random((40, 2)), rows[:10, :2], rows[:10, :2] / 2 + rows[:10, 2:4] / 2])
    return points, begin, begin + rng.integers(0, 20, 60), rng.integers(0, 30, 60, np.int32), rows, np.empty(60, int)


def round_of_coarsening(rng: np.random.Generator, size: int) -> Arguments:
    """Arguments of `remove_vertices`: a mesh from which no vertex has been removed yet."""
    T, free = tangled(rng, size)
    return T, free, 12 * rng.random(free.size), *(np.zeros_like(each) for each in allocate_round(T))


for size in (0, 1, 60, 300):
    arguments_of("remove_vertices")(partial(round_of_coarsening, size=size))


@arguments_of("remove_vertices")
def _(rng):
    """A vertex, and no triangle."""
    T = np.empty((3, 0), dtype=np.int64)
    return T, np.ones(1, dtype=bool), rng.random(1), *(np.zeros_like(each) for each in allocate_round(T))


@arguments_of("fill_rings")
def _(rng):
    T, free, dice, vertices, rings, of_degree = round_of_coarsening(rng, 200)
    remove_vertices(T, free, dice, vertices, rings, of_degree)
    gone = of_degree.sum()
    there = np.ones(free.size, dtype=bool)
    there[vertices[:gone]] = False
    return T, there, rings, of_degree, np.empty((3, T.shape[1] - 2 * gone), dtype=np.int64)


@arguments_of("fill_rings")
def _(rng):
    """No vertex is removed."""
    T, free, _, _, rings, of_degree = round_of_coarsening(rng, 20)
    return T, np.ones(free.size, dtype=bool), rings, of_degree, np.empty_like(T)


def rings(rng: np.random.Generator, d: int) -> Arguments:
    """Random, degenerate, NaN and infinite rings of degree d, with and without a valid position for their centre."""
    ring = np.exp(2j * np.pi * (np.sort(rng.random((200, d)), axis=1))) * 2.0 ** rng.uniform(-3, 0, (200, d))
    ring[50:80] = numbers(rng, 30, d)
    ring[80:90, rng.integers(d)] = ring[80:90, rng.integers(d)]
    ring[90:95], ring[95:98, 1], ring[98:, 2] = 0, np.nan, np.where(np.arange(102) % 9, ring[98:, 2], np.inf)
    return ring, numbers(rng, 200)


for d in range(3, 9):
    arguments_of("find_places")(partial(rings, d=d))
arguments_of("find_places")(lambda rng: (numbers(rng, 1, 5), numbers(rng, 1)))
arguments_of("find_places")(lambda rng: (numbers(rng, 0, 4), numbers(rng, 0)))


@arguments_of("smooth")
def _(rng):
    """A nearly injective map that gets inverted triangles."""
    V, F = disk(9)
    held = rng.random(len(V)) < 0.1
    return V[:, 0] * (1 + 9 * V[:, 0] ** 2) + 0.3 * rng.random(len(V)) / 9 + 1j * V[:, 1], F, held


@arguments_of("smooth")
def _(rng):
    """Triangles in column-major order, and vertices without triangles."""
    V, F = disk(5)
    return numbers(rng, len(V)), np.asfortranarray(F[: len(F) // 2]), np.zeros(len(V), dtype=bool)


def open_ring(rng: np.random.Generator, costs: str, limit: float, borders: float) -> Arguments:
    """An annulus between its two boundary loops, with a share of the other edges as further borders."""
    V, F = annulus(8)
    graph = edge_graph(V, F)
    opposite, side = graph.half_edges
    count = len(graph.ends)
    cost = {"equal": np.ones(count), "few": rng.integers(1, 4, count).astype(float), "own": graph.cost}[costs]
    cost[rng.random(count) < 0.05] = np.inf
    loops = np.sort([loop[0] for loop in boundary_loops(F, len(V))])
    start, goal = (int(np.flatnonzero(graph.rim[side] & (F.ravel() == vertex))[0]) for vertex in loops)
    return opposite, side, graph.rim | (rng.random(count) < borders), cost, start, goal, limit, np.zeros_like(side)


for costs in ("equal", "few", "own"):
    for borders in (0.0, 0.01, 0.2):
        arguments_of("cross_ring")(partial(open_ring, costs=costs, limit=np.inf, borders=borders))
    arguments_of("cross_ring")(partial(open_ring, costs=costs, limit=0.5, borders=0.0))
    arguments_of("cross_ring")(partial(open_ring, costs=costs, limit=6.0, borders=0.01))


@arguments_of("cross_ring")
def _(rng):
    """Both ends at the same border."""
    opposite, side, border, cost, start, _, limit, path = open_ring(rng, "own", np.inf, 0.01)
    _, F = annulus(8)
    (loop,) = (loop for loop in boundary_loops(F, F.max() + 1) if F.ravel()[start] in loop)
    goal = int(np.flatnonzero(np.isin(F.ravel(), loop[loop != F.ravel()[start]]))[rng.integers(9)])
    return opposite, side, border, cost, start, goal, limit, path


@arguments_of("cross_ring")
def _(rng):
    """A start away from all borders."""
    V, F = disk(3)
    graph = edge_graph(V, F)
    opposite, side = graph.half_edges
    start = int(np.flatnonzero(~graph.rim_vertices[F.ravel()])[0])
    return opposite, side, graph.rim, graph.cost, start, int(np.flatnonzero(graph.rim[side])[0]), 9.0, 0 * side


@arguments_of("find_contact")
def _(rng, shape=(40, 150), density=0.02, sizes=((9, 30), (30, 9), (2, 3))):
    """Random bitmaps on a random board with a frame; some do not fit."""
    occupied = rng.random(shape) < density
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    bitmaps = [rng.random(size) < 0.3 for size in sizes]
    return occupied, len(occupied), *list_runs(bitmaps), np.zeros(3, dtype=np.int64)


for shape, density, sizes in (
    ((30, 64), 0.0, [(1, 1), (9, 62), (28, 62), (29, 3)]),
    ((70, 65), 0.001, [(20, 20), (20, 22), (21, 21)]),
    ((70, 129), 0.1, [(3, 4), (2, 70)]),
    ((20, 20), 1.0, [(1, 2)]),
    ((3, 3), 0.0, [(1, 1)]),
    ((2, 5), 0.0, [(1, 1)]),
):
    arguments_of("find_contact")(partial(ARGUMENTS["find_contact"][0], shape=shape, density=density, sizes=sizes))


@arguments_of("find_contact")
def _(rng):
    """A board without occupied cells and an empty bitmap."""
    runs = list_runs([np.zeros((2, 2), dtype=bool), np.ones((2, 3), dtype=bool)])
    return np.zeros((8, 8), dtype=bool), 8, *runs, np.zeros(3, dtype=np.int64)
