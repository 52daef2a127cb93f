"""Disks mapped onto thin spirals: the search ends soon, and a construction is thinned only once."""

from __future__ import annotations

from quasiharmonic import Problem, Status, injective_map, quasi_harmonic_map
from quasiharmonic.solver.construction.constructing import constructions
from quasiharmonic.solver.search.stages import speed
from quasiharmonic.surfaces import disk
from quasiharmonic.targets import boundary_to
from shared.polygons import spiral


def spiral_problem(rings, corners, turns, width):
    V, F = disk(rings)
    return Problem(V, F, *boundary_to(V, F, spiral(corners, turns, width)))


def test_a_continued_descent_solves_a_spiral_of_four_turns():
    problem = spiral_problem(45, 80, 4, 0.8)
    result = injective_map(problem.V, problem.F, problem.fixed, problem.target, max_iterations=700)
    assert result.status is Status.INJECTIVE
    assert result.certificate.bijective
    assert result.added == 0


def test_few_slow_iterations_follow_on_a_large_disk():
    """Each takes as long as ten of the first descent; with the lists for smaller meshes there are 1300."""
    stages = speed(spiral_problem(45, 80, 4, 0.8))
    slow = [stage.begins_with for stage in stages if getattr(stage, "up_to", 1) < 0.01]
    assert sum(getattr(descent, "iterations", 0) for descent in slow) <= 200
    assert not {"Untangling", "Newton"} & {type(stage).__name__ for stage in stages}


def test_a_large_construction_is_the_only_one():
    problem = spiral_problem(30, 200, 5, 0.3)
    made = list(constructions(problem, quasi_harmonic_map(problem)))
    assert len(made) == 2
    assert len(made[0].refined.parents) > 1000 > len(made[1].refined.parents)
    assert made[-1].certificate.bijective
