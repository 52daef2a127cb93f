"""Disks mapped onto thin spirals: the search ends soon, and a construction is thinned only once."""

from __future__ import annotations

from quasiharmonic import Problem, Status, injective_map, quasi_harmonic_map
from quasiharmonic.solver.construction import constructing
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


def test_of_two_large_constructions_the_smaller_one_is_thinned(monkeypatch):
    problem = spiral_problem(30, 200, 5, 0.3)
    thinned = []

    def counted(problem, refined, uv):
        thinned.append(len(refined.parents))
        return refined, uv

    monkeypatch.setattr(constructing, "thin_refinement", counted)
    made = list(constructions(problem, quasi_harmonic_map(problem)))
    assert made[-1].certificate.bijective
    assert thinned == [min(len(one.refined.parents) for one in made)]
