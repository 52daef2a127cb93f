"""Link distances against closed forms, metric properties, and random walks."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.problem.diagnosis.clipping import Lattice
from quasiharmonic.problem.diagnosis.shortcuts import Polygon
from shared.polygons import U, circle, spiral


def polygon(corners):
    return Polygon(Lattice(np.asarray(corners, dtype=float)).points)


def table(corners, limit=30):
    n, found = len(corners), polygon(corners)
    return np.array([[0 if i == j else found.link_distance(i, j, limit) for j in range(n)] for i in range(n)])


def star(rng, n):
    return circle(n) * (0.05 + rng.random(n))[:, None]


def comb(teeth):
    """Teeth below a bar: from the bottom of one tooth to that of another, three segments are needed."""
    lower = [(x, y) for k in range(teeth) for x, y in ((3 * k, 1), (3 * k, -9), (3 * k + 1, -9), (3 * k + 1, 1))]
    return [*lower, (3 * teeth, 1), (3 * teeth, 2), (-1, 2), (-1, 1)]


@pytest.mark.parametrize("corners", [circle(9), spiral(14, 1.6), U, comb(6), star(np.random.default_rng(0), 40)])
def test_triangles_fill_the_polygon(corners):
    p = np.asarray(corners, dtype=float)
    triangles = np.array(polygon(corners).triangles)
    a, b, c = p[triangles].transpose(1, 0, 2)
    assert len(triangles) == len(p) - 2
    assert (orientation(a, b, c) > 0).all()
    q = np.roll(p, -1, axis=0)
    area = np.sum((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    np.testing.assert_allclose(area, np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]))


def test_convex_polygons_are_visible_from_everywhere():
    assert (table(circle(12)) == 1 - np.eye(12)).all()


def test_corners_of_a_corridor():
    distance = table(U)
    assert distance[3, 6] == 3
    assert distance[2, 7] == 2  # past (4.5, 0), touching both inner corners
    assert distance[2, 3] == distance[0, 1] == 1
    assert distance[1, 6] == 2


@pytest.mark.slow
def test_teeth_of_a_comb():
    distance = table(comb(5))
    bottoms = [4 * k + 1 for k in range(5)]
    assert set(distance[np.ix_(bottoms, bottoms)].ravel()) == {0, 3}


@pytest.mark.slow
def test_stairs_need_one_segment_per_step():
    # Narrow stairs, 1 up and 1 right each: a segment crosses at most one step.
    steps, width = 5, 0.01
    low = [(k + d, k + e) for k in range(steps) for d, e in ((0, 0), (1, 0))]
    high = [(x - width, y + width) for x, y in reversed(low)]
    distance = table([*low, *high], limit=40)
    assert distance[0, 2 * steps - 1] == 2 * steps - 1


@pytest.mark.slow
@pytest.mark.parametrize("corners", [spiral(10, 1.6), comb(3), star(np.random.default_rng(1), 24)])
def test_distances_are_a_metric(corners):
    distance = table(corners)
    assert (distance == distance.T).all()
    through = np.min(distance[:, :, None] + distance[None], axis=1)
    assert (distance <= through).all()
    assert (np.diag(np.roll(distance, -1, axis=1)) == 1).all()


@pytest.mark.slow
def test_the_limit_is_respected():
    corners = spiral(10, 1.6)
    distance, found = table(corners), polygon(corners)
    far = np.unravel_index(np.argmax(distance), distance.shape)
    for limit in (1, 2, 3):
        assert found.link_distance(*far, limit) == limit + 1


@pytest.mark.slow
def test_random_paths_are_no_shorter():
    # Random points, and the least number of segments from each corner to them and on to the others.
    rng = np.random.default_rng(5)
    corners = spiral(12, 1.2)
    middles = np.concatenate([0.5 * (corners[k] + corners[[j]]) for k in range(24) for j in range(k)])
    beside = np.concatenate([corners + 0.01 * direction for direction in circle(6)])
    places = np.concatenate([middles, beside, beside]) + 0.02 * rng.normal(size=(len(middles) + 2 * len(beside), 2))
    p, q = corners, np.roll(corners, -1, axis=0)

    def free(a, b):
        """Return whether segments (m, n) from a (m, 2) to b (n, 2) cross no side."""
        a, b = a[:, None, None], b[None, :, None]
        crossed = (orientation(a, b, p) * orientation(a, b, q) < 0) & (orientation(p, q, a) * orientation(p, q, b) < 0)
        return ~crossed.any(axis=2)

    inside = np.array([_inside(x, p, q) for x in places])
    places = places[inside]
    to_corner, between = free(places, corners), free(places, places)
    fewest = np.full((24, 24), 99)
    reached = to_corner.T
    for count in range(2, 12):
        arrives = (reached.astype(int) @ to_corner.astype(int)) > 0
        fewest = np.where(arrives & (fewest == 99), count, fewest)
        reached = (reached.astype(int) @ between.astype(int)) > 0
    exact = np.maximum(table(corners), 2)
    np.fill_diagonal(exact, 2)
    assert (exact <= fewest).all()
    assert (exact == fewest).mean() > 0.75


def _inside(x, p, q):
    upward = (p[:, 1] <= x[1]) & (x[1] < q[:, 1])
    downward = (q[:, 1] <= x[1]) & (x[1] < p[:, 1])
    left = orientation(p, q, x) > 0
    return (upward & left).sum() - (downward & ~left).sum() == 1
