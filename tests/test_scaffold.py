"""The air mesh around a planar surface: bijective together with it, no new boundary vertices, well-shaped triangles."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import certify, is_injective
from quasiharmonic.apps.flattening.air_triangulation import Quadtree, triangulate_air
from quasiharmonic.geometry.exact import constrained_delaunay as triangulating
from quasiharmonic.geometry.exact.constrained_delaunay import BlockedError, Triangulation, constrained_delaunay
from quasiharmonic.geometry.mesh.topology import boundary_loops, edge_keys, edges
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay


def fan(radii, angles):
    """A star-shaped polygon around the origin, as a fan of triangles around its centre."""
    n = len(radii)
    rim = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    k = np.arange(n)
    return np.stack([np.full(n, n), k, (k + 1) % n], axis=1), np.concatenate([rim, [[0.0, 0.0]]])


def blocks(gap, seed=0):
    """Two rectangles on opposite sides of a gap, whose vertices are not aligned."""
    rng = np.random.default_rng(seed)
    parts, places, count = [], [], 0
    for low in (-0.3, gap):
        x = np.sort(np.concatenate([[0, 1], rng.uniform(0, 1, 24)]))
        k = np.arange(len(x) - 1) + count
        up = len(x)
        places += [np.stack([x, np.full(up, y)], axis=1) for y in (low, low + 0.3)]
        parts.append(np.concatenate([np.stack([k, k + 1, k + 1 + up], 1), np.stack([k, k + 1 + up, k + up], 1)]))
        count += 2 * up
    return np.concatenate(parts), np.concatenate(places)


def checked(F, uv, **options):
    """Make the air mesh and check its guarantees independently; return it, and the joint points and triangles."""
    before = uv.copy()
    air = triangulate_air(uv, boundary_loops(F, len(uv)), **options)
    assert np.array_equal(uv, before)
    points, triangles = np.concatenate([uv, air.points]), np.concatenate([F, air.F])
    verdict = certify(triangles, points)
    assert verdict.bijective, verdict.summary()
    # The only remaining boundary is the frame, so the air contains every boundary edge of the surface.
    (loop,) = verdict.loops
    assert set(loop.tolist()) == set(air.frame.tolist())
    assert set(np.unique(air.F)) >= set(len(uv) + np.arange(len(air.points)))
    return air, points, triangles


@pytest.fixture(params=["Qhull", "one by one"])
def way(request, monkeypatch):
    """Both methods for the initial triangulation."""
    if request.param == "one by one":
        monkeypatch.setattr(triangulating, "delaunay_by_qhull", lambda points: np.empty((0, 3), dtype=np.int64))
    return request.param


@pytest.mark.parametrize("surface", [disk(5), annulus(6), random_delaunay(200), grid(9, 3)])
def test_scaffold_surrounds_surfaces(surface, way):
    V, F = surface
    air, points, _ = checked(F, V[:, :2])
    corners = points[air.F] @ (1, 1j)
    sides = np.roll(corners, -1, axis=1) - corners
    angles = np.angle(np.roll(-sides, 1, axis=1) / sides)
    assert np.degrees(angles).min() > 15
    assert len(air.F) < 12 * sum(map(len, boundary_loops(F, len(V)))) + 400


def test_the_frame_has_the_given_distance():
    V, F = disk(6)
    far = np.array([[5.0, 0.0], [-1.0, 7.0]])
    for around, low, high in ((None, V.min(0), V.max(0)), (far, (-1, -1), (5, 7))):
        air, _, _ = checked(F, V[:, :2], margin=1.0, around=around)
        frame = air.points[air.frame - len(V)]
        longer = np.max(np.subtract(high, low))
        assert np.all(frame.min(0) <= np.asarray(low) - 0.99 * longer)
        assert np.all(frame.max(0) >= np.asarray(high) + 0.99 * longer)
        assert np.all(frame.max(0) <= np.asarray(high) + 1.5 * longer)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6, 1e-9])
def test_thin_gaps_are_filled(gap, way):
    F, uv = blocks(gap)
    checked(F, uv)


@pytest.mark.parametrize("seed", range(6))
def test_needles_bays_and_edges_of_any_length(seed, way):
    rng = np.random.default_rng(seed)
    angles = np.unique(np.concatenate([rng.uniform(0, 2 * np.pi, 40), 1 + np.cumsum(10.0 ** rng.uniform(-11, -2, 30))]))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.pi
    radii = np.exp(rng.normal(0, (0.1, 0.5, 1.5)[seed % 3], len(angles)))
    radii[:: 9 + seed] = 1e-6
    F, uv = fan(radii, angles)
    assert certify(F, uv).bijective
    checked(F, uv)


@pytest.mark.parametrize(("scale", "offset"), [(1e150, 0.0), (1e-150, 0.0), (1.0, 1e6)])
def test_the_unit_of_length_does_not_matter(scale, offset):
    F, uv = blocks(1e-2)
    checked(F, scale * uv + offset)


def test_is_deterministic():
    V, F = annulus(8)
    first, second = (triangulate_air(V, boundary_loops(F, len(V))) for _ in range(2))
    assert np.array_equal(first.points, second.points)
    assert np.array_equal(first.F, second.F)


def test_a_boundary_that_meets_itself_is_rejected():
    F, uv = blocks(1e-2)
    uv[len(uv) // 2 :, 1] -= 1e-2
    with pytest.raises(ValueError, match="meets itself"):
        triangulate_air(uv, boundary_loops(F, len(uv)))


def test_a_margin_must_be_positive():
    V, F = disk(3)
    with pytest.raises(ValueError, match="margin"):
        triangulate_air(V, boundary_loops(F, len(V)), margin=0)


def in_circles(points, triangles):
    """Keys of interior edges that violate the Delaunay condition."""
    n = len(points)
    apex = {(a, b): c for t in triangles.tolist() for a, b, c in (t, t[1:] + t[:1], t[2:] + t[:2])}
    for (a, b), c in apex.items():
        d = apex.get((b, a))
        if d is not None and a < b:
            rows = [[*(points[k] - points[d]), ((points[k] - points[d]) ** 2).sum()] for k in (a, b, c)]
            if np.linalg.det(rows) > 1e-12:
                yield int(edge_keys(np.array([a]), np.array([b]), n)[0])


def test_triangles_are_delaunay_except_at_segments(way):
    rng = np.random.default_rng(3)
    hull_angles = np.arange(12) * np.pi / 6
    hull = 3 * np.stack([np.cos(hull_angles), np.sin(hull_angles)], axis=1)
    points = np.concatenate([hull, rng.uniform(-1, 1, (100, 2))])
    # Two long chords that pass through no other point.
    points = np.concatenate([points, [[-1.5, 0.013], [1.5, 0.0117], [-1.4, 0.5], [1.4, 0.51]]])
    segments = np.array([[112, 113], [114, 115]])
    triangles = constrained_delaunay(points, segments, np.arange(12))
    assert is_injective(triangles, points)
    assert len(triangles) == 2 * len(points) - 2 - 12
    required = set(edge_keys(segments[:, 0], segments[:, 1], len(points)).tolist())
    found = edges(triangles, len(points))
    assert required <= set(edge_keys(*found.interior.T, len(points)).tolist())
    assert set(in_circles(points, triangles)) <= required


def test_a_point_on_a_segment_is_named(way):
    hull = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    points = np.concatenate([hull, [[-1, 0], [1, 0], [0.5, 0], [0.1, 0.4], [0.1, -0.4]]])
    with pytest.raises(BlockedError) as caught:
        constrained_delaunay(points, np.array([[4, 5]]), np.arange(4))
    assert caught.value.point == 6


def test_points_on_edges_and_outside_points():
    hull = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    on_diagonal = np.concatenate([hull, [[0, 0], [1, 1], [0.5, 0.5]]])
    triangles = Triangulation.of_points(on_diagonal, np.arange(4)).triangles()
    assert is_injective(triangles, on_diagonal)
    assert len(triangles) == 2 * 7 - 2 - 4
    for bad, message in (([3.0, 0], "outside"), ([2.0, 0], "outline"), ([-2.0, -2], "coincides")):
        with pytest.raises(ValueError, match=message):
            Triangulation.of_points(np.concatenate([hull, [bad]]), np.arange(4))


def test_squares_are_small_on_request_and_grow_by_a_factor_of_two():
    rng = np.random.default_rng(0)
    places, sizes = rng.uniform(0, 4, (30, 2)), 10.0 ** rng.uniform(-6, 0, 30)
    tree = Quadtree.around(places, sizes, np.zeros(2), 1.0, (4, 4))
    assert np.all(tree.sizes_at(places) <= sizes)
    level, x, y = tree.leaves()
    size = 0.5**level
    assert np.isclose((size**2).sum(), 16, rtol=1e-12)
    # The neighbour across each side is at most twice as large.
    for dx, dy in ((0.51, 0), (-0.51, 0), (0, 0.51), (0, -0.51)):
        beside = np.stack([(x + 0.5 + dx) * size, (y + 0.5 + dy) * size], axis=1)
        inside = np.all((beside > 0) & (beside < 4), axis=1)
        assert np.all(tree.sizes_at(beside[inside]) <= 2 * size[inside])
