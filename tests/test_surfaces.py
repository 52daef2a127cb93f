"""Procedural surfaces: sizes, areas, orientation, topology, no chords."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import surfaces
from quasiharmonic.geometry.mesh.topology import boundary_loops, components, edges

ALL = {
    "grid": surfaces.grid(4, 3),
    "smallest grid": surfaces.grid(2, 2),
    "alternating": surfaces.grid(5, 4, alternating=True),
    "annulus": surfaces.annulus(),
    "off-centre annulus": surfaces.annulus(5, hole=(-0.9, -0.2, 0.1, 0.95)),
    "smallest disk": surfaces.disk(1),
    "disk": surfaces.disk(7),
    "random": surfaces.random_delaunay(200, seed=3),
    "smallest random": surfaces.random_delaunay(4),
    "cat": surfaces.cat(12),
    "refined cat": surfaces.refine(*surfaces.cat(8)),
    "refined annulus": surfaces.refine(*surfaces.annulus(4)),
}


def normals(V, F):
    V = np.column_stack([V, np.zeros(len(V))]) if V.shape[1] == 2 else V
    return np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]) / 2


def area(V, F):
    return float(normals(V, F)[:, 2].sum())


def chords(F, n):
    found = edges(F, n)
    on_boundary = np.zeros(n, dtype=bool)
    on_boundary[found.boundary] = True
    return int(on_boundary[found.interior].all(axis=1).sum())


@pytest.mark.parametrize("name", ALL)
def test_surface_is_one_oriented_manifold_without_unused_vertices(name):
    V, F = ALL[name]
    assert V.dtype == np.float64
    assert F.dtype == np.int64
    found = edges(F, len(V))
    assert len(found.nonmanifold) == len(found.inconsistent) == 0
    assert np.array_equal(np.unique(F), np.arange(len(V)))
    assert np.ptp(components(F, len(V))) == 0
    loops = boundary_loops(F, len(V))
    euler = len(V) - len(found.interior) - len(found.boundary) + len(F)
    assert (euler, len(loops)) == ((0, 2) if "annulus" in name else (1, 1))


@pytest.mark.parametrize("name", [name for name in ALL if "cat" not in name])
def test_planar_triangles_are_counterclockwise(name):
    V, F = ALL[name]
    assert normals(V, F)[:, 2].min() > 0


@pytest.mark.parametrize("name", ALL)
def test_boundary_has_no_chords(name):
    V, F = ALL[name]
    assert chords(F, len(V)) == 0


@pytest.mark.parametrize("nx", range(2, 6))
@pytest.mark.parametrize("ny", range(2, 6))
@pytest.mark.parametrize("alternating", [False, True])
def test_grids(nx, ny, alternating):
    V, F = surfaces.grid(nx, ny, alternating=alternating)
    assert V[2 + (nx + 1)] == pytest.approx((2 / nx, 1 / ny))
    assert len(F) == 2 * nx * ny
    assert normals(V, F)[:, 2] == pytest.approx(np.full(len(F), 0.5 / (nx * ny)))
    assert chords(F, len(V)) == 0


def test_diagonals_alternate():
    # All four diagonals around an interior vertex meet it, or none.
    _, F = surfaces.grid(6, 6, alternating=True)
    degrees = np.bincount(F.ravel(), minlength=49).reshape(7, 7)[1:-1, 1:-1]
    i, j = np.indices(degrees.shape)
    # Next to the two corners whose diagonal was flipped, the count differs.
    inner = np.s_[1:-1, 1:-1]
    assert np.array_equal(degrees[inner], np.where((i + j) % 2 == 0, 8, 4)[inner])


def test_annulus_has_the_given_hole():
    V, F = surfaces.annulus(7, hole=(-0.9, -0.2, 0.1, 0.95))
    assert area(V, F) == pytest.approx(4 - 1.0 * 1.15)
    outer, inner = (V[loop] for loop in boundary_loops(F, len(V)))
    assert (outer.min(axis=0), outer.max(axis=0)) == (pytest.approx((-1, -1)), pytest.approx((1, 1)))
    assert (inner.min(axis=0), inner.max(axis=0)) == (pytest.approx((-0.9, -0.2)), pytest.approx((0.1, 0.95)))


def test_each_ring_of_a_disk_is_a_polygon_with_six_sides_per_ring_number():
    V, F = surfaces.disk(5)
    assert (len(V), len(F)) == (91, 150)
    assert area(V, F) == pytest.approx(15 * np.sin(2 * np.pi / 30))
    assert np.array_equal(boundary_loops(F, len(V))[0], np.arange(61, 91))


@pytest.mark.slow
def test_random_disks_have_no_chords_and_no_slivers():
    for n in (5, 8, 13, 21, 34, 55, 144, 377):
        for seed in range(4):
            V, F = surfaces.random_delaunay(n, seed)
            assert len(V) == n
            assert chords(F, n) == 0
            k = len(boundary_loops(F, n)[0])
            assert area(V, F) == pytest.approx(k / 2 * np.sin(2 * np.pi / k))
            corners = V[F]
            longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
            assert (normals(V, F)[:, 2] / longest**2).min() > 0.1


def test_the_seed_determines_the_surface():
    V, F = surfaces.random_delaunay(60, seed=1)
    W, G = surfaces.random_delaunay(60, seed=1)
    assert np.array_equal(V, W)
    assert np.array_equal(F, G)
    assert not np.array_equal(V, surfaces.random_delaunay(60, seed=2)[0])


@pytest.mark.slow
def test_the_cat_faces_the_viewer():
    V, F = surfaces.cat()
    assert (len(V), len(F)) == (7651, 15000)
    loop = boundary_loops(F, len(V))[0]
    assert np.array_equal(loop, np.arange(7351, 7651))
    assert np.abs(V[loop, 2]).max() < 1e-12
    # The vector area is that of the flat opening, towards the front, for any relief.
    opening = V[loop]
    x, y = opening[:, 0], opening[:, 1]
    assert area(V, F) == pytest.approx((x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)
    assert area(V, F) > 3
    assert np.linalg.norm(normals(V, F), axis=1).sum() == pytest.approx(8.137, abs=2e-3)
    # The ears are at the top, and both sides are equal.
    assert V[:, 1].max() > -V[:, 1].min() + 0.2
    assert V[:, 0].max() == pytest.approx(-V[:, 0].min(), rel=0.01)


def test_refining_keeps_area_and_splits_triangles_into_four():
    V, F = surfaces.disk(3)
    W, G = surfaces.refine(V, F)
    assert (len(G), len(W)) == (4 * 54, 37 + 90)
    assert np.array_equal(W[:37], V)
    whole, parts = normals(V, F)[:, 2], normals(W, G)[:, 2].reshape(-1, 4)
    assert parts == pytest.approx(np.repeat(whole[:, None] / 4, 4, axis=1))
    assert np.array_equal(G[0::4, 0], F[:, 0])
    assert np.array_equal(G[1::4, 1], F[:, 1])
    assert np.array_equal(G[2::4, 2], F[:, 2])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: surfaces.grid(1, 5), "nx must be an integer of at least 2, not 1"),
        (lambda: surfaces.annulus(1), "cells must be an integer of at least 2, not 1"),
        (lambda: surfaces.annulus(hole=(0, 0, 1, 0.5)), "not inside the square"),
        (lambda: surfaces.annulus(hole=(0.5, 0, 0.2, 0.5)), "empty"),
        (lambda: surfaces.disk(0), "rings must be an integer of at least 1, not 0"),
        (lambda: surfaces.cat(0), "rings must be an integer of at least 1, not 0"),
        (lambda: surfaces.annulus(hole=None), "hole must contain real numbers, not None"),
        (lambda: surfaces.annulus(hole=(0, 1)), "hole must be four numbers"),
        (lambda: surfaces.grid(2, 2, alternating="no"), "alternating must be True or False, not 'no'"),
        (lambda: surfaces.starfish(2.5), "arms must be an integer of at least 1, not 2.5"),
        (lambda: surfaces.random_delaunay(9, "seed"), "seed must be an integer of at least 0, not 'seed'"),
        (lambda: surfaces.refine(None, [[0, 1, 2]]), "V must contain real numbers, not None"),
        (lambda: surfaces.random_delaunay(3), "n must be an integer of at least 4, not 3"),
    ],
)
def test_impossible_sizes_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make()
