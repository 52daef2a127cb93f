"""The composite of two maps through a disk: against what is known of it, and what it saves."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, boundary_loops, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.constrained_delaunay import delaunay_of_polygon
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import Composite, VectorAdam
from quasiharmonic.solver.methods.composite import composite_map, polygon_triangles
from quasiharmonic.surfaces import annulus, disk
from shared.solvable import star_problem


def onto(outline, rings=10):
    """A disk and an outline, from an angle to a place, for its boundary."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    place = outline(np.arctan2(V[loop, 1], V[loop, 0]))
    return Problem(V, F, loop, np.stack([place.real, place.imag], axis=1))


def comma(angle):
    """A disk bent around by three quarters of a turn, thin at one end."""
    x, y = np.cos(angle), np.sin(angle)
    return (2 - (0.5 - 0.4 * x) * y) * np.exp(2.4j * x)


@pytest.mark.parametrize("corners", [3, 4, 17, 200])
def test_a_polygon_is_covered_once_without_further_corners(rng, corners):
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners)) if corners > 4 else np.arange(corners) * 2 * np.pi / corners
    outline = rng.uniform(0.2, 1, corners) * np.exp(1j * angle)
    F = polygon_triangles(outline)
    area = signed_areas(F, outline)
    assert len(F) == corners - 2
    assert area.min() > 0
    assert np.isclose(area.sum(), 0.5 * (outline.conj() * np.roll(outline, -1)).imag.sum())


@pytest.mark.parametrize("corners", [101, 200])
def test_few_corners_are_triangulated_as_many_are(rng, corners):
    """By a sweep and flips, and by Qhull and flips within a box: the Delaunay triangulation is one."""
    outline = rng.uniform(0.2, 1, corners) * np.exp(1j * np.sort(rng.uniform(0, 2 * np.pi, corners)))
    swept = delaunay_of_polygon(np.stack([outline.real, outline.imag], axis=1))
    assert {tuple(np.roll(t, -t.argmin())) for t in swept} == {
        tuple(np.roll(t, -t.argmin())) for t in polygon_triangles(outline)
    }


def test_what_meets_itself_or_runs_clockwise_has_no_triangles():
    assert polygon_triangles(np.array([0, 1 + 1j, 1, 1j])) is None
    assert polygon_triangles(np.exp(-2j * np.pi * np.arange(5) / 5)) is None


def test_onto_a_regular_polygon_it_is_tuttes_embedding():
    problem = onto(lambda angle: 3 * np.exp(1j * angle) + 2)
    objective = Objective(problem)
    tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex)).w
    np.testing.assert_allclose(composite_map(objective), tutte, atol=1e-12)


def test_fixed_vertices_are_in_their_places_and_few_triangles_inverted():
    problem = onto(comma)
    objective = Objective(problem)
    w = composite_map(objective)
    assert np.array_equal(w[problem.fixed], problem.frame.inward(problem.target))
    tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
    assert objective.near_map(w).inverted < 0.2 * tutte.inverted


def test_there_is_none_for_two_loops_or_pins_or_a_target_that_crosses_itself():
    V, F = annulus()
    fixed = np.concatenate(boundary_loops(F, len(V)))
    assert composite_map(Objective(Problem(V, F, fixed, V[fixed]))) is None
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    assert composite_map(Objective(Problem(V, F, [*loop, 0], V[[*loop, 0], :2]))) is None
    assert composite_map(Objective(onto(lambda angle: np.cos(angle) + 1j * np.sin(2 * angle) + 0.1j))) is None


def test_without_a_composite_it_is_vector_adam(rng):
    V, F = annulus()
    outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    target = np.concatenate([V[outer], V[inner] @ [[0, 1], [-1, 0]]])
    problem = Problem(V, F, np.concatenate([outer, inner]), target)
    objective = Objective(problem)
    start = objective.evaluate(np.zeros(len(F), dtype=complex))
    one, other = (stage.iterates(objective, start) for stage in (Composite(iterations=9), VectorAdam(iterations=9)))
    for here, there in zip(one, other, strict=True):
        assert np.array_equal(here.w, there.w)


def test_it_takes_no_more_steps_than_asked_for():
    problem = onto(comma)
    objective = Objective(problem)
    start = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
    for count in (1, 3, 5, 7, 12):
        assert len(list(Composite(iterations=count).iterates(objective, start))) == count


def test_it_solves_what_takes_long_from_tuttes_embedding():
    problem = Problem(*star_problem(depth=0.1, points=7, n=1000))
    few = solve(problem, strategy=[Composite(iterations=100)])
    assert few.injective
    assert few.iterations <= 10
    assert not solve(problem, strategy=[VectorAdam(iterations=100)]).injective
