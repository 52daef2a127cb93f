"""Problems with a simple target whose mesh may admit no map, for tests of edge splitting."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from quasiharmonic import Problem, boundary_loops, certify
from quasiharmonic.geometry.mesh.topology import edges
from quasiharmonic.surfaces import annulus, disk
from shared.polygons import random_polygon, spiral, spread


def without_inner_vertices(rng, n):
    """A random triangulation of a regular polygon with ``n`` corners, in which every interior edge is a chord."""
    triangles, waiting = [], [(0, n - 1)]
    while waiting:
        i, j = waiting.pop()
        if j - i > 1:
            k = int(rng.integers(i + 1, j))
            triangles.append((i, k, j))
            waiting += [(i, k), (k, j)]
    t = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(t), np.sin(t)], axis=1), np.array(triangles)


def comb(teeth, depth):
    """A comb-shaped polygon with ``4 teeth + 2`` corners."""
    right = 4.0 * np.arange(teeth)[::-1, None] + [3, 3, 1, 1]
    high = np.broadcast_to([0, depth, depth, 0], right.shape)
    tooth = np.stack([right, high], axis=2).reshape(-1, 2)
    return np.concatenate([[[0, -1], [4 * teeth, -1]], tooth]).astype(float)


def burst(rng, n, spread_of_radii):
    """A star-shaped polygon whose radii have a log-normal distribution."""
    t = 2 * np.pi * (np.arange(n) + 0.8 * rng.random(n)) / n
    radius = np.exp(spread_of_radii * rng.normal(size=n))[:, None]
    return radius * np.stack([np.cos(t), np.sin(t)], axis=1)


def polygon(rng, kind, n):
    """A simple polygon with ``n`` points, counterclockwise."""
    if kind == "burst":
        return burst(rng, n, rng.choice([0.3, 1.0, 2.0]))
    if kind == "spiral":
        # At least eight steps per turn, so that sides do not cross the inner coil.
        return spread(spiral(n // 2, rng.uniform(0.5, 1) * n / 16, 10.0 ** rng.uniform(-6, -0.3)), n)
    if kind == "comb":
        return spread(comb((n - 2) // 4, 10.0 ** rng.uniform(0, 6)), n)
    points = random_polygon(rng, min(n, 14), 8)
    if kind == "flat":
        turn = np.array([[np.cos(1), np.sin(1)], [-np.sin(1), np.cos(1)]])
        points = points * [1, 10.0 ** rng.uniform(-9, 0)] @ turn
    return spread(points, n)


def onto_polygon(seed, kind):
    """A disk onto a polygon, with many interior vertices or without any."""
    rng = np.random.default_rng(seed)
    if seed % 2:
        V, F = without_inner_vertices(rng, int(rng.integers(6, 40)))
    else:
        V, F = disk(int(rng.integers(2, 8)))
    (loop,) = boundary_loops(F, len(V))
    return Problem(V, F, loop, polygon(rng, kind, len(loop)), reference="equilateral")


def with_holes(rng, holes, pins, *, size=9):
    """A square sheet with holes and pins whose target positions are random.

    The target positions of the holes are small squares and those of the pins are points, at distinct lattice points of
    the sheet in random order.
    """
    from quasiharmonic.surfaces import grid

    V, F = grid(size, size)
    cells = rng.permutation([(i, j) for i in range(1, size - 1, 2) for j in range(1, size - 1, 2)])
    keep = np.ones(len(F), dtype=bool)
    centre = V[F].mean(axis=1) * size
    for i, j in cells[:holes]:
        keep &= ~((np.floor(centre[:, 0]) == i) & (np.floor(centre[:, 1]) == j))
    F = F[keep]
    loops = boundary_loops(F, len(V))
    outer = max(loops, key=len)
    target = np.zeros_like(V)
    target[outer] = V[outer]
    free = np.setdiff1d(np.arange(len(V)), np.concatenate(loops))
    pinned = rng.choice(free, pins, replace=False)
    # Lattice points, each used once.
    rooms = rng.permutation([(i, j) for i in range(1, 8) for j in range(1, 8)]) / 8.0
    inner = [loop for loop in loops if loop is not outer]
    for loop, room in zip(inner, rooms, strict=False):
        middle = V[loop].mean(axis=0)
        target[loop] = room + (V[loop] - middle) * 0.3
    target[pinned] = rooms[len(inner) : len(inner) + pins]
    fixed = np.concatenate([*loops, pinned])
    return Problem(V, F, fixed, target[fixed], reference="equilateral")


def turned_ring(quarters):
    """An annulus whose hole is turned by ``quarters`` quarter turns."""
    V, F = annulus()
    outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarters)
    return Problem(V, F, np.concatenate([outer, inner]), np.concatenate([V[outer], V[inner] @ turn]))


def check_construction(problem, made):
    """Check that the map is certified and that its mesh refines the problem's mesh without splitting fixed edges."""
    refined, n = made.refined, problem.n
    assert made.certificate.bijective
    # Certify from arrays, which finds the loops independently of the construction.
    assert certify(refined.F, made.uv).bijective
    assert np.array_equal(made.uv[problem.fixed], problem.target)
    assert np.array_equal(refined.V[:n], problem.V)
    assert len(refined.V) == n + len(refined.parents) == len(made.uv)
    assert sorted(map(tuple, edges(refined.F, len(refined.V)).boundary.tolist())) == sorted(
        map(tuple, edges(problem.F, n).boundary.tolist())
    )
    assert np.array_equal(np.unique(refined.parent), np.arange(len(problem.F)))
    assert np.allclose(refined.weights.sum(axis=1), 1)
    # The parts of a triangle lie in it, have its orientation, and cover it, by exact arithmetic in its own coordinates.
    covered = [Fraction(0)] * len(problem.F)
    where = [{v: Fraction(1)} for v in range(n)]
    for between, weights in zip(refined.parents.tolist(), refined.weights.tolist(), strict=True):
        where.append({v: Fraction(w) for v, w in zip(between, weights, strict=True) if w})
    assert len(where) == len(refined.V)
    for corners, parent in zip(refined.F.tolist(), refined.parent.tolist(), strict=True):
        a, b, c = problem.F[parent].tolist()
        assert all(where[v].keys() <= {a, b, c} for v in corners)
        (px, py), (qx, qy), (rx, ry) = ((where[v].get(b, 0), where[v].get(c, 0)) for v in corners)
        twice = (qx - px) * (ry - py) - (qy - py) * (rx - px)
        assert twice > 0
        covered[parent] += twice
    assert covered == [1] * len(problem.F)
