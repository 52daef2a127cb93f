"""No obstruction is reported if a map exists: problems made by moving a mesh and keeping its boundary."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import Delaunay

from quasiharmonic import Problem, diagnose
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import edges
from quasiharmonic.results import Forbids, Kind
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from shared.infeasible_problems import OBSTRUCTED, moved, onto
from shared.meshes import bend, boundary_of
from shared.polygons import circle, spiral
from shared.small_meshes import loose_wheel, wheel


def positive(F, uv):
    return (orientation(uv[F[:, 0]], uv[F[:, 1]], uv[F[:, 2]]) > 0).all()


def pushed(F, uv, pins=()):
    """Return the problem that a map solves."""
    assert positive(F, uv)
    fixed = np.concatenate([boundary_of(F), np.asarray(pins, dtype=int)])
    return Problem(uv, F, fixed, uv[fixed], reference="equilateral")


def small_mesh(rng):
    """A few points on and in a circle, with chords and ears, and sometimes without some triangles."""
    ring = circle(int(rng.integers(3, 14)))
    V = np.concatenate([ring, 1.3 * (rng.random((int(rng.integers(1, 16)), 2)) - 0.5)])
    F = Delaunay(V).simplices.astype(np.int64)
    sign = orientation(V[F[:, 0]], V[F[:, 1]], V[F[:, 2]])
    F = np.where((sign < 0)[:, None], F[:, ::-1], F)[sign != 0]
    for _ in range(int(rng.integers(0, 3))):
        on_boundary = np.isin(F, edges(F, len(V)).boundary).any(axis=1)
        if not on_boundary.all():
            F = np.delete(F, rng.choice(np.flatnonzero(~on_boundary)), axis=0)
    return V, F


def wander(V, F, rng, sweeps):
    """Move one vertex after another far, while its triangles stay positive."""
    uv = V.copy()
    around = [F[(v == F).any(axis=1)] for v in range(len(V))]
    for v in np.tile(np.arange(len(V)), sweeps):
        here = uv[v].copy()
        reach = np.linalg.norm(uv[around[v]].reshape(-1, 2) - here, axis=1).max()
        for shrink in (2.0, 0.5, 0.1):
            uv[v] = here + shrink * reach * rng.normal(size=2)
            if positive(around[v], uv):
                break
            uv[v] = here
    return uv


@pytest.mark.parametrize("seed", range(32))
def test_wandering_vertices(seed):
    rng = np.random.default_rng(seed)
    V, F = small_mesh(rng)
    uv = wander(V, F, rng, int(rng.integers(1, 12)))
    if seed % 4 == 0 and positive(F, np.round(8 * uv) / 8):
        uv = np.round(8 * uv) / 8  # many points are collinear with others
    inner = np.setdiff1d(np.arange(len(V)), boundary_of(F))
    diagnosis = diagnose(pushed(F, uv, inner[rng.random(len(inner)) < 0.4 * (seed % 2)]))
    assert not diagnosis.forbids_injective, diagnosis.summary()
    assert {o.kind for o in diagnosis.obstructions} <= {Kind.CROSSING, Kind.TURNING_NUMBER, Kind.NESTING, Kind.FOLD}


@pytest.mark.parametrize("seed", range(6))
def test_smooth_maps(seed):
    rng = np.random.default_rng(seed)
    V, F = (random_delaunay(300, seed=seed), annulus(12), grid(12, 9))[seed % 3]
    inner = np.setdiff1d(np.arange(len(V)), boundary_of(F))
    diagnosis = diagnose(pushed(F, bend(V - V.mean(axis=0)), rng.choice(inner, 20, replace=False)))
    assert diagnosis.obstructions == (), diagnosis.summary()


@pytest.mark.parametrize("turns", [0.9, 1.3, 2.6])
def test_bands_around_a_circle_and_bands_that_overlap(turns):
    V, F = grid(int(24 * turns), 3)
    t, radius = -2 * np.pi * turns * V[:, 0], 1 + V[:, 1]
    diagnosis = diagnose(pushed(F, np.stack([radius * np.cos(t), radius * np.sin(t)], axis=1)))
    assert not diagnosis.forbids_injective, diagnosis.summary()
    assert {o.kind for o in diagnosis.obstructions} == ({Kind.CROSSING} if turns > 1 else set())


@pytest.mark.slow
@pytest.mark.parametrize("turns", [0.8, 2.3])
def test_spirals_that_fill_a_band(turns):
    V, F = grid(int(40 * turns), 3)
    t = 2 * np.pi * turns * V[:, 0]
    radius = 1 + t / (2 * np.pi) + 0.6 * (0.5 - V[:, 1])
    diagnosis = diagnose(pushed(F, np.stack([radius * np.cos(t), radius * np.sin(t)], axis=1)))
    assert diagnosis.obstructions == (), diagnosis.summary()


def test_branched_covers_are_maps_that_are_not_bijective():
    V, F = disk(6)
    diagnosis = diagnose(pushed(F, (V.view(complex) ** 2).view(float)))
    assert not diagnosis.forbids_injective
    (turning,) = (o for o in diagnosis.obstructions if o.kind is Kind.TURNING_NUMBER)
    assert turning.forbids is Forbids.UNBRANCHED


def test_fine_meshes_pass_through_any_corridor():
    V, F = disk(24)
    assert diagnose(onto((V, F), spiral(72, 2.2))).obstructions == ()


def test_hubs_with_a_kernel_are_not_reported():
    # A star sees all its corners from its centre only.
    star = circle(12) * np.where(np.arange(12) % 2, 0.2, 1.0)[:, None]
    assert diagnose(moved(wheel(12), star)).obstructions == ()
    assert diagnose(moved(loose_wheel(12), star)).obstructions == ()


@pytest.mark.parametrize("name", ["slit", "band over itself"])
def test_obstructions_to_bijective_maps_do_not_exclude_maps(name):
    problem, _ = OBSTRUCTED[name]
    assert not diagnose(problem).forbids_injective
