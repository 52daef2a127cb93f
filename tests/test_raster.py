"""Triangles at the centres of texels, and nearest points of surfaces, against all triangles."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.point_queries import NearestPoint, Raster
from quasiharmonic.surfaces import grid


def test_a_raster_against_barycentric_coordinates_of_every_texel():
    rng = np.random.default_rng(0)
    corners = rng.uniform(-5, 25, (30, 3, 2))
    corners[:5] = np.round(corners[:5]) + 0.5
    corners[5, 2] = corners[5, 1]
    raster = Raster(corners, 20, 15, np.arange(30) == 7)
    found = np.full((15, 20), -1)
    for begin, end in ((0, 4), (4, 15)):
        texel, triangle, weights = raster.rows(begin, end)
        found[begin:end].reshape(-1)[texel] = triangle
        row, column = np.divmod(texel, 20)
        centre = np.stack([column + 0.5, row + begin + 0.5], axis=1)
        assert np.abs(np.einsum("kc,kcd->kd", weights, corners[triangle]) - centre).max() < 1e-9
    for row in range(15):
        for column in range(20):
            inside = []
            for k, (a, b, c) in enumerate(corners):
                matrix = np.vstack([np.stack([a, b, c], axis=1), np.ones(3)])
                if k == 7 or abs(np.linalg.det(matrix)) < 1e-9:
                    continue
                if (np.linalg.solve(matrix, [column + 0.5, row + 0.5, 1]) > -1e-12).all():
                    inside.append(k)
            assert found[row, column] == min(inside, default=-1)


def test_nearest_points_against_all_triangles():
    """Triangles of very different sizes, one degenerate; distances by sampling each triangle finely."""
    uv, F = grid(6, 5)
    V = np.column_stack([uv, 0.1 * np.sin(7 * uv[:, 0])])
    V = np.vstack([V, [[0, 0, 3], [5, 0, 3], [0, 5, 3]]])
    n = len(V)
    F = np.vstack([F, [[n - 3, n - 2, n - 1], [0, 0, n - 1]]])
    points = np.random.default_rng(0).normal(0.5, 1.5, (60, 3))
    triangle, weights, distance = NearestPoint(V, F).find(points)
    found = np.einsum("kc,kcd->kd", weights, V[F[triangle]])
    assert np.allclose(np.linalg.norm(found - points, axis=1), distance)
    assert (weights >= 0).all()
    assert np.allclose(weights.sum(axis=1), 1)
    s = np.linspace(0, 1, 41)
    a, b = (one.ravel() for one in np.meshgrid(s, s))
    fine = np.stack([1 - a, a * (1 - b), a * b], axis=1)
    samples = np.einsum("sc,fcd->fsd", fine, V[F]).reshape(-1, 3)
    sampled = np.array([np.linalg.norm(samples - point, axis=1).min() for point in points])
    assert (distance <= sampled + 1e-12).all()
    assert (sampled - distance).max() < 0.1
