"""Arguments of kernels for cuts: parts of edge graphs, stretches, paths across rings."""

from __future__ import annotations

from functools import partial

import numpy as np

from quasiharmonic import boundary_loops
from quasiharmonic.surfaces import annulus, disk
from quasiharmonic.targets.cuts.graph import edge_graph, make_room
from shared.kernel_arguments.registry import Arguments, arguments_of


def part_of_disk(rng: np.random.Generator, seeds: int, rings: int) -> Arguments:
    """Some vertices of a mesh, and room for all triangles."""
    V, F = disk(9)
    graph = edge_graph(V, F)
    order = np.argsort(F.ravel(), kind="stable")
    start = np.searchsorted(F.ravel()[order], np.arange(len(V) + 1))
    return (
        start,
        order // 3,
        F,
        graph.side,
        rng.permutation(len(V))[:seeds],
        rings,
        *make_room(len(F), len(V), len(graph.ends)),
    )


for seeds, rings in ((1, 1), (1, 3), (9, 2), (40, 1), (0, 2)):
    arguments_of("gather_part")(partial(part_of_disk, seeds=seeds, rings=rings))


def paths_on_disk(rng: np.random.Generator, costs: str, sources: int, limit: float) -> Arguments:
    """Some vertices of a mesh, a few of them twice, and costs of its edges, some of them infinite."""
    V, F = disk(9)
    graph = edge_graph(V, F)
    count, start = len(graph.ends), np.append(0, np.cumsum(np.bincount(graph.ends.ravel())))
    order = np.argsort(graph.ends.ravel(), kind="stable")
    cost = {"equal": np.ones(count), "few": rng.integers(1, 4, count).astype(float), "own": graph.cost}[costs]
    cost[rng.random(count) < 0.05] = np.inf
    chosen = rng.integers(len(V), size=sources)
    return start, graph.ends[:, ::-1].ravel()[order], order // 2, cost, chosen, limit, np.zeros(len(V)), 0 * start[1:]


for costs in ("equal", "few", "own"):
    for sources, limit in ((1, np.inf), (20, np.inf), (1, 4.0), (20, 0.5)):
        arguments_of("find_shortest_paths")(partial(paths_on_disk, costs=costs, sources=sources, limit=limit))


def some_edges(rng: np.random.Generator, share: float) -> Arguments:
    """Edges of a disk, with branches, loops and paths without nodes."""
    V, F = disk(9)
    graph = edge_graph(V, F)
    ends = graph.ends[rng.random(len(graph.ends)) < share]
    return ends, graph.rim_vertices, np.zeros(len(ends), dtype=np.int64), np.zeros(len(ends), dtype=np.int64)


for share in (0.0, 0.1, 0.3, 0.7, 1.0):
    arguments_of("walk_stretches")(partial(some_edges, share=share))


@arguments_of("walk_stretches")
def _(rng):
    """A loop without nodes, a path, and a loop at a vertex of the rim."""
    ends = np.array([[0, 1], [0, 2], [1, 2], [3, 4], [4, 5], [6, 7], [6, 8], [7, 8]])
    return ends, np.arange(9) == 8, np.zeros(8, dtype=np.int64), np.zeros(8, dtype=np.int64)


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
