"""Refinement: the mesh as given, then with as few new vertices as needed; the same for library and command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic import Problem, Status, boundary_loops, certify, injective_map, io, solve
from quasiharmonic.solver import refinement as climbing
from quasiharmonic.solver.construction import constructing, cutting
from quasiharmonic.solver.methods import Newton, RandomRestarts, VectorAdam
from quasiharmonic.solver.search.stages import quick_stages, speed, without_restarts
from quasiharmonic.surfaces import disk
from shared.commands import run
from shared.simple_targets import onto_polygon, with_holes
from shared.small_meshes import wheel
from shared.solvable_problems import star_problem


def chevron():
    """Two triangles whose common edge leaves the target and must be split."""
    V = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return V, np.array([[0, 1, 2], [0, 2, 3]]), np.arange(4), np.array([[-1.0, -1.0], [0, 0], [1, -1], [0, 2]])


def test_the_given_mesh_comes_first():
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    result = injective_map(V, F, loop, V[loop] * [2, 1], refine=True)
    assert result.certificate.bijective
    assert result.refined is None
    assert result.added == 0
    assert [(rung.name, rung.injective) for rung in result.refinement_attempts] == [("as given", True)]
    assert np.array_equal(result.uv, injective_map(V, F, loop, V[loop] * [2, 1]).uv)


@pytest.mark.slow
def test_the_construction_precedes_the_whole_search():
    """If it adds no vertex, refinement ends with a map of the given mesh after the first stages."""
    haste = [VectorAdam(iterations=1), Newton()]
    result = injective_map(*star_problem(depth=0.15, n=60), refine=True, strategy=haste)
    assert result.certificate.bijective
    assert result.refined is None
    assert [(rung.name, rung.injective, rung.added) for rung in result.refinement_attempts] == [
        ("as given", False, 0),
        ("constructed", True, 0),
    ]
    assert [stage.name for stage in result.stages] == [haste[0].name, "constructed"]


@pytest.mark.slow
def test_vertices_are_added_if_there_is_no_map_without_them():
    V, F, fixed, target = chevron()
    assert injective_map(V, F, fixed, target).status is Status.IMPOSSIBLE
    result = injective_map(V, F, fixed, target, refine=True)
    assert result.status is Status.INJECTIVE
    assert result.certificate.bijective
    assert certify(result.refined.F, result.uv).bijective
    assert np.array_equal(result.refined.V[: len(V)], V)
    assert np.array_equal(result.uv[fixed], target)
    assert result.added == len(result.uv) - len(V) == result.refinement_attempts[-1].added == 1
    assert not result.refinement_attempts[0].injective
    assert result.refinement_attempts[-1].injective
    told = result.to_dict()
    json.dumps(told)
    assert told["added_vertices"] == result.added
    assert [rung["name"] for rung in told["refinement_attempts"]] == [rung.name for rung in result.refinement_attempts]
    assert "refinement_attempts" not in injective_map(V, F, fixed, target).to_dict()


@pytest.mark.slow
def test_the_refined_mesh_is_polished():
    V, F, fixed, target = chevron()
    result = injective_map(V, F, fixed, target, refine=True, polish="symmetric-dirichlet")
    assert result.status in (Status.POLISHED, Status.EXHAUSTED)
    assert result.certificate.bijective
    assert len(result.refined.V) == len(result.uv) > len(V)
    assert len(result.refinement_attempts) > 1


@pytest.mark.long
def test_holes_and_pins_at_other_positions_than_in_the_mesh():
    problem = with_holes(np.random.default_rng(0), 2, 2, size=7)
    result = solve(problem, refine=True, max_iterations=30)
    assert result.certificate.bijective
    assert np.array_equal(result.uv[problem.fixed], problem.target)


@pytest.fixture(scope="module")
def without_room():
    """Return a mesh, its fixed vertices at adjacent doubles, and the expected status."""
    V, F = wheel(3)
    step = 2.0**-52
    target = np.array([[1, 1], [1 + step, 1], [1, 1 + step]])
    return V, F, target, injective_map(V, F, [0, 1, 2], target, refine=True, max_iterations=60)


@pytest.mark.long
def test_the_precision_limit_is_reported(without_room):
    result = without_room[-1]
    assert result.status is Status.PRECISION_LIMIT
    assert not result.injective
    assert set(result.crowded.tolist()) <= {0, 1, 2}
    assert result.crowded.size
    assert result.to_dict()["crowded"] == result.crowded.tolist()


def test_too_many_splits_are_reported(monkeypatch):
    """Pins in random order can need more vertices than the limit: there is a status for this."""

    def cut(problem, guide, most):
        if most is not None:
            raise cutting.TooManyError
        return cutting.Cutting(problem, guide)

    monkeypatch.setattr(constructing, "Cutting", cut)
    problem = with_holes(np.random.default_rng(0), 2, 2, size=7)
    result = solve(problem, refine=True, max_iterations=1)
    assert result.status is Status.TOO_MANY_SPLITS
    assert not result.certificate.bijective
    assert (result.added, result.crowded.size) == (0, 0)
    assert np.array_equal(result.uv[problem.fixed], problem.target)
    assert np.array_equal(result.F, problem.F)


@pytest.mark.slow
def test_targets_that_cross_themselves_are_not_refined():
    """No refinement solves such a target, and the result is about the given mesh."""
    V, F = disk(3)
    (loop,) = boundary_loops(F, len(V))
    t = 2 * np.pi * np.arange(len(loop)) / len(loop)
    eight = np.stack([np.sin(2 * t), np.sin(t)], axis=1)
    result = injective_map(V, F, loop, eight, refine=True)
    assert result.status is Status.IMPOSSIBLE
    assert result.refined is None
    assert len(result.uv) == len(V)
    assert result.diagnosis.forbids_injective


@pytest.mark.slow
def test_ctrl_c_in_any_attempt():
    """The returned map fits its own mesh, whenever the search is stopped."""
    V, F, fixed, target = chevron()
    seen = []
    injective_map(V, F, fixed, target, refine=True, callback=seen.append)
    # On a slow machine some steps are reported twice, so their numbers count.
    steps = max(step.iteration for step in seen)
    for last in (1, steps // 2, steps):
        left = iter(range(last))

        def stop(step, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt

        result = injective_map(V, F, fixed, target, refine=True, callback=stop)
        assert result.status is Status.INTERRUPTED
        assert len(result.uv) == len(V) + result.added


def interrupting(*_):
    raise KeyboardInterrupt


@pytest.mark.slow
def test_no_restarts_after_a_constructed_map(monkeypatch):
    """Quick stages, then the construction, then the whole search with a time limit and without random restarts."""
    problem, searches = onto_polygon(9, "grid"), []

    def search(on, options, repairs):
        searches.append((len(on.F), options.strategy, options.max_iterations))
        return search_map(on, replace(options, strategy=[VectorAdam(iterations=1)], max_iterations=1))

    search_map = climbing.search_map
    monkeypatch.setattr(climbing, "search_map", search)
    result = solve(problem, refine=True)
    assert result.certificate.bijective
    (triangles, first, whole), *others = searches
    assert triangles == len(problem.F)
    assert first == quick_stages(speed(problem))
    assert all(stage.coarse or stage.quick for stage in first[1:])
    assert len(first) < len(speed(problem))
    assert whole == 2000
    assert others
    for finer, stages, few in others:
        assert finer > triangles
        assert [stage.name for stage in stages] == [
            stage.name for stage in speed(problem) if not isinstance(stage, RandomRestarts)
        ]
        assert few == 600


def test_a_strategy_of_restarts_alone_keeps_them():
    assert without_restarts([RandomRestarts()]) == [RandomRestarts()]
    assert without_restarts([RandomRestarts(), Newton()]) == [Newton()]


class TestCtrlCWithAMapInHand:
    """The result is the best map so far, not the last trial, which may have inverted triangles."""

    haste = (VectorAdam(iterations=1), Newton(iterations=3))

    def check(self, problem, result):
        assert result.status is Status.INTERRUPTED
        assert result.certificate.bijective
        assert certify(result.F, result.uv, loops=problem.domain.loops).bijective
        assert len(result.uv) == problem.n + result.added
        assert np.array_equal(result.uv[problem.fixed], problem.target)
        assert [(rung.name, rung.added) for rung in result.refinement_attempts[-1:]] == [("constructed", result.added)]

    @pytest.mark.slow
    def test_after_the_construction(self):
        problem, first = onto_polygon(9, "grid"), []

        def stop(step):
            # The first step of every search has number 0, and the last one may be reported repeatedly.
            if step.iteration == 0 and not any(step is other for other in first):
                first.append(step)
            if len(first) == 2 and step.iteration == 2:
                raise KeyboardInterrupt

        result = solve(problem, refine=True, strategy=self.haste, max_iterations=40, callback=stop)
        self.check(problem, result)
        assert first[0] in result.history
        assert first[1] in result.history
        assert "constructed" in [stage.name for stage in result.stages[:-1]]

    def test_while_vertices_are_removed(self, monkeypatch):
        monkeypatch.setattr(constructing, "thin_refinement", interrupting)
        problem = onto_polygon(9, "grid")
        self.check(problem, solve(problem, refine=True, strategy=self.haste, max_iterations=40))

    def test_while_a_found_map_is_thinned(self, monkeypatch):
        monkeypatch.setattr(climbing, "thin_refinement", interrupting)
        monkeypatch.setattr(climbing, "constructions", interrupting)
        monkeypatch.setattr(climbing, "is_simple", lambda problem: False)
        result = injective_map(*chevron(), refine=True)
        assert result.status is Status.INTERRUPTED
        assert result.certificate.bijective
        assert result.added


def test_an_invalid_energy_is_named_for_sliding_vertices():
    V, F, fixed, target = chevron()
    with pytest.raises(ValueError, match="give an energy"):
        solve(Problem(V, F, fixed, target), refine=True, slide=True)


@pytest.mark.slow
def test_the_command_uses_the_same_refinement(tmp_path, capsys):
    V, F, fixed, target = chevron()
    uv = target
    io.write_obj(tmp_path / "in.obj", io.MeshData(np.column_stack([V, np.zeros(4)]), F).with_map(uv))
    assert run("map", tmp_path / "in.obj", "-o", tmp_path / "plain.obj") == 1
    capsys.readouterr()
    out = tmp_path / "out.obj"
    assert run("map", tmp_path / "in.obj", "-o", out, "--refine", "--json", tmp_path / "report.json") == 0
    report = json.loads((tmp_path / "report.json").read_text())
    expected = injective_map(V, F, fixed, target, refine=True)
    assert report["added_vertices"] == expected.added
    assert [rung["name"] for rung in report["refinement_attempts"]] == [
        rung.name for rung in expected.refinement_attempts
    ]
    assert "new vertices are at the end of the list" in capsys.readouterr().out
    written = io.read_mesh(out)
    assert len(written.V) == len(V) + expected.added
    assert np.array_equal(io.map_of(written)[fixed], target)
    assert certify(written.F, io.map_of(written)).bijective


@pytest.mark.long
def test_the_command_names_the_precision_limit(without_room, tmp_path, capsys, monkeypatch):
    V, F, target, result = without_room
    uv = np.vstack([target, [1, 1]])
    given = []
    monkeypatch.setattr(climbing, "search_refining", lambda problem, _: given.append(problem) or result)
    io.write_obj(tmp_path / "in.obj", io.MeshData(np.column_stack([V, np.zeros(4)]), F).with_map(uv))
    assert run("map", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--refine") == 1
    assert "double precision is insufficient" in capsys.readouterr().out
    # It takes seconds and runs once.
    np.testing.assert_array_equal(given[0].target, target)


def test_attempts_share_one_budget(monkeypatch):
    """Two boundary vertices at one position: no attempt finds a map, and each could spend a whole budget."""
    V, F = disk(2)
    V[15] = V[8]
    (loop,) = boundary_loops(F, len(V))
    search_map, budgets = climbing.search_map, []

    def search(on, options, repairs):
        budgets.append((options.max_iterations, repairs.left))
        repairs.left = 0
        return search_map(on, replace(options, strategy=[VectorAdam(iterations=5)]))

    monkeypatch.setattr(climbing, "search_map", search)
    result = solve(Problem(V, F, loop, V[loop]), refine=True, max_iterations=12)
    assert not result.injective
    iterations, repairs = zip(*budgets, strict=True)
    assert iterations[:2] == (12, 7)
    assert max(iterations[2:]) < 7
    assert repairs[0] > repairs[-1] > 0
    assert sum(repairs) <= 16 * 12
    assert result.n_iterations <= 12 + len(budgets)
