"""The ladder: the mesh as given, then as few vertices added as need be; one for the library and the command."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import Problem, Status, boundary_loops, certify, injective_map, io
from quasiharmonic.solver.construction import constructing, cutting
from quasiharmonic.solver.methods import Newton, RandomRestarts, VectorAdam
from quasiharmonic.solver.refine import attempts as climbing
from quasiharmonic.solver.refine.attempts import solve_refining
from quasiharmonic.solver.search.strategy import soonest, speed, without_restarts
from quasiharmonic.surfaces import disk
from shared.commands import run
from shared.outlined import onto_polygon, with_holes
from shared.small_meshes import wheel
from shared.solvable import star_problem


def chevron():
    """Two triangles whose common edge leaves the target: it has to be split."""
    V = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return V, np.array([[0, 1, 2], [0, 2, 3]]), np.arange(4), np.array([[-1.0, -1.0], [0, 0], [1, -1], [0, 2]])


def test_the_mesh_as_given_comes_first():
    V, F = disk(4)
    (loop,) = boundary_loops(F, len(V))
    result = injective_map(V, F, loop, V[loop] * [2, 1], refine=True)
    assert result.certificate.bijective
    assert result.refined is None
    assert result.added == 0
    assert [(rung.name, rung.injective) for rung in result.refinement_attempts] == [("as given", True)]
    assert np.array_equal(result.uv, injective_map(V, F, loop, V[loop] * [2, 1]).uv)


def test_the_construction_is_asked_before_the_whole_search():
    """Where it adds no vertex, the climb ends with a map of the mesh as given, and only the first stages were run."""
    haste = [VectorAdam(iterations=1), Newton()]
    result = injective_map(*star_problem(depth=0.15, n=60), refine=True, strategy=haste)
    assert result.certificate.bijective
    assert result.refined is None
    assert [(rung.name, rung.injective, rung.added) for rung in result.refinement_attempts] == [
        ("as given", False, 0),
        ("constructed", True, 0),
    ]
    assert [stage.name for stage in result.stages] == [haste[0].name, "constructed"]


def test_vertices_are_added_where_there_is_no_map_without():
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


def test_a_polish_is_of_the_refined_mesh():
    V, F, fixed, target = chevron()
    result = injective_map(V, F, fixed, target, refine=True, polish="symmetric-dirichlet")
    assert result.status in (Status.POLISHED, Status.EXHAUSTED)
    assert result.certificate.bijective
    assert len(result.refined.V) == len(result.uv) > len(V)
    assert len(result.refinement_attempts) > 1


@pytest.mark.slow
def test_holes_and_pins_that_the_mesh_has_elsewhere():
    problem = with_holes(np.random.default_rng(0), 2, 2, size=7)
    result = solve_refining(problem, max_iterations=30)
    assert result.certificate.bijective
    assert np.array_equal(result.uv[problem.fixed], problem.target)


@pytest.fixture(scope="module")
def without_room():
    """A mesh, its fixed vertices next to each other in double precision, and what comes of it."""
    V, F = wheel(3)
    step = 2.0**-52
    target = np.array([[1, 1], [1 + step, 1], [1, 1 + step]])
    return V, F, target, injective_map(V, F, [0, 1, 2], target, refine=True)


@pytest.mark.slow
def test_doubles_without_room_are_told(without_room):
    result = without_room[-1]
    assert result.status is Status.PRECISION_LIMIT
    assert not result.injective
    assert set(result.crowded.tolist()) <= {0, 1, 2}
    assert result.crowded.size
    assert result.to_dict()["crowded"] == result.crowded.tolist()


def test_cutting_without_end_is_told(monkeypatch):
    """Pins in no order can take more vertices than there is room for: a limit, and a status of its own."""

    def cut(problem, guide, most):
        if most is not None:
            raise cutting.TooManyError
        return cutting.Cutting(problem, guide)

    monkeypatch.setattr(constructing, "Cutting", cut)
    problem = with_holes(np.random.default_rng(0), 2, 2, size=7)
    result = solve_refining(problem, max_iterations=1)
    assert result.status is Status.TOO_MANY_SPLITS
    assert not result.certificate.bijective
    assert (result.added, result.crowded.size) == (0, 0)
    assert np.array_equal(result.uv[problem.fixed], problem.target)
    assert np.array_equal(result.F, problem.F)


def test_targets_that_cross_themselves_are_as_before():
    """No refinement untwists a target, and what is told is about the mesh as it is given."""
    V, F = disk(3)
    (loop,) = boundary_loops(F, len(V))
    t = 2 * np.pi * np.arange(len(loop)) / len(loop)
    eight = np.stack([np.sin(2 * t), np.sin(t)], axis=1)
    result = injective_map(V, F, loop, eight, refine=True)
    assert result.status is Status.IMPOSSIBLE
    assert result.refined is None
    assert len(result.uv) == len(V)
    assert result.diagnosis.forbids_injective


def test_ctrl_c_on_any_rung():
    """What is handed back fits its own mesh, whenever the search is stopped."""
    V, F, fixed, target = chevron()
    seen = []
    injective_map(V, F, fixed, target, refine=True, callback=seen.append)
    for last in (1, len(seen) // 2, len(seen) - 1):
        left = iter(range(last))

        def stop(step, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt

        result = injective_map(V, F, fixed, target, refine=True, callback=stop)
        assert result.status is Status.INTERRUPTED
        assert len(result.uv) == len(V) + result.added


def interrupting(*_):
    raise KeyboardInterrupt


def test_no_restarts_while_a_constructed_map_is_in_hand(monkeypatch):
    """First what is quick, then the construction, then all of the search but its random restarts, and not for long."""
    problem, searches = onto_polygon(1, "grid"), []

    def solve(on, *, strategy, max_iterations, **options):
        searches.append((len(on.F), strategy, max_iterations))
        return searching(on, strategy=[VectorAdam(iterations=1)], max_iterations=1, **options)

    searching = climbing.solve
    monkeypatch.setattr(climbing, "solve", solve)
    result = solve_refining(problem)
    assert result.certificate.bijective
    (triangles, first, whole), *others = searches
    assert triangles == len(problem.F)
    assert first == soonest(speed(problem))
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
    """What is handed back is the best so far: not what was tried last, which may invert triangles."""

    haste = (VectorAdam(iterations=1), Newton(iterations=3))

    def check(self, problem, result):
        assert result.status is Status.INTERRUPTED
        assert result.certificate.bijective
        assert certify(result.F, result.uv, loops=problem.domain.loops).bijective
        assert len(result.uv) == problem.n + result.added
        assert np.array_equal(result.uv[problem.fixed], problem.target)
        assert [(rung.name, rung.added) for rung in result.refinement_attempts[-1:]] == [("constructed", result.added)]

    def test_after_the_construction(self):
        problem, first = onto_polygon(1, "grid"), []

        def stop(step):
            # Of every search the first step is its number 0, and the last one may be told again and again.
            if step.iteration == 0 and not any(step is other for other in first):
                first.append(step)
            if len(first) == 2 and step.iteration == 2:
                raise KeyboardInterrupt

        result = solve_refining(problem, strategy=self.haste, max_iterations=40, callback=stop)
        self.check(problem, result)
        assert first[0] in result.history
        assert first[1] in result.history
        assert "constructed" in [stage.name for stage in result.stages[:-1]]

    def test_while_vertices_are_taken_out(self, monkeypatch):
        monkeypatch.setattr(constructing, "thinned", interrupting)
        problem = onto_polygon(1, "grid")
        self.check(problem, solve_refining(problem, strategy=self.haste, max_iterations=40))

    def test_while_a_found_map_is_thinned(self, monkeypatch):
        monkeypatch.setattr(climbing, "thinned", interrupting)
        monkeypatch.setattr(climbing, "constructions", interrupting)
        monkeypatch.setattr(climbing, "is_simple", lambda problem: False)
        result = injective_map(*chevron(), refine=True)
        assert result.status is Status.INTERRUPTED
        assert result.certificate.bijective
        assert result.added


def test_an_energy_is_named_for_what_slides():
    V, F, fixed, target = chevron()
    with pytest.raises(ValueError, match="give an energy"):
        solve_refining(Problem(V, F, fixed, target), slide=True)


def test_the_command_climbs_the_same_ladder(tmp_path, capsys):
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


@pytest.mark.slow
def test_the_command_names_where_there_is_no_room(without_room, tmp_path, capsys, monkeypatch):
    V, F, target, result = without_room
    uv = np.vstack([target, [1, 1]])
    given = []
    monkeypatch.setattr(climbing, "solve_refining", lambda problem, **_: given.append(problem) or result)
    io.write_obj(tmp_path / "in.obj", io.MeshData(np.column_stack([V, np.zeros(4)]), F).with_map(uv))
    assert run("map", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--refine") == 1
    assert "double precision is insufficient" in capsys.readouterr().out
    # It takes seconds, and is done once.
    np.testing.assert_array_equal(given[0].target, target)
