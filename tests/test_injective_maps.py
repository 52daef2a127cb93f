"""`injective_maps`: results of one call for many problems, compared with one call per problem."""

from __future__ import annotations

from itertools import count, islice

import numpy as np
import pytest

from quasiharmonic import Problem, Status, boundary_loops, injective_map, injective_maps, solve
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.solver.methods import Newton, VectorAdam
from quasiharmonic.solver.search import first_stage, many
from quasiharmonic.solver.search.first_stage import Patterns, run_first_stage
from quasiharmonic.solver.search.search import finish_search
from quasiharmonic.surfaces import disk, grid, random_delaunay
from quasiharmonic.util.options import MapOptions
from shared.exact import inverted
from shared.infeasible_problems import OBSTRUCTED
from shared.meshes import boundary_of
from shared.solvable_problems import star_problem, turned_ring


def ellipses(number, rings=4):
    """A disk mapped to ellipses."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    return [(V, F, loop, V[loop] * [1, 0.9 - 0.8 * k / number]) for k in range(number)]


def pinned():
    """A square whose centre is pinned elsewhere."""
    V, F = grid(6, 6)
    fixed = np.append(boundary_of(F), 24)
    target = V[fixed].copy()
    target[-1] += [0.2, 0.15]
    return V, F, fixed, target


def blob(n, seed):
    """A separate mesh that is mapped to its own boundary."""
    V, F = random_delaunay(n, seed=seed)
    loop = boundary_of(F)
    return V, F, loop, V[loop]


def mixed():
    """Problems of every kind: easy and hard, with holes and pins, planar and spatial."""
    backwards = star_problem(n=100)
    return [
        *ellipses(3),
        star_problem(n=200),
        turned_ring(60),
        pinned(),
        (*backwards[:3], backwards[3] * [1, -1]),
        star_problem(depth=0.2, points=7, n=400, seed=3),
        (np.eye(3)[:, :2], np.array([[0, 1, 2]]), [0, 1, 2], 5 * np.eye(3)[:, :2]),
        star_problem(n=1500),
        OBSTRUCTED["chord over a notch"][0],
    ]


def outline(result):
    """Return the report of a result, without times."""
    told = result.to_dict()
    del told["seconds"]
    return told | {"stages": [{**stage, "seconds": 0} for stage in told["stages"]]}


class TestAgreement:
    @pytest.mark.slow
    def test_each_result_is_as_for_a_single_call(self):
        problems = mixed()
        together = list(injective_maps(problems))
        for given, result in zip(problems, together, strict=True):
            alone = solve(given) if isinstance(given, Problem) else injective_map(*given)
            assert result.status is alone.status
            assert [stage.name for stage in result.stages] == [stage.name for stage in alone.stages]
            assert [step.inverted for step in result.history] == [step.inverted for step in alone.history]
            # At a map with relocated vertices, the energy is zero up to rounding.
            np.testing.assert_allclose(
                [step.energy for step in result.history], [step.energy for step in alone.history], rtol=1e-6, atol=1e-25
            )
            assert result.certificate.to_dict() == alone.certificate.to_dict()
            np.testing.assert_array_equal(result.V, alone.V)
            np.testing.assert_allclose(result.uv, alone.uv, atol=1e-9 * np.ptp(alone.uv))
            if result.mu is not None and result.injective:
                np.testing.assert_allclose(result.mu, alone.mu, atol=1e-6)
        assert [result.status for result in together].count(Status.INJECTIVE) == 9
        assert {Status.IMPOSSIBLE} == {together[6].status, together[-1].status}

    @pytest.mark.slow
    def test_maps_are_injective_and_respect_fixed_vertices(self):
        problems = ellipses(40)
        for (_, F, fixed, target), result in zip(problems, injective_maps(problems), strict=True):
            assert inverted(F, result.uv) == 0
            np.testing.assert_array_equal(result.uv[fixed], target)

    def test_the_number_of_threads_does_not_matter(self, monkeypatch):
        monkeypatch.setattr(many, "MAX_BATCH", 500)
        problems = [*ellipses(12), star_problem(n=150), turned_ring(40)]
        one, other = (list(injective_maps(problems, jobs=jobs)) for jobs in (1, 3))
        for a, b in zip(one, other, strict=True):
            assert outline(a) == outline(b)
            np.testing.assert_array_equal(a.uv, b.uv)

    @pytest.mark.slow
    def test_compacted_batches_continue_as_they_would_alone(self, monkeypatch):
        """Some problems of several batches, of one mesh or of many, remain after the first iterations."""
        monkeypatch.setattr(first_stage, "MAX_BATCH", 900)
        stars = [star_problem(depth=0.15, points=6, n=150, seed=seed) for seed in range(5)]
        V, F, fixed, target = stars[0]
        turned = [(V, F, fixed, target * [1, 0.5 + k / 10]) for k in range(5)]
        for problems in (ellipses(2) + stars, [Problem(V, F, fixed, target).with_target(one[3]) for one in turned]):
            posed = [given if isinstance(given, Problem) else Problem(*given) for given in problems]
            descent = VectorAdam(iterations=30, relocation=True)
            searches = run_first_stage(posed, descent, Patterns("auto"), MapOptions(max_iterations=1000))
            found = [finish_search(search, [descent]) for search in searches]
            assert max(len(one.history) for one in found) > 4
            for problem, one in zip(posed, found, strict=True):
                alone = solve(problem, strategy=[descent])
                assert [step.inverted for step in one.history] == [step.inverted for step in alone.history]
                np.testing.assert_allclose(
                    [step.energy for step in one.history],
                    [step.energy for step in alone.history],
                    rtol=1e-6,
                    atol=1e-25,
                )
                if alone.injective:
                    np.testing.assert_allclose(one.uv, alone.uv, atol=1e-9)

    def test_many_groups_preserve_their_order(self, monkeypatch):
        """A call takes 60 groups of one problem each."""
        for module in (many, first_stage):
            monkeypatch.setattr(module, "MAX_BATCH", 60)
        V, F, fixed, target = ellipses(1, 2)[0]
        problems = [(V, F, fixed, target * [1, 0.3 + k / 100]) for k in range(60)]
        for (*_, held), result in zip(problems, injective_maps(problems, jobs=2), strict=True):
            assert result.injective
            np.testing.assert_array_equal(result.uv[fixed], held)

    @pytest.mark.slow
    @pytest.mark.parametrize("rings", [4, pytest.param(2, marks=pytest.mark.nightly)])
    def test_a_stage_ends_where_it_does_alone(self, rings):
        """A pin outside the target: the descent stalls before its last iteration.

        Rounding decides in which one, and some solvers round a group's equations otherwise than those of one problem.
        """
        V, F = disk(rings)
        (loop,) = boundary_loops(F, len(V))
        problem = Problem(V, F, np.append(loop, 0), np.concatenate([V[loop], [[1.1, 0]]]))
        strategy = [VectorAdam(iterations=4000)]
        alone = solve(problem, strategy=strategy)
        for result in [alone, *injective_maps([problem, problem], strategy=strategy)]:
            assert len(result.stages) == len(alone.stages)
            # Between 600 and 1,710 were seen; a group that does not stall takes 4,000.
            assert 300 < result.stages[0].n_iterations < 3000
            assert result.n_iterations == sum(stage.n_iterations for stage in result.stages)
            assert result.status is alone.status
            first, same = ([step.energy for step in one.history[:30]] for one in (result, alone))
            np.testing.assert_allclose(first, same, rtol=1e-6)

    def test_settings_may_be_lists(self):
        strategy = [VectorAdam(schedule=[(0, 0.1)], momenta=[0.9, 0.999])]
        assert all(result.injective for result in injective_maps(ellipses(2), strategy=strategy))

    @pytest.mark.slow
    def test_the_search_continues_after_a_stage_without_success(self):
        """The history continues that of the common stage, and later stages run."""
        problems = [star_problem(depth=0.15, points=6, n=100, seed=seed) for seed in range(2)]
        strategy = [VectorAdam(iterations=2), Newton(iterations=100, resume=True)]
        results = list(injective_maps(problems, strategy=strategy))
        for given, result in zip(problems, results, strict=True):
            alone = injective_map(*given, strategy=strategy)
            assert len(result.stages) == 2
            assert result.stages[0].n_iterations == 2
            assert [step.inverted for step in result.history] == [step.inverted for step in alone.history]
            assert result.injective == alone.injective
        assert any(result.injective for result in results)

    def test_iterations_are_counted_over_both_parts(self):
        problem = star_problem(depth=0.05, points=9, n=300, seed=1)
        (result,) = injective_maps([problem], max_iterations=3)
        assert result.n_iterations == 3
        assert not result.injective

    def test_polish(self):
        problems = ellipses(3)
        for given, result in zip(problems, injective_maps(problems, polish="mips"), strict=True):
            alone = injective_map(*given, polish="mips")
            assert result.status is alone.status is Status.POLISHED
            np.testing.assert_allclose(result.history[-1].energy, alone.history[-1].energy, rtol=1e-9)

    def test_other_strategies_and_references(self):
        problems = ellipses(2)
        for options in ({"strategy": "paper"}, {"reference": "rest"}, {"strategy": [Newton(iterations=30)]}):
            for given, result in zip(problems, injective_maps(problems, **options), strict=True):
                np.testing.assert_array_equal(result.uv, injective_map(*given, **options).uv)

    def test_rounding_errors_of_one_problem_do_not_affect_others(self, monkeypatch):
        problems = [Problem(*arrays) for arrays in ellipses(5)]
        patterns, options = Patterns("auto"), MapOptions(max_iterations=100)

        def defeated(pattern, stiffness):
            raise NotPositiveDefinite("for once")

        with monkeypatch.context() as patch:
            patch.setattr(Laplacian, "factor", defeated)
            found = run_first_stage(problems, VectorAdam(iterations=5), patterns, options)
        assert found == [None] * 5
        factor, calls = Laplacian.factor, count()

        def defeated_once(pattern, stiffness):
            if next(calls) == 0:
                raise NotPositiveDefinite("for once")
            return factor(pattern, stiffness)

        with monkeypatch.context() as patch:
            patch.setattr(Laplacian, "factor", defeated_once)
            patch.setattr(first_stage, "MAX_BATCH", 2 * len(problems[0].F))
            found = run_first_stage(problems, VectorAdam(iterations=50), patterns, options)
        assert found[:2] == [None] * 2
        assert all(one.status is Status.INJECTIVE for one in found[2:])
        monkeypatch.setattr(many, "run_first_stage", lambda problems, *_: [None] * len(problems))
        assert all(result.injective for result in injective_maps(problems))


class TestStream:
    @pytest.mark.slow
    def test_problems_are_read_as_they_are_needed(self):
        read = count()
        endless = (ellipses(1)[0] for _ in read)
        assert [result.injective for result in islice(injective_maps(endless, jobs=1), 3)] == [True] * 3
        assert next(read) < 5000

    def test_no_problems(self):
        assert list(injective_maps([])) == []

    def test_equal_meshes_are_checked_once(self):
        copies = [tuple(np.array(part) for part in given) for given in ellipses(6)]
        for problems, meshes in ((copies, 1), ([*ellipses(2, 3), *ellipses(2, 4)], 2)):
            results = list(injective_maps(problems, jobs=1))
            assert all(result.injective for result in results)
            assert len({result.V.ctypes.data for result in results}) == meshes

    def test_progress_is_reported(self):
        told = []
        list(injective_maps(ellipses(5), callback=told.append))
        assert told[-1] == 5
        assert told == sorted(told)

    def test_an_exception_of_a_callback_ends_the_run(self):
        def tired(done):
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            list(injective_maps(ellipses(5), callback=tired))

    @pytest.mark.slow
    def test_closing_the_iterator_ends_the_work(self):
        hard = star_problem(depth=0.02, points=30, n=3000, seed=1)
        results = injective_maps([*ellipses(1), hard, hard], jobs=1)
        assert next(results).injective
        results.close()


class TestTrouble:
    def test_a_malformed_problem_is_named(self):
        V, F, fixed, target = ellipses(1)[0]
        results = injective_maps([(V, F, fixed, target), (V, F, fixed[1:], target[1:]), (V, F, fixed, target)])
        assert next(results).injective
        with pytest.raises(ValueError, match=r"problem 1: the boundary vertex 37 not in fixed"):
            next(results)

    def test_or_is_returned_as_an_error(self):
        V, F, fixed, target = ellipses(1)[0]
        broken = target.copy()
        broken[3] = np.nan
        first, second, third, fourth = injective_maps(
            [(V, F, fixed, broken), (V, F, fixed, target), (V, F), 7], errors="yield"
        )
        assert second.injective
        assert "problem 0: target is not finite at row 3" in str(first)
        for error, number in ((third, 2), (fourth, 3)):
            assert f"problem {number}: give each as a Problem, as V, F, fixed, target or as mesh, fixed, target" in str(
                error
            )

    def test_an_unknown_solver(self):
        with pytest.raises(ValueError, match=r"linear_solver must be one of auto, .*, not 'gauss'"):
            list(injective_maps(ellipses(2), linear_solver="gauss"))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"jobs": 0}, "jobs must be an integer of at least 1"),
            ({"errors": "ignore"}, "errors must be one of raise, yield"),
            ({"strategy": "haste"}, "strategy must be one of speed, paper"),
            ({"reference": "round"}, "reference must be one of equilateral"),
            ({"max_iterations": 0}, "max_iterations must be"),
            ({"polish": "shine"}, "shine"),
        ],
    )
    def test_invalid_options_are_rejected(self, options, message):
        with pytest.raises(ValueError, match=message):
            injective_maps([], **options)
