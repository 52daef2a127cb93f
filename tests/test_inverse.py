"""The inverse of a map, against rational arithmetic on every triangle."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from quasiharmonic import InverseMap, SurfaceMap, boundary_loops, distortion
from quasiharmonic.geometry.exact.point_location import NestedGrid
from quasiharmonic.geometry.exact.predicates import twice_area
from quasiharmonic.results import SurfacePoints
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from shared.exact import integers
from shared.meshes import bend, lift, random_annulus, signed_areas, surfaces


def exact_areas(x, y, ax, ay, bx, by, cx, cy):
    """Return twice the areas that a point forms with the edges opposite to three corners, of exact coordinates."""

    def twice(px, py, qx, qy):
        return (px - x) * (qy - y) - (py - y) * (qx - x)

    return twice(bx, by, cx, cy), twice(cx, cy, ax, ay), twice(ax, ay, bx, by)


def brute_force(F, uv, points):
    """Return the first closed triangle that contains each point, and the barycentric coordinates, by integers."""
    triangles, weights = [], []
    low, high = uv[F].min(axis=1), uv[F].max(axis=1)
    for p in points.tolist():
        for t in np.flatnonzero(((low <= p) & (p <= high)).all(axis=1)).tolist():
            corners = uv[F[t]].tolist()
            areas = exact_areas(*integers(*p, *corners[0], *corners[1], *corners[2]))
            if min(areas) >= 0:
                triangles.append(t)
                weights.append([a / sum(areas) for a in areas])
                break
        else:
            triangles.append(-1)
            weights.append([np.nan] * 3)
    return np.array(triangles), np.array(weights)


def tricky_points(F, uv, rng):
    """Return vertices, points on edges or an ulp beside them, points in triangles, and random points."""
    i, j = F[:, 0], F[:, 1]
    middles = uv[i] / 2 + uv[j] / 2
    toward = rng.choice([-np.inf, np.inf], size=middles.shape)
    low, high = uv.min(axis=0), uv.max(axis=0)
    anywhere = low + (high - low) * rng.uniform(-0.05, 1.05, (100, 2))
    inside = np.einsum("kc,kcx->kx", rng.dirichlet((1, 1, 1), len(F)), uv[F])
    near = np.nextafter(uv, np.roll(toward, 1, axis=1)[: len(uv)]) if len(uv) <= len(toward) else uv
    return np.concatenate([uv, near, middles, np.nextafter(middles, toward), inside, anywhere])


def maps():
    """Yield (name, F, uv): maps of small meshes, of all magnitudes."""
    V, F = random_delaunay(40, seed=5)
    ring, ring_faces = annulus(4)
    hole, hole_faces = random_annulus(60, seed=2)
    radius = np.hypot(*V.T)[:, None]
    yield "disk", F, V
    yield "bent", F, bend(V)
    yield "ring", ring_faces, ring
    yield "ring with a hole, at an offset", hole_faces, hole + 1e6
    yield "tiny", F, V * 1e-300
    yield "huge", F, V * 8e307
    yield "flat", F, V * [1e-200, 1e150]
    yield "graded", F, V * radius**12
    yield "slanted", F, (V * [1, 1e-9]) @ [[0.6, 0.8], [-0.8, 0.6]]


@pytest.mark.parametrize(("F", "uv"), [pytest.param(F, uv, id=name) for name, F, uv in maps()])
def test_agrees_with_brute_force(F, uv, rng):
    inverse = InverseMap(uv, F, uv)
    points = tricky_points(F, uv, rng)
    at = inverse.locate(points)
    triangle, barycentric = brute_force(F, uv, points)
    assert np.array_equal(at.triangle, triangle)
    assert set(np.sign(at.triangle)) >= {-1, 1}
    np.testing.assert_allclose(at.barycentric, barycentric, rtol=1e-9, atol=1e-12)
    # Products are exactly zero on edges; 1e-300 beside them they underflow.
    assert np.array_equal(at.barycentric == 0, barycentric < 1e-300)
    assert np.nanmin(at.barycentric) >= 0
    # The point returns to the plane within rounding and lies within the triangle's box.
    back, corners = inverse.plane(at)[at.found], uv[F[at.triangle[at.found]]]
    np.testing.assert_allclose(back, points[at.found], rtol=1e-15, atol=1e-15 * np.abs(uv).max())
    assert np.all((back >= corners.min(axis=1)) & (back <= corners.max(axis=1)))


def test_needles(rng):
    """A fan of needles, many per grid cell, around a vertex with 600 neighbours."""
    angle = np.linspace(0, 2 * np.pi, 601)[:-1]
    uv = np.concatenate([[[0.0, 0.0]], np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    rim = np.arange(600)
    F = np.stack([np.zeros(600, int), rim + 1, (rim + 1) % 600 + 1], axis=1)
    points = np.concatenate([rng.uniform(-1, 1, (60, 2)), uv[::20], uv[::20] / 2])
    at = InverseMap(uv, F, uv).locate(points)
    assert np.array_equal(at.triangle, brute_force(F, uv, points)[0])


@pytest.mark.parametrize(("name", "V", "F"), surfaces(), ids=[s[0] for s in surfaces()])
def test_identity(name, V, F, rng):
    uv = bend(V[:, :2])
    inverse = InverseMap(V, F, uv)
    triangle = rng.integers(len(F), size=4000)
    start = SurfacePoints(triangle, rng.dirichlet((1, 1, 1), 4000))
    at = inverse.locate(inverse.plane(start))
    surface = inverse.surface(start)
    np.testing.assert_allclose(inverse.surface(at), surface, rtol=0, atol=1e-13)
    assert np.array_equal(
        at.triangle[start.barycentric.min(axis=1) > 1e-9], triangle[start.barycentric.min(axis=1) > 1e-9]
    )
    # The other direction.
    places = inverse.plane(at)
    np.testing.assert_allclose(inverse.plane(inverse.locate(places)), places, rtol=0, atol=1e-15)


def test_error_is_that_of_rounding_in_the_map(rng):
    V, F = random_delaunay(1000, seed=4)
    for uv in (V * np.hypot(*V.T)[:, None] ** 5, V * [1, 1e-7] + [3, 0], bend(V)):
        inverse = InverseMap(V, F, uv)
        start = SurfacePoints(rng.integers(len(F), size=8000), rng.dirichlet((1, 1, 1), 8000))
        back = inverse.surface(inverse.locate(inverse.plane(start)))
        error = np.linalg.norm(back - inverse.surface(start), axis=1)
        shrunk = distortion(V, F, uv).sigma2[start.triangle]
        assert (error <= 10 * 2.0**-53 * (np.abs(uv).max() / shrunk + 1)).all()


@pytest.mark.slow
def test_graded_over_twelve_orders_of_magnitude(rng):
    V, F = random_delaunay(3000, seed=4)
    uv = V * np.hypot(*V.T)[:, None] ** 5
    areas = signed_areas(F, uv)
    assert areas.max() > 1e12 * areas.min() > 0
    inverse = InverseMap(V, F, uv)
    triangle = rng.integers(len(F), size=20_000)
    start = SurfacePoints(triangle, 0.9 * rng.dirichlet((1, 1, 1), 20_000) + 0.1 / 3)
    at = inverse.locate(inverse.plane(start))
    assert np.array_equal(at.triangle, triangle)
    np.testing.assert_allclose(at.barycentric, start.barycentric, atol=1e-6)
    # The lists of candidates stay short where the triangles are small.
    grid = NestedGrid(0.5 + 0.499 * uv[F])
    begin, end = grid.lists(0.5 + 0.499 * inverse.plane(start))
    assert (end - begin).mean() < 12
    assert len(grid.listed) < 20 * len(F)


def test_grid_lists_every_triangle_that_meets_the_cell(rng):
    V, F = random_delaunay(500, seed=1)
    unit = 0.5 + 0.499 * (V * np.hypot(*V.T)[:, None] ** 3)[F]
    grid = NestedGrid(unit)
    weights = rng.dirichlet((0.3, 0.3, 0.3), (len(F), 6))
    points = np.einsum("tkc,tcx->tkx", weights, unit).reshape(-1, 2)
    begin, end = grid.lists(points)
    for own, first, last in zip(np.repeat(np.arange(len(F)), 6), begin, end, strict=True):
        listed = grid.listed[first:last]
        assert own in listed
        assert np.all(np.diff(listed) > 0)


def test_hole_of_an_annulus_is_outside():
    V, F = annulus(8)
    at = InverseMap(V, F, V).locate(
        [[0.0, 0.0], [0.5, 0.0], [np.nextafter(0.5, 0), 0.0], [0.7, 0.7], [1.0, 1.0], [1.5, 0]]
    )
    assert at.found.tolist() == [False, True, False, True, True, False]


def test_values_normals_and_shapes():
    uv, F = disk(5)
    V = lift(uv)
    inverse = InverseMap(V, F, uv)
    at = inverse.locate(np.zeros((2, 5, 2)) + np.linspace(-0.6, 0.6, 5)[:, None])
    assert at.triangle.shape == (2, 5)
    assert at.barycentric.shape == (2, 5, 3)
    assert inverse.surface(at).shape == (2, 5, 3)
    linear = uv @ [[2.0], [-3.0]] + 1
    np.testing.assert_allclose(inverse.values(at, linear)[..., 0], inverse.plane(at) @ [2.0, -3.0] + 1, atol=1e-14)
    np.testing.assert_allclose(inverse.values(at, linear[F], per="corner"), inverse.values(at, linear), atol=1e-15)
    number = np.arange(len(F))
    assert np.array_equal(inverse.values(at, number, per="triangle"), at.triangle)
    a, b, c = V[F[at.triangle]].reshape(-1, 3, 3).swapaxes(0, 1)
    normals = inverse.normals(at).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    for edge in (b - a, c - a):
        np.testing.assert_allclose((normals * edge).sum(axis=1), 0, atol=1e-15)
    assert np.all(normals[:, 2] > 0)
    single = inverse.locate([0.1, 0.2])
    assert single.triangle.shape == ()
    assert inverse.surface(single).shape == (3,)


def test_labels_are_those_of_the_nearest_corner(rng):
    V, F = grid(4, 4)
    inverse = InverseMap(V, F, V)
    at = inverse.locate(rng.uniform(-0.1, 1.1, (200, 2)))
    labels = rng.integers(0, 1000, (len(V), 2))
    found = inverse.values(at, labels, nearest=True)
    for triangle, weights, value, corners in zip(
        at.triangle, at.barycentric, found, inverse.values(at, labels[F], per="corner", nearest=True), strict=True
    ):
        expected = labels[F[triangle, np.argmax(weights)]] if triangle >= 0 else [np.nan, np.nan]
        np.testing.assert_array_equal(value, expected)
        np.testing.assert_array_equal(corners, expected)
    fine, G = grid(9, 9)
    moved = SurfaceMap(InverseMap(fine, G, fine), inverse).transfer(labels, nearest=True)
    assert np.isin(moved, labels).all()


def test_nothing_is_outside():
    V, F = disk(3)
    inverse = InverseMap(V, F, V)
    at = inverse.locate([[2, 0], [np.nan, 0], [np.inf, 0], [0, -np.inf], [0, 0]])
    assert at.found.tolist() == [False] * 4 + [True]
    assert np.isnan(at.barycentric[:4]).all()
    assert np.isnan(inverse.surface(at)[:4]).all()
    assert np.isnan(inverse.plane(at)[:4]).all()
    assert np.isnan(inverse.values(at, np.arange(len(F)), per="triangle")[:4]).all()
    assert inverse.locate(np.empty((0, 2))).triangle.shape == (0,)


def test_vertices_are_their_own_corners():
    V, F = random_delaunay(30, seed=0)
    inverse = InverseMap(np.vstack([V, [[7, 7]]]), F, np.vstack([V, [[np.nan, 0]]]))
    at = inverse.vertices()
    assert np.array_equal(inverse.surface(at)[:-1], V)
    assert not at.found[-1]
    assert at.triangle[:-1].tolist() == [np.flatnonzero((v == F).any(axis=1))[0] for v in range(len(V))]
    assert np.array_equal(inverse.locate(V).triangle, at.triangle[:-1])


def test_inputs_of_any_type_are_not_changed():
    V, F = grid(4, 4)
    arrays = (V * 4).astype(np.float32), F.astype(np.uint16), (V * 4).astype(np.int32)
    before = [a.copy() for a in arrays]
    inverse = InverseMap(*arrays)
    at = inverse.locate(np.array([[1, 2], [4, 4]], dtype=np.int8))
    assert at.found.all()
    assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))
    assert all(a.flags.writeable for a in arrays)
    assert inverse.surface(at).dtype == np.float64


def test_sample_grid_includes_the_sides():
    uv, F = random_square()
    inverse = InverseMap(lift(uv), F, uv)
    u, v, at = inverse.sample_grid(33, 17)
    assert at.found.all()
    assert (u[0], u[-1], v[0], v[-1]) == (0, 1, 0, 1)
    np.testing.assert_allclose(inverse.plane(at), np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1), atol=1e-15)
    u, v, at = inverse.sample_grid(3, 3, box=(-0.5, 0.0, 0.5, 1.0))
    assert u.tolist() == [-0.5, 0.0, 0.5]
    assert at.found.tolist() == [[False] * 3, [True] * 3, [True] * 3]
    assert inverse.sample_grid(3, 3, box=(-1e308, 0, 1e308, 1))[0].tolist() == [-1e308, 0, 1e308]


def random_square(seed=3):
    """Return an irregular mesh of the unit square whose boundary lies exactly on its sides."""
    uv, F = grid(12, 9)
    inside = np.setdiff1d(np.arange(len(uv)), boundary_loops(F, len(uv))[0])
    uv[inside] += np.random.default_rng(seed).uniform(-0.02, 0.02, (inside.size, 2))
    return uv, F


def overlapping_strip():
    """Return a strip wound one and a half times around the origin."""
    V, F = grid(60, 2)
    angle, radius = 3 * np.pi * V[:, 0], 1 + V[:, 1]
    return F[:, ::-1], np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def test_overlapping_maps_are_rejected_by_default(rng):
    F, uv = overlapping_strip()
    with pytest.raises(ValueError, match=r"no inverse.*boundary.*overlapping=True"):
        InverseMap(uv, F, uv)
    inverse = InverseMap(uv, F, uv, overlapping=True)
    points = rng.uniform(-2, 2, (300, 2))
    at = inverse.locate(points)
    assert np.array_equal(at.triangle, brute_force(F, uv, points)[0])
    with pytest.raises(ValueError, match="the map of the target is not bijective"):
        SurfaceMap(InverseMap(*disk_map()), inverse)


def disk_map():
    V, F = disk(4)
    return V, F, V


def test_invalid_input_is_named():
    V, F = disk(3)
    folded = V.copy()
    folded[0] = [0.9, 0]
    with pytest.raises(ValueError, match=r"no inverse\. Not injective: of 54 triangles, \d are inverted"):
        InverseMap(V, F, folded, overlapping=True)
    with pytest.raises(ValueError, match="V must have as many rows as uv, 37, not 36"):
        InverseMap(V[:-1], F, V)
    inverse = InverseMap(V, F, V)
    with pytest.raises(ValueError, match=r"points must have shape \(\.\.\., 2\), not \(4, 3\)"):
        inverse.locate(np.zeros((4, 3)))
    at = inverse.locate(V)
    with pytest.raises(ValueError, match=r"begins with \(37,\), not \(54,\)"):
        inverse.values(at, np.zeros(54))
    with pytest.raises(ValueError, match="per must be one of vertex, corner, triangle"):
        inverse.values(at, V, per="face")
    with pytest.raises(ValueError, match="at refers to triangle 54, but there are only triangles 0 … 53"):
        inverse.surface(SurfacePoints(np.array([3, 54]), np.full((2, 3), 1 / 3)))
    with pytest.raises(ValueError, match="at refers to triangle 54, but there are only triangles 0 … 53"):
        inverse.plane(SurfacePoints(np.array([3, 54]), np.full((2, 3), 1 / 3)))
    with pytest.raises(ValueError, match="a planar surface has no normals"):
        inverse.normals(at)
    with pytest.raises(ValueError, match="columns must be an integer of at least 2, not 1"):
        inverse.sample_grid(1, 5)
    with pytest.raises(ValueError, match=r"rows must be an integer of at least 2, not 3\.5"):
        inverse.sample_grid(3, 3.5)
    for box in ((0, 0, 1), (0, 0, np.nan, 1), (0, 0, 1, np.inf), (1, 0, 0, 1), (0, 1, 1, 0)):
        with pytest.raises(ValueError, match="box must be finite: minimum u and v, then maximum u and v, not"):
            inverse.sample_grid(3, 3, box=box)


def test_transfer_between_meshes_of_one_square(rng):
    coarse, coarse_faces = random_square()
    fine, fine_faces = grid(40, 50)
    warp = np.stack([fine[:, 0], fine[:, 1] + 0.1 * np.sin(np.pi * fine[:, 0]) * fine[:, 1] * (1 - fine[:, 1])], axis=1)
    source, target = InverseMap(lift(coarse), coarse_faces, coarse), InverseMap(lift(fine), fine_faces, warp)
    partners = SurfaceMap(source, target)
    assert partners.onto
    assert partners.inverse().onto
    # Linear functions of the position are transferred exactly.
    np.testing.assert_allclose(partners.transfer(warp @ [1, -2.0]), coarse @ [1, -2.0], atol=1e-14)
    by_triangle = partners.transfer(np.arange(len(fine_faces)), per="triangle")
    assert np.array_equal(by_triangle, target.locate(coarse).triangle)
    # The inverse transfer, also from the boundary.
    start = source.vertices()
    there = partners(start)
    assert there.found.all()
    back = partners.inverse()(there)
    np.testing.assert_allclose(source.surface(back), lift(coarse), atol=1e-12)
    right = np.repeat(np.flatnonzero((coarse[coarse_faces, 0] == 1).sum(axis=1) == 2), 50)
    weights = rng.uniform(size=(right.size, 3)) * (coarse[coarse_faces[right], 0] == 1)
    weights /= weights.sum(axis=1, keepdims=True)
    assert np.any(weights.sum(axis=1) != 1)
    assert partners(SurfacePoints(right, weights)).found.all()


def test_images_that_differ_are_rejected():
    V, F = grid(4, 4)
    square = InverseMap(V, F, V)
    finer, finer_faces = grid(7, 7)
    assert SurfaceMap(square, InverseMap(finer, finer_faces, finer)).onto
    moved = finer.copy()
    moved[-1, 0] = np.nextafter(1, 2)
    assert not SurfaceMap(square, InverseMap(finer, finer_faces, moved)).onto
    wide = InverseMap(finer, finer_faces, 2 * finer - 0.5)
    partners = SurfaceMap(square, wide)
    assert not partners.onto
    assert np.isfinite(partners.transfer(finer)).all()
    back = partners.inverse().transfer(V)
    assert np.isnan(back).any()
    assert np.isfinite(back).any()


@pytest.mark.parametrize("scale", [1.0, 1e-200, 1e200])
def test_outside_points_use_the_nearest_boundary_point(rng, scale):
    """Compare with the distance to every boundary edge, sampled."""
    uv, F = disk(5)
    inverse = InverseMap(lift(uv), F, scale * uv)
    places = rng.uniform(-2, 2, (60, 2))
    places = places[np.abs(places).max(axis=1) > 1]
    near = inverse.nearest(scale * places)
    assert near.found.all()
    np.testing.assert_allclose(near.barycentric.sum(axis=1), 1)
    assert (near.barycentric == 0).any(axis=1).all()
    (rim,) = boundary_loops(F, len(uv))
    t = np.linspace(0, 1, 400)[:, None, None]
    samples = ((1 - t) * uv[rim] + t * uv[np.roll(rim, -1)]).reshape(-1, 2)
    least = np.linalg.norm(places[:, None] - samples, axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(inverse.plane(near) / scale - places, axis=1), least, atol=1e-4)
    # Points inside, and points that are NaN, have the usual result.
    inside = np.array([[0.1 * scale, 0.2 * scale], [np.nan, 0]])
    assert inverse.nearest(inside).triangle.tolist() == [inverse.locate(inside).triangle[0], -1]


def test_transfer_covers_the_boundary():
    V, F = disk(8)
    finer, finer_faces = disk(11)
    source, target = InverseMap(V, F, V), InverseMap(finer, finer_faces, finer)
    partners = SurfaceMap(target, source)
    heights = V @ [1.0, 2.0]
    assert np.isnan(partners.transfer(heights)).any()
    whole = partners.transfer(heights, outside="nearest")
    np.testing.assert_allclose(whole, finer @ [1, 2], atol=0.02)
    with pytest.raises(ValueError, match="outside must be one of"):
        partners.transfer(heights, outside="zero")


def test_twice_area_is_accurate(rng):
    """Corners that are collinear up to rounding, against fractions."""
    a, b = rng.uniform(-1, 1, (2, 400, 2))
    c = a + rng.uniform(0, 1, (400, 1)) * (b - a)
    c[::7] = a[::7]
    coordinates = np.concatenate([c, a, a, b], axis=1).tolist()
    exact = [float(exact_areas(*map(Fraction, row))[0]) for row in coordinates]
    area = twice_area(c, a, b)
    np.testing.assert_allclose(area, exact, rtol=1e-13, atol=0)
    assert np.array_equal(area == 0, np.array(exact) == 0)
    assert np.abs(area).max() < 1e-15


@pytest.mark.parametrize("scale", [1e-170, 1e170])
def test_normals_of_extreme_surfaces(scale):
    uv, F = grid(2, 2)
    inverse = InverseMap(lift(uv) * scale, F, uv)
    at = inverse.locate([[0.3, 0.4]])
    np.testing.assert_allclose(inverse.normals(at), InverseMap(lift(uv), F, uv).normals(at))
