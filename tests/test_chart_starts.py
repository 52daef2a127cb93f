"""Nearly conformal maps of disks, and the initial maps of charts that they become."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic.apps.flattening.boundary_first import close_polygon, map_boundary_first
from quasiharmonic.apps.flattening.multilevel import map_to_disk
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.unwrapping import chart_starts
from quasiharmonic.apps.unwrapping.chart_starts import find_initial_map, repair_map
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.surfaces import disk
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.util.progress import time_limit
from shared.meshes import irregular_disk, lift, random_annulus


def fit(z, w):
    """The largest distance between points after the best rotation and translation, z onto w."""
    z, w = z - z.mean(), w - w.mean()
    turn = np.vdot(z, w)
    return np.abs(z * turn / abs(turn) - w).max()


def complex_of(points):
    return points @ np.array([1, 1j])


def energy_of(piece, uv):
    return piece.energy(SymmetricDirichlet(), None).value(in_units(piece.fit_scale(uv), 0))


def test_a_cap_of_a_sphere_is_projected_stereographically():
    """The conformal map of a cap onto the disk with the boundary's length is known."""
    errors = []
    for rings in (8, 16):
        P, F = disk(rings)
        polar = np.linalg.norm(P, axis=1, keepdims=True) * 1.2
        around = P / np.maximum(np.linalg.norm(P, axis=1, keepdims=True), 1e-300)
        V = np.concatenate([np.sin(polar) * around, np.cos(polar)], axis=1)
        uv = map_boundary_first(Piece(V, F))
        projected = np.sin(1.2) * np.tan(polar / 2) / np.tan(0.6) * around
        unit = 2.0 ** Piece(V, F).exponent
        errors.append(fit(unit * complex_of(uv), complex_of(projected)))
    assert errors[1] < 0.01
    assert errors[1] < 0.5 * errors[0]


def test_a_planar_surface_is_kept():
    P, F = irregular_disk(200, 4)
    P = P + 0.3 * np.sin(3 * P[:, ::-1])
    piece = Piece(P, F)
    assert fit(complex_of(map_boundary_first(piece)), complex_of(piece.V[:, :2])) < 1e-12


def test_surfaces_with_holes_are_not_mapped():
    V, F = random_annulus()
    assert map_boundary_first(Piece(V, F)) is None


def test_one_triangle_is_kept():
    V = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 1]])
    uv = map_boundary_first(Piece(V, [[0, 1, 2]]))
    sides = [np.linalg.norm(x - np.roll(x, -1, axis=0), axis=1) for x in (V, uv)]
    np.testing.assert_allclose(sides[0] / sides[1], sides[0][0] / sides[1][0], rtol=1e-12)


def test_polygons_are_closed_by_the_smallest_change(rng):
    for corners in (3, 4, 17):
        turning, length = rng.uniform(0.5, 1.5, corners), rng.uniform(0.5, 1.5, corners)
        turning *= 2 * np.pi / turning.sum()
        z = close_polygon(length, turning)
        side = np.roll(z, -1) - z
        t = np.exp(1j * (np.cumsum(turning) - turning[0]))
        changed = (side / t).real
        np.testing.assert_allclose(changed * t, side, atol=1e-12)
        # The change of least norm, in the metric of the lengths, that closes the polygon.
        root = np.sqrt(length)
        closing = np.stack([t.real, t.imag]) * root
        least = np.linalg.lstsq(closing, -np.stack([t.real, t.imag]) @ length, rcond=None)[0]
        np.testing.assert_allclose((changed - length) / root, least, atol=1e-12)


def test_the_initial_map_of_a_long_surface_is_better_than_one_to_a_disk():
    V, F = irregular_disk(400, 2)
    piece = Piece(lift(V) * [5, 1, 1], F)
    uv = find_initial_map(piece, "auto")
    assert is_injective(F, uv)
    assert energy_of(piece, uv) < 0.1 * energy_of(piece, map_to_disk(piece.V, F, piece.loops))


@pytest.mark.parametrize("reason", ["holes", "no factor", "inverted"])
def test_other_surfaces_are_mapped_to_a_disk(monkeypatch, reason):
    V, F = irregular_disk(100, 2)
    if reason == "holes":
        V, F = random_annulus()
    elif reason == "no factor":

        def fail(*_):
            raise NotPositiveDefinite("the matrix is not positive definite")

        monkeypatch.setattr(chart_starts, "map_boundary_first", fail)
    else:
        monkeypatch.setattr(chart_starts, "map_boundary_first", lambda piece, _: piece.V[:, [1, 0]])
    piece = Piece(lift(V), F)
    np.testing.assert_array_equal(find_initial_map(piece, "auto"), map_to_disk(piece.V, piece.F, piece.loops))


def folded():
    """A piece and a map of it in which few triangles are inverted around one vertex, with its index."""
    V, F = irregular_disk(400, 6)
    piece = Piece(V, F)
    uv = piece.V[:, :2].copy()
    inner = np.setdiff1d(np.arange(len(V)), np.concatenate(piece.loops))
    moved = inner[np.argmin(np.linalg.norm(uv[inner], axis=1))]
    ring = np.unique(F[(moved == F).any(axis=1)])
    uv[moved] += 1.5 * (uv[ring[ring != moved][0]] - uv[moved])
    assert 0 < np.count_nonzero(triangle_signs(F, uv)[0] <= 0) < 10
    return piece, uv, moved


@pytest.mark.parametrize("embedded", [True, False])
def test_the_surroundings_of_inverted_triangles_are_mapped_again(monkeypatch, embedded):
    if not embedded:
        monkeypatch.setattr(chart_starts, "embed_tutte", lambda F, w, fixed: w)
    piece, uv, moved = folded()
    before = uv.copy()
    repaired = repair_map(piece, uv)
    assert is_injective(piece.F, repaired)
    changed = (repaired != before).any(axis=1)
    assert changed[moved]
    assert 0 < np.count_nonzero(changed) < 60


def test_a_time_limit_ends_the_repair(monkeypatch):
    monkeypatch.setattr(chart_starts, "embed_tutte", lambda F, w, fixed: w)
    piece, uv, _ = folded()
    with time_limit(0) as limit, pytest.raises(KeyboardInterrupt):
        repair_map(piece, uv)
    assert limit.reached


@pytest.mark.parametrize("F", [[[0, 1, 2], [0, 2, 3]], [[0, 2, 1], [0, 3, 2]]])
def test_maps_without_vertices_to_move_are_not_repaired(F):
    """All vertices are at the boundary; one triangle or both are inverted."""
    V = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    bad = np.array([[0.0, 0], [1, 0], [1, 1], [2, 1]])
    assert repair_map(Piece(V, F), bad) is None
