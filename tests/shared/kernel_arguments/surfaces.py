"""Arguments of kernels for meshes: topology, exact signs, search, coarsening, packing."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from quasiharmonic import boundary_loops
from quasiharmonic.apps.atlas.packing.board import list_runs
from quasiharmonic.geometry.coarsening import allocate_round, remove_vertices
from quasiharmonic.geometry.mesh.topology import find_sides
from quasiharmonic.surfaces import disk
from shared.kernel_arguments.registry import ARGUMENTS, Arguments, arguments_of, numbers, soup
from shared.meshes import tangled


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


@arguments_of("number_sides")
def _(rng):
    return soup(rng, 9, 70), 9, np.zeros((70, 3), dtype=np.int64), np.zeros((210, 2), dtype=np.int64)


@arguments_of("number_sides")
def _(rng):
    """A fan around the first vertex."""
    F = np.stack([np.zeros(99, dtype=np.int64), np.arange(1, 100), rng.permutation(np.arange(2, 101))], axis=1)
    return F, 101, np.zeros((99, 3), dtype=np.int64), np.zeros((297, 2), dtype=np.int64)


@arguments_of("number_sides")
def _(rng):
    return soup(rng, 9, 5), 4, np.zeros((5, 3), dtype=np.int64), np.zeros((15, 2), dtype=np.int64)


def paired_sides(rng: np.random.Generator, triangles: int, edges: int | None = None) -> Arguments:
    """Sides of random triangles, many of which share an edge."""
    ends, side = find_sides(soup(rng, 9, triangles), 9)
    return side, len(ends) if edges is None else edges, np.zeros(side.size, dtype=np.int64)


for triangles in (0, 8, 70):
    arguments_of("find_opposite")(partial(paired_sides, triangles=triangles))
arguments_of("find_opposite")(partial(paired_sides, triangles=8, edges=3))


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


@arguments_of("improve_nearest")
def _(rng):
    """Triangles of which some are degenerate, and points that already have a nearest one."""
    corners = rng.normal(size=(30, 3, 3))
    corners[::7, 2] = corners[::7, 1]
    corners[3] = corners[3, 0]
    reach = rng.uniform(0, 1, (50, 6))
    known = np.full(50, -1), np.zeros((50, 3)), np.full(50, np.inf)
    known[0][:20], known[2][:20] = rng.integers(0, 30, 20), rng.uniform(0, 1, 20)
    return rng.normal(size=(50, 3)), corners, rng.integers(0, 30, (50, 6)), reach, *known


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


def hull_points(rng: np.random.Generator, size: int, steps: int) -> Arguments:
    """Points of whole numbers in ascending order."""
    z = np.sort(rng.integers(0, steps, size) + 1j * rng.integers(0, steps, size))
    return z, np.zeros(size + 1, dtype=np.int64)


for size, steps in ((1, 5), (2, 5), (3, 5), (30, 5), (30, 1), (30, 20), (300, 1 << 46)):
    arguments_of("find_hull")(partial(hull_points, size=size, steps=steps))


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


def loops_and_cells(rng: np.random.Generator, size: int) -> tuple[Any, ...]:
    """Closed loops that cross each other, and lead out of the cells."""
    corners = (rng.uniform(-4, 34, size) + 1j * rng.uniform(-4, 24, size)).astype(np.complex128)
    return corners, np.roll(corners, -1), np.ones((20, 30), dtype=bool)


for size in (0, 1, 3, 40):
    arguments_of("fill_cells")(partial(loops_and_cells, size=size))


@arguments_of("mark_near")
def _(rng, radius=2.3):
    tails, heads, cells = loops_and_cells(rng, 9)
    return tails, heads, radius, 0.5, cells & (rng.random(cells.shape) < 0.1)


@arguments_of("mark_near")
def _(rng):
    """Points, and a radius of zero."""
    tails, _, cells = loops_and_cells(rng, 30)
    return tails, tails, 0.0, 0.5, ~cells
