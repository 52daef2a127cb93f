"""The composite of two maps through a disk: known properties, and the steps that it saves."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, boundary_loops, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.constrained_delaunay import triangulate_inside
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import Composite, VectorAdam
from quasiharmonic.solver.methods.vector_adam import composite_map, polygon_triangles
from quasiharmonic.surfaces import annulus, disk
from quasiharmonic.util.arrays import cyclic_pairs, to_points
from shared.solvable_problems import star_problem


def onto(outline, rings=10):
    """Return a disk and target positions of its boundary on an outline, given by a function of the angle."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    place = outline(np.arctan2(V[loop, 1], V[loop, 0]))
    return Problem(V, F, loop, np.stack([place.real, place.imag], axis=1))


def comma(angle):
    """Return a disk bent by three quarters of a turn, with one thin end."""
    x, y = np.cos(angle), np.sin(angle)
    return (2 - (0.5 - 0.4 * x) * y) * np.exp(2.4j * x)


@pytest.mark.parametrize("corners", [3, 4, 17, 200])
def test_a_polygon_is_covered_once_without_extra_corners(rng, corners):
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners)) if corners > 4 else np.arange(corners) * 2 * np.pi / corners
    outline = rng.uniform(0.2, 1, corners) * np.exp(1j * angle)
    F = polygon_triangles(outline)
    area = signed_areas(F, outline)
    assert len(F) == corners - 2
    assert area.min() > 0
    assert np.isclose(area.sum(), 0.5 * (outline.conj() * np.roll(outline, -1)).imag.sum())


@pytest.mark.parametrize("corners", [20, 200])
def test_a_polygon_has_the_delaunay_triangulation(rng, corners):
    """A sweep with flips, and Qhull with flips in a box, must agree, because the Delaunay triangulation is unique."""
    outline = rng.uniform(0.2, 1, corners) * np.exp(1j * np.sort(rng.uniform(0, 2 * np.pi, corners)))
    box = np.array([-2.0, -2.0]), np.array([2.0, 2.0])
    by_qhull = triangulate_inside(to_points(outline), cyclic_pairs(np.arange(corners)), *box)
    assert {tuple(np.roll(t, -t.argmin())) for t in by_qhull} == {
        tuple(np.roll(t, -t.argmin())) for t in polygon_triangles(outline)
    }


def test_crossing_or_clockwise_polygons_have_no_triangles():
    assert polygon_triangles(np.array([0, 1 + 1j, 1, 1j])) is None
    assert polygon_triangles(np.exp(-2j * np.pi * np.arange(5) / 5)) is None


def test_on_a_regular_polygon_it_is_tuttes_embedding():
    problem = onto(lambda angle: 3 * np.exp(1j * angle) + 2)
    objective = Objective(problem)
    tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex)).w
    np.testing.assert_allclose(composite_map(objective), tutte, atol=1e-12)


def test_fixed_vertices_are_at_their_targets_and_few_triangles_are_inverted():
    problem = onto(comma)
    objective = Objective(problem)
    w = composite_map(objective)
    assert np.array_equal(w[problem.fixed], problem.frame.inward(problem.target))
    tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
    assert objective.near_map(w).inverted < 0.2 * tutte.inverted


def test_not_defined_for_two_loops_pins_or_a_crossing_target():
    V, F = annulus()
    fixed = np.concatenate(boundary_loops(F, len(V)))
    assert composite_map(Objective(Problem(V, F, fixed, V[fixed]))) is None
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    assert composite_map(Objective(Problem(V, F, [*loop, 0], V[[*loop, 0], :2]))) is None
    assert composite_map(Objective(onto(lambda angle: np.cos(angle) + 1j * np.sin(2 * angle) + 0.1j))) is None


def test_without_a_composite_the_method_is_vector_adam(rng):
    V, F = annulus()
    outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    target = np.concatenate([V[outer], V[inner] @ [[0, 1], [-1, 0]]])
    problem = Problem(V, F, np.concatenate([outer, inner]), target)
    objective = Objective(problem)
    start = objective.evaluate(np.zeros(len(F), dtype=complex))
    one, other = (stage.iterates(objective, start) for stage in (Composite(iterations=9), VectorAdam(iterations=9)))
    for here, there in zip(one, other, strict=True):
        assert np.array_equal(here.w, there.w)


def test_it_takes_no_more_steps_than_requested():
    problem = onto(comma)
    objective = Objective(problem)
    start = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
    for count in (1, 3, 5, 7, 12):
        assert len(list(Composite(iterations=count).iterates(objective, start))) == count


@pytest.mark.slow
def test_it_solves_problems_that_are_slow_from_tuttes_embedding():
    problem = Problem(*star_problem(depth=0.1, points=7, n=1000))
    few = solve(problem, strategy=[Composite(iterations=100)])
    assert few.injective
    assert few.n_iterations <= 10
    assert not solve(problem, strategy=[VectorAdam(iterations=100)]).injective
