"""Constructions in patches around the inverted triangles of a map; the rest of the map stays."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, boundary_loops, injective_map
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.solver import refinement
from quasiharmonic.solver.construction.constructing import construct_patches, constructions
from quasiharmonic.solver.methods import Composite, LineShift
from quasiharmonic.surfaces import annulus, disk, grid
from quasiharmonic.targets import boundary_to
from shared.polygons import spiral
from shared.simple_targets import check_construction, onto_polygon


def folded(rings, centres, reach=0.08):
    """A disk onto itself, and its map with all vertices near some centres moved to the other side of these."""
    V, F = disk(rings)
    (rim,) = boundary_loops(F)
    uv = V.copy()
    for centre in centres:
        near = np.linalg.norm(V - centre, axis=1) < reach
        uv[near] = 2 * np.array(centre) - uv[near] * [1, -1]
    uv[rim] = V[rim]
    return Problem(V, F, rim, V[rim]), uv


@pytest.mark.parametrize(
    "centres", [[(0, 0)], [(0.5, 0.1), (-0.4, 0.3), (0.1, -0.6)], [(0.8, 0.0)], [(0, 0), (0.3, 0)]]
)
def test_only_the_surroundings_of_inverted_triangles_change(centres):
    problem, uv = folded(24, centres)
    given = uv.copy()
    assert inverted_triangles(problem.F, uv).size
    made = construct_patches(problem, uv)
    check_construction(problem, made)
    assert np.array_equal(uv, given)
    moved = np.flatnonzero((made.uv[: problem.n] != uv).any(axis=1))
    far = min(np.linalg.norm(problem.V[moved] - centre, axis=1).max() for centre in centres)
    assert 0 < moved.size < problem.n / 3 or len(centres) > 1
    assert far < 2
    whole = np.flatnonzero(np.bincount(made.refined.parent) == 1)
    assert {*map(tuple, problem.F.tolist())} >= {*map(tuple, made.refined.F[whole].tolist())}


def test_pins_inside_a_patch_stay():
    problem, uv = folded(20, [(0.2, 0.2)])
    inner = int(np.argmin(np.linalg.norm(problem.V - [0.25, 0.2], axis=1)))
    pinned = Problem(problem.V, problem.F, [*problem.fixed, inner], [*problem.target, problem.V[inner]])
    uv[inner] = problem.V[inner]
    check_construction(pinned, construct_patches(pinned, uv))


def test_a_patch_may_surround_a_hole():
    V, F = annulus(12)
    rim = np.concatenate(boundary_loops(F))
    problem = Problem(V, F, rim, V[rim])
    uv = V.copy()
    inside = np.setdiff1d(np.arange(len(V)), rim)
    uv[inside[:3]] = 0
    check_construction(problem, construct_patches(problem, uv))


def test_several_patches_add_vertices():
    """The vertices of patches are numbered one patch after another."""
    centres = (0.5, 0.5), (-0.5, -0.5)
    problem, uv = folded(40, centres)
    rng = np.random.default_rng(4)
    for centre in centres:
        near = np.flatnonzero(np.linalg.norm(problem.V - centre, axis=1) < 0.08)
        pins = rng.choice(near, 6, replace=False)
        uv[pins] = problem.V[rng.permutation(pins)]
        fixed = np.append(problem.fixed, pins)
        problem = Problem(problem.V, problem.F, fixed, uv[fixed])
    made = construct_patches(problem, uv)
    assert np.bincount((problem.V[made.refined.parents[:, 0], 0] > 0).astype(int)).min() > 1
    check_construction(problem, made)


@pytest.mark.parametrize("inverted", ["none", "all"])
def test_there_are_no_patches_around_no_or_all_triangles(inverted):
    problem, uv = folded(12, [(0.3, 0)], 0.15)
    assert construct_patches(problem, problem.V * ([1, 1] if inverted == "none" else [-1, 1])) is None
    assert construct_patches(problem, uv) is not None


def test_a_map_that_overlaps_itself_elsewhere_is_not_constructed_in_patches():
    V, F = grid(60, 5)
    angle, radius = 3 * np.pi * V[:, 0] / V[:, 0].max(), 2 - V[:, 1] / V[:, 1].max()
    uv = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    rim = np.concatenate(boundary_loops(F))
    problem = Problem(V, F, rim, uv[rim])
    assert not inverted_triangles(F, uv).size
    uv[np.setdiff1d(np.arange(len(V)), rim)[30]] = 0
    assert 0 < inverted_triangles(F, uv).size < 10
    assert construct_patches(problem, uv) is None


def test_a_spiral_gets_far_fewer_vertices_than_without_patches():
    V, F = disk(30)
    problem = Problem(V, F, *boundary_to(V, F, spiral(60, 2, 0.2)))
    strategy = [Composite(iterations=100, relocation=True), LineShift(resume=True)]
    result = injective_map(problem.V, problem.F, problem.fixed, problem.target, strategy=strategy)
    assert 0 < result.certificate.inverted.size < 10
    made = construct_patches(problem, result.uv)
    check_construction(problem, made)
    *_, whole = constructions(problem, result.uv)
    assert 10 * len(made.refined.parents) < len(whole.refined.parents)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["burst", "comb", "grid"])
def test_small_meshes_get_no_more_vertices_than_without_patches(kind, seed, monkeypatch):
    problem = onto_polygon(seed, kind)
    given = problem.V, problem.F, problem.fixed, problem.target
    result = injective_map(*given, refine=True, max_iterations=100)
    monkeypatch.setattr(refinement, "construct_patches", lambda problem, uv: None)
    assert result.added <= injective_map(*given, refine=True, max_iterations=100).added
