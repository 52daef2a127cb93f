"""Coarse meshes with coarse boundaries, and the prolongation of their maps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from quasiharmonic import Status, certify, distortion, find_cuts, flatten, is_injective
from quasiharmonic.apps.flattening import distance_descent, free_boundary
from quasiharmonic.apps.flattening import piece as pieces
from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.large_surfaces import lower_coarse_distance_error
from quasiharmonic.apps.flattening.multilevel import Hierarchy, Level, descend_level, flatten_coarse, map_to_disk
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.flattening.worst_triangles import smooth_map, thick_energy
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.mesh.topology import boundary_loops, edges
from quasiharmonic.surfaces import annulus, cat, grid, random_delaunay, starfish
from quasiharmonic.util.options import DistanceOptions


def in_space(V):
    return np.column_stack([V, np.zeros((len(V), 3 - V.shape[1]))])


def spiral():
    """A strip wound up in the plane, and an almost flat one."""
    square, F = grid(240, 6)
    angle, r = 14 * square[:, 0], 0.4 + 2 * square[:, 0] + 0.3 * square[:, 1]
    return np.stack([r * np.cos(angle), r * np.sin(angle), 0.03 * angle], axis=1), F


SURFACES = {"cat": cat(25), "annulus": annulus(24), "delaunay": random_delaunay(1500), "spiral": spiral()}


@pytest.fixture(params=SURFACES)
def surface(request):
    V, F = SURFACES[request.param]
    return in_space(V), F, boundary_loops(F, len(V))


def characteristic(F, n):
    found = edges(F, n)
    return n - len(found.interior) - len(found.boundary) + len(F)


def test_levels_are_surfaces_of_the_same_topology(surface):
    V, F, loops = surface
    hierarchy = Hierarchy(V, F, loops, 60)
    assert len(hierarchy.stops) > 2
    sizes = []
    for stop in hierarchy.stops:
        level = hierarchy.level(stop)
        sizes.append(level.vertices.size)
        found = edges(level.F, level.vertices.size)
        assert not found.nonmanifold.size
        assert not found.inconsistent.size
        assert len(level.loops) == len(loops)
        assert characteristic(level.F, level.vertices.size) == 2 - len(loops)
    assert sizes == sorted(sizes, reverse=True)
    # Most of the boundary vertices are removed.
    assert sum(map(len, level.loops)) < 0.5 * sum(map(len, loops))


def test_intermediate_levels_are_few_and_differ_in_size(surface):
    V, F, loops = surface
    hierarchy = Hierarchy(V, F, loops, 60)
    stations = hierarchy.select_stops(3.0)
    assert stations[-1] == 0
    assert set(stations) <= set(hierarchy.stops)
    sizes = [hierarchy.level(stop).vertices.size for stop in stations]
    assert all(large >= 3 * small for small, large in pairwise(sizes))


def test_a_guarded_prolongation_stays_bijective(surface):
    V, F, loops = surface
    hierarchy = Hierarchy(V, F, loops, 60)
    stop = hierarchy.stops[-1]
    level = hierarchy.level(stop)
    w = np.zeros(len(V), dtype=np.complex128)
    w[level.vertices] = in_units(map_to_disk(V[level.vertices], level.F, level.loops), 0)
    fine = hierarchy.prolong(w, stop, 0, np.ones(len(V), dtype=bool), 1e-9)
    assert certify(F, fine.view(np.float64).reshape(-1, 2)).bijective


def test_prolonging_again_places_the_vertices_that_change(surface):
    V, F, loops = surface
    hierarchy = Hierarchy(V, F, loops, 60)
    stop = hierarchy.stops[-1]
    level = hierarchy.level(stop)
    w = np.zeros(len(V), dtype=np.complex128)
    w[level.vertices] = in_units(map_to_disk(V[level.vertices], level.F, level.loops), 0)
    marked = np.zeros(len(V), dtype=bool)
    before = hierarchy.prolong(w, stop, 0, marked, 0.3)
    marked[np.concatenate(loops)[::3]] = True
    again = hierarchy.prolong(w, stop, 0, marked, 0.1, before)
    assert (again != before).any()
    np.testing.assert_allclose(again, hierarchy.prolong(w, stop, 0, marked, 0.1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("guarded", [False, True])
def test_finer_levels_of_an_isometric_map_that_overlaps_are_free_again(guarded):
    square, F = grid(120, 8)

    def ring(turn):
        angle, r = turn * square[:, 0], 1.5 - 0.5 * square[:, 1]
        return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)

    # The ring turns by more than a full turn, so its isometric map overlaps itself.
    V, loops = np.column_stack([ring(7), 0.02 * square[:, 0]]), boundary_loops(F, len(square))
    level = Level(0, np.arange(len(V)), V, F, loops)
    uv, needs_guard = descend_level(level, ring(6.1), "auto", guarded, 100)
    assert certify(F, uv, loops=loops).bijective
    assert needs_guard is guarded


def test_affine_maps_are_prolonged_exactly():
    V, F = random_delaunay(800)
    loops = boundary_loops(F, len(V))
    hierarchy = Hierarchy(in_space(V), F, loops, 100)
    stop = hierarchy.stops[-1]
    image = V @ [[1.1, 0.2], [-0.1, 0.9]] + (3, 4)
    w = np.zeros(len(V), dtype=np.complex128)
    coarse = hierarchy.level(stop).vertices
    w[coarse] = in_units(image[coarse], 0)
    fine = hierarchy.prolong(w, stop, 0, np.zeros(len(V), dtype=bool), 0.1)
    error = np.abs(fine - in_units(image, 0))
    # A similarity is slightly preferred to other affine maps.
    assert np.median(error) < 5e-3


@pytest.mark.slow
def test_coarse_starts_are_bijective_and_closer_to_the_result_than_a_disk(surface):
    V, F, loops = surface
    uv = flatten_coarse(V, F, loops)
    assert certify(F, uv).bijective
    energy = thick_energy(V, F)
    energy.energy = SymmetricDirichlet()
    here, disk = energy.value(in_units(uv, 0)), energy.value(in_units(map_to_disk(V, F, loops), 0))
    least = flatten(V, F).history[-1].energy
    assert here - least < 0.5 * (disk - least)


@pytest.mark.slow
def test_a_guarded_coarse_start_of_a_surface_that_would_overlap():
    square, F = grid(200, 6)
    angle, r = 7.2 * square[:, 0], 1 + 0.5 * square[:, 1]
    V = np.stack([r * np.cos(angle), r * np.sin(angle), 0.02 * angle], axis=1)
    for guarded in (False, True):
        uv = flatten_coarse(V, F, boundary_loops(F, len(V)), guarded=guarded)
        assert certify(F, uv).bijective


@pytest.mark.slow
def test_slivers_do_not_distort_a_coarse_start():
    # So many triangles were poor that none were improved: 99.5.
    rng = np.random.default_rng(2)
    square, F = grid(90, 30)
    inner = np.flatnonzero(((square > 0) & (square < 1)).all(axis=1))
    square[inner] += rng.uniform(-0.3, 0.3, (inner.size, 2)) / [90, 30]
    thin = rng.choice(inner, 30, replace=False)
    square[thin] = square[thin + 1] + 1e-3 * (square[thin] - square[thin + 1])
    V = np.column_stack([np.cos(3 * square[:, 0]), np.sin(3 * square[:, 0]), square[:, 1]])
    uv = flatten_coarse(V, F, boundary_loops(F, len(V)))
    assert certify(F, uv).bijective
    assert DeformationEnergy(V, F, SymmetricDirichlet()).value(in_units(uv, 0)) < 2


@pytest.mark.slow
def test_smoothing_opens_almost_closed_gaps():
    V, F = cat(20)
    loops = boundary_loops(F, len(V))
    uv = map_to_disk(V, F, loops)
    rng = np.random.default_rng(0)
    inner = np.setdiff1d(np.arange(len(V)), loops[0])
    # Some vertices lie almost on a neighbour.
    for v in rng.choice(inner, 20, replace=False):
        triangle = F[np.flatnonzero((v == F).any(axis=1))[0]]
        moved = uv.copy()
        moved[v] = uv[triangle].mean(axis=0) * 1e-4 + uv[triangle[triangle != v][0]] * (1 - 1e-4)
        if is_injective(F, moved):
            uv = moved
    energy = thick_energy(V, F)
    before = energy.value(in_units(uv, 0))
    after = smooth_map(V, F, loops, uv)
    assert certify(F, after).bijective
    assert energy.value(in_units(after, 0)) < before / 100


def cut_starfish(arms, rings, gain):
    """A closed surface with limbs, cut open: both sides of each seam have the same rest positions."""
    V, F = starfish(arms, rings)
    cut = SeamedMesh(V, F).cut(find_cuts(V, F, min_gain=gain)).opened()
    return cut.V / np.abs(cut.V).max(), cut.F


@pytest.mark.long
@pytest.mark.parametrize("arms", [3, pytest.param(5, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("guarded", [False, True])
def test_a_coarse_start_separates_the_two_sides_of_a_seam(arms, guarded):
    V, F = cut_starfish(arms, 20, 0.01)
    loops = boundary_loops(F, len(V))
    uv = flatten_coarse(V, F, loops, guarded=guarded)
    assert certify(F, uv).bijective
    # A vertex prolonged onto its copy on the other side left a gap of 1e-12, which no barrier opens.
    w = in_units(uv, 0)
    assert Rim(loops).contacts(w).smallest_gap(w) > 1e-4


# Above 50,000 triangles a surface is flattened by way of a coarse mesh.
@pytest.mark.long
@pytest.mark.parametrize(
    ("linear_solver", "rings"),
    [
        ("auto", 22),
        ("qdldl", 22),
        pytest.param("auto", 66, marks=pytest.mark.nightly),
        pytest.param("qdldl", 66, marks=pytest.mark.nightly),
    ],
)
def test_a_large_surface_with_limbs_does_not_collapse(linear_solver, rings, monkeypatch):
    if rings < 66:
        for module in (pieces, free_boundary):
            monkeypatch.setattr(module, "COARSE_FROM", 4_000)
    V, F = cut_starfish(3, rings, 0.1)
    assert len(F) >= pieces.COARSE_FROM
    result = flatten(V, F, linear_solver=linear_solver)
    assert result.certificate.bijective
    assert result.status is Status.POLISHED
    assert distortion(V, F, result.uv).statistics("isometric").maximum < 10


def test_an_interrupt_before_the_first_step_for_distances_leaves_a_recorded_map(monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(distance_descent, "descend", interrupted)
    V, F = grid(24, 24)
    piece = Piece(np.column_stack([V, 0.3 * np.sin(7 * V[:, 0])]), F)
    options = DistanceOptions(rings=13, record_every=1)
    found = lower_coarse_distance_error(piece, options, least=200)
    assert found.status is Status.INTERRUPTED
    assert found.certificate.bijective
    assert [snapshot.iteration for snapshot in found.path] == [0]
