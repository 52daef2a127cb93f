"""`solve` where no map exists, with every linear solver, in threads and in copies."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import quasiharmonic
import quasiharmonic.linsolve
from quasiharmonic import InverseMap, Problem, Status, boundary_loops, injective_map, quasi_harmonic_map, solve
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.solver.methods import LBFGS, Alternating, LocalRepair, Newton, RandomRestarts, Untangling, VectorAdam
from quasiharmonic.solver.methods.untangling import untangle
from quasiharmonic.solver.search.stages import CoarseToFine, OnlyIf, quick_stages, speed
from quasiharmonic.surfaces import disk, grid, random_delaunay
from shared.infeasible_problems import OBSTRUCTED
from shared.meshes import boundary_of, signed_areas
from shared.solvable_problems import star_problem, turned_ring


class TestNoMap:
    def test_wrong_winding(self):
        V, F, fixed, target = star_problem(n=80)
        result = injective_map(V, F, fixed, target * [1, -1])
        assert not result.injective
        assert result.status is Status.IMPOSSIBLE
        assert result.diagnosis.forbids_injective
        assert result.n_iterations <= 1
        assert np.all(np.isfinite(result.uv))
        assert len(result.certificate.inverted) > 0
        np.testing.assert_array_equal(result.uv[fixed], target * [1, -1])

    @pytest.mark.slow
    @pytest.mark.parametrize("reference", [None, "rest", "corrected"])
    @pytest.mark.parametrize("squash", [(0, 0), (1, 0), (1, 1e-200), (1e-300, 1e-300)])
    def test_target_without_area(self, squash, reference):
        V, F, fixed, target = star_problem(n=50)
        for shift in (0, 3):
            result = injective_map(V, F, fixed, target * squash + shift, reference=reference)
            assert result.status is not Status.OUT_OF_ITERATIONS
            # Any area suffices, if the spacing of doubles around it is fine enough.
            assert result.injective == (squash[1] > 0 and not shift)

    @pytest.mark.slow
    def test_the_map_of_least_area_is_returned(self):
        """On an uneven eight, no map covers less area than its two lobes."""
        V, F = disk(9)
        (loop,) = boundary_loops(F, len(V))
        t = 2 * np.pi * np.arange(len(loop)) / len(loop)
        eight = np.stack([np.cos(t), 0.5 * np.sin(2 * t) + 0.25 * np.sin(t)], axis=1)
        result = injective_map(V, F, loop, eight)
        assert result.status is Status.IMPOSSIBLE
        # Midpoint sums over t, split where the curve crosses itself: at cos t = -1/4.
        s = 2 * np.pi * (np.arange(100_000) + 0.5) / 100_000
        density = (
            np.pi
            / 100_000
            * (np.cos(s) * (np.cos(2 * s) + 0.25 * np.cos(s)) + np.sin(s) * (0.5 * np.sin(2 * s) + 0.25 * np.sin(s)))
        )
        left = np.cos(s) < -0.25
        lobes = abs(density[left].sum()) + abs(density[~left].sum())
        assert 0.5 * np.abs(signed_areas(F, result.uv)).sum() == pytest.approx(lobes, rel=0.02)
        assert result.certificate.inverted.size > 0
        # Its tensors reproduce the map, as for an injective one.
        again = quasi_harmonic_map(Problem(V, F, loop, eight), result.mu, reference=result.reference)
        np.testing.assert_allclose(again, result.uv, atol=1e-9)

    def test_no_free_vertex(self):
        """A reversed corner triangle: two triangles, all four vertices fixed."""
        result = injective_map(
            [[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]], range(4), [[0, 0], [1, 0], [-0.2, 0.5], [0, 1]]
        )
        assert result.certificate.inverted.tolist() == [1]
        assert result.status is Status.IMPOSSIBLE
        assert result.n_iterations < 300

    @pytest.mark.slow
    def test_impossible_pins_are_diagnosed(self):
        """Two pins of one triangle are swapped, so that it is always inverted."""
        V, F = random_delaunay(80, seed=3)
        rim = boundary_of(F)
        inner = next(t for t in F if not np.isin(t, rim).any())
        result = injective_map(V, F, np.append(rim, inner), np.vstack([V[rim], V[inner[[1, 0, 2]]]]))
        assert result.status is Status.IMPOSSIBLE
        assert result.history[-1].energy > 1e-3
        assert result.diagnosis.forbids_injective
        named = np.concatenate([o.triangles for o in result.diagnosis.obstructions])
        assert any(np.array_equal(np.sort(F[t]), np.sort(inner)) for t in named)

    @pytest.mark.slow
    def test_stalls_where_no_vertex_moves(self):
        """The alternation stalls at once far from a solution (§7.1)."""
        result = injective_map(*turned_ring(180), strategy=[Alternating(iterations=10**6)])
        assert result.status is Status.STALLED
        assert result.history[-1].energy > 1e-3
        assert not result.diagnosis.obstructions

    @pytest.mark.long
    def test_local_repair_has_a_limit(self, monkeypatch):
        """Almost nothing is inverted, and no number of restarts helps."""
        V, F = disk(2)
        V[15] = V[8]
        steps, factor = [], NewtonSystem.factor

        def counted(system, *shift):
            steps.append(system)
            assert len(steps) < 15_000, "it does not end"
            factor(system, *shift)

        monkeypatch.setattr(NewtonSystem, "factor", counted)
        loop = boundary_of(F)
        strategy = [VectorAdam(iterations=50), RandomRestarts(resume=True, max_failures=10**6)]
        result = injective_map(np.c_[V, 0 * V[:, 0]], F, loop, V[loop], strategy=strategy, max_iterations=60)
        assert result.status is Status.STALLED
        assert result.n_iterations <= 60
        assert len(steps) > 100

    @pytest.mark.parametrize("wrong", [0, -5, 2.5, "many", np.nan])
    def test_invalid_number_of_iterations(self, wrong):
        with pytest.raises(ValueError, match="max_iterations must be an integer"):
            injective_map(*star_problem(n=60), max_iterations=wrong)

    def test_a_given_strategy_that_ends_early_has_not_stalled(self):
        result = injective_map(*turned_ring(180), strategy=[VectorAdam(iterations=3)])
        assert result.status is Status.OUT_OF_ITERATIONS

    @pytest.mark.parametrize(
        ("start", "words"),
        [
            ("here", "start must contain real numbers"),
            (np.zeros((80, 2), dtype=complex), "start must contain real numbers"),
            ([[0.0], [1.0, 2.0]], "start is not an array"),
            (np.zeros((80, 3)), r"start must have shape \(80, 2\)"),
            (np.full((80, 2), np.inf), "start is not finite at vertices 0, 1"),
        ],
    )
    def test_invalid_start(self, start, words):
        with pytest.raises(ValueError, match=words):
            injective_map(*star_problem(n=80), start=start)

    @pytest.mark.parametrize("size", [1e-320, 1e-200, 1e200, 1e308])
    def test_start_of_any_size(self, size, rng):
        """Only the shape matters."""
        problem = Problem(*star_problem(n=80))
        far = size * rng.uniform(-1, 1, (problem.n, 2))
        assert solve(problem, start=far).injective

    @pytest.mark.parametrize(
        "method", [VectorAdam, LBFGS, Newton, Alternating, Untangling, LocalRepair, RandomRestarts]
    )
    def test_no_method_exceeds_its_iterations(self, method):
        V, F = disk(12)
        (loop,) = boundary_loops(F, len(V))
        t = 2 * np.pi * np.arange(len(loop)) / len(loop)
        bean = (1 + 0.95 * np.cos(3 * t))[:, None] * np.stack([np.cos(t), np.sin(t)], axis=1)
        problem = Problem(V, F, loop, bean)
        assert len(solve(problem, max_iterations=1).certificate.inverted) > 50, "too few"
        for most in (1, 3):
            result = solve(problem, strategy=[method()], max_iterations=most)
            assert result.n_iterations <= most

    @pytest.mark.slow
    def test_l_bfgs_counts_iterations_within_a_line_search(self):
        """Where nothing lowers the energy, line searches are long."""
        problem, _ = OBSTRUCTED["chord over a notch"]
        for most in (20, 35, 50):
            result = solve(problem, strategy=[LBFGS(iterations=most)])
            assert result.stages[0].n_iterations <= most

    @pytest.mark.slow
    def test_untangling_stops_if_all_vertices_coincide(self, monkeypatch):
        """No ε is far below a determinant of zero."""
        V, F = grid(4, 4)
        inner = next(t for t in F if not np.isin(t, boundary_of(F)).any())
        w = V[:, :2].ravel().view(np.complex128).copy()
        w[inner] = 0.5 + 0.5j
        held = np.append(boundary_of(F), inner)
        steps = []
        factor = NewtonSystem.factor

        def counted(system, *shift):
            steps.append(system)
            assert len(steps) < 5000, "it does not end"
            factor(system, *shift)

        monkeypatch.setattr(NewtonSystem, "factor", counted)
        assert len(list(untangle(F, w, held, grading=0.0))) < 2000
        assert steps

    def test_interrupted_untangling_has_not_stalled(self):
        result = injective_map(*turned_ring(180), strategy=[Untangling(iterations=2)])
        assert result.status is Status.OUT_OF_ITERATIONS

    @pytest.mark.parametrize(
        ("limits", "runs"), [({}, 1), ({"above": 0.02}, 1), ({"above": 1}, 0), ({"up_to": 0.002}, 0), ({"up_to": 1}, 1)]
    )
    def test_a_stage_runs_only_if_the_fraction_of_inverted_triangles_is_in_its_range(self, limits, runs):
        problem = Problem(*turned_ring(180))
        result = solve(
            problem, strategy=[VectorAdam(iterations=1), OnlyIf(Newton(iterations=2, resume=True), **limits)]
        )
        assert result.stages[0].inverted[1] > 0.02 * len(problem.F)
        assert [stage.name for stage in result.stages] == ["vector-adam, tanh, dirichlet"] + runs * ["newton, tanh"]

    def test_the_descent_continues_on_large_meshes_with_many_inverted_triangles(self):
        V, F = disk(45)
        stages = speed(Problem(V, F, boundary_of(F), V[boundary_of(F)]))
        first = ["CoarseToFine", "Composite", "EarlyRepair", "EarlyRepair", "VectorAdam", "LineShift"]
        assert [type(stage).__name__ for stage in stages[:6]] == first
        assert [type(stage).__name__ for stage in quick_stages(stages)] == first

    def test_wide_patches_precede_the_whole_of_a_large_mesh(self):
        for rings, before in (45, "WideRepair"), (27, "WideRepair"), (20, "CoarseToFine"):
            V, F = disk(rings)
            stages = speed(Problem(V, F, boundary_of(F), V[boundary_of(F)]))
            # On the largest mesh, conditions decide whether these stages run.
            words = [type(stage if stage.coarse else stage.begins_with).__name__ for stage in stages]
            assert words[words.index("Untangling") - 1] == before

    def test_stages_for_a_coarse_mesh_alone_also_solve_a_small_mesh(self):
        result = injective_map(*star_problem(n=80), strategy=[CoarseToFine(VectorAdam())])
        assert result.injective
        assert [stage.name for stage in result.stages] == ["vector-adam, tanh, dirichlet"]

    def test_a_stage_resumes_at_the_lowest_energy(self):
        """Neither at ξ = 0 nor at the last iterate."""
        stages = [VectorAdam(iterations=100), Newton(iterations=1, resume=True)]
        result = injective_map(*turned_ring(180), strategy=stages)
        first = result.history[:101]
        lowest = min(first, key=lambda step: step.energy)
        assert lowest.energy < 0.2 * first[0].energy
        assert result.history[101].energy == pytest.approx(lowest.energy, rel=1e-6)

    def test_worse_results_are_discarded(self):
        stages = [VectorAdam(iterations=60), Alternating(iterations=2)]
        result = injective_map(*turned_ring(180), strategy=stages)
        assert [stage.kept for stage in result.stages] == [True, False]
        assert np.sum(signed_areas(turned_ring(180)[1], result.uv) <= 0) == result.stages[1].inverted[1]

    def test_out_of_iterations(self):
        result = injective_map(*turned_ring(180), max_iterations=3)
        assert result.status is Status.OUT_OF_ITERATIONS
        assert result.n_iterations == 3
        assert "more iterations" in result.status.value

    def test_interrupted(self):
        def interrupt(step):
            if step.iteration == 4:
                raise KeyboardInterrupt

        result = injective_map(*turned_ring(180), callback=interrupt)
        assert result.status is Status.INTERRUPTED
        flips = [signed_areas(turned_ring(180)[1], result.uv) <= 0]
        assert np.sum(flips) == min(step.inverted for step in result.history)

    def test_offset_beyond_the_resolution_of_doubles(self):
        """At an offset of 1e15 sizes, no double lies between the boundary's points."""
        V, F, fixed, target = star_problem(n=500)
        target = target + 1e15
        result = injective_map(V, F, fixed, target, max_iterations=40)
        assert not result.injective
        assert result.status is not Status.INJECTIVE
        np.testing.assert_array_equal(result.uv[fixed], target)


class TestLinearSolver:
    def test_unknown_name(self):
        with pytest.raises(ValueError, match="superlu"):
            injective_map(*star_problem(n=60), linear_solver="magic")

    @pytest.mark.parametrize("name", quasiharmonic.linsolve.available())
    def test_the_named_solver_is_used_and_agrees(self, name):
        best, other = injective_map(*star_problem()), injective_map(*star_problem(), linear_solver=name)
        assert other.linear_solver == name
        assert other.injective
        np.testing.assert_allclose(best.uv, other.uv, atol=1e-6)

    def test_an_indefinite_matrix_shortens_the_step(self, monkeypatch):
        problem = Problem(*star_problem())
        solver = problem.domain.laplacian().solver
        factor, calls = solver.factor, []

        def fail_twice(values):
            calls.append(1)
            if len(calls) in (3, 4):
                raise NotPositiveDefinite("as asked")
            factor(values)

        monkeypatch.setattr(solver, "factor", fail_twice, raising=False)
        assert solve(problem).injective

    @pytest.mark.long
    def test_permanent_indefiniteness_has_a_status(self, monkeypatch):
        problem = Problem(*turned_ring(180))
        solver = problem.domain.laplacian("superlu").solver
        factor, calls = solver.factor, []

        def fail(values):
            calls.append(1)
            if len(calls) > 3:
                raise NotPositiveDefinite("as asked")
            factor(values)

        monkeypatch.setattr(solver, "factor", fail, raising=False)
        result = solve(problem, linear_solver="superlu", max_iterations=100)
        assert result.status is Status.UNSOLVABLE
        assert result.stages[0].n_iterations == 2
        # Untangling uses its own matrix and continues from the best map.
        assert np.sum(signed_areas(problem.F, result.uv) <= 0) < result.history[2].inverted
        assert np.all(np.isfinite(result.uv))

    @pytest.mark.long
    def test_another_backend_replaces_a_failing_one(self, monkeypatch):
        problem = Problem(*turned_ring(120))
        best, *others = quasiharmonic.linsolve.available(problem.domain.laplacian().solver.nnz)
        if not others:
            pytest.skip("SuperLU is the only linear solver here")

        def fail(values):
            raise NotPositiveDefinite("as asked")

        monkeypatch.setattr(problem.domain.laplacian(best).solver, "factor", fail, raising=False)
        result = solve(problem)
        assert result.injective
        assert result.linear_solver == others[0]


def test_second_solve_of_a_moved_problem_agrees_with_a_new_one():
    V, F, fixed, target = star_problem()
    problem = Problem(V, F, fixed, target)
    solve(problem)
    again = solve(problem.with_target(target[:, ::-1] * [1, -1]))
    fresh = injective_map(V, F, fixed, target[:, ::-1] * [1, -1])
    np.testing.assert_array_equal(again.uv, fresh.uv)


@pytest.mark.parametrize("strategy", ["speed", "paper"])
def test_the_tensors_reproduce_the_map(strategy):
    problem = Problem(*star_problem())
    result = solve(problem, strategy=strategy)
    again = quasi_harmonic_map(problem, result.mu, reference=result.reference)
    np.testing.assert_allclose(again, result.uv, atol=1e-9)


def test_moved_problems_in_threads_agree_with_single_ones():
    base = Problem(*turned_ring(90))
    targets = [base.target * [1, s] for s in (1, 0.9, 0.8)]
    alone = [solve(base.with_target(target)).uv for target in targets]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda target: solve(base.with_target(target)).uv, targets))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_solve_within_a_callback_changes_nothing():
    problem = Problem(*star_problem())
    plain = solve(problem).uv
    nested = solve(problem, callback=lambda step: solve(problem.with_target(2 * problem.target), max_iterations=1)).uv
    np.testing.assert_array_equal(plain, nested)


@pytest.mark.parametrize(
    ("mu", "words"),
    [(1.0, "not below 1 in modulus at triangles 0, 1"), (np.nan, "not below 1"), ("x", "one for each triangle")],
)
def test_quasi_harmonic_map_checks_its_tensors(mu, words):
    problem = Problem(*star_problem(n=60))
    with pytest.raises(ValueError, match=words):
        quasi_harmonic_map(problem, np.full(len(problem.F), mu))
    with pytest.raises(ValueError, match="one for each triangle"):
        quasi_harmonic_map(problem, np.zeros(3))
    with pytest.raises(ValueError, match="reference must be one of"):
        quasi_harmonic_map(problem, reference="square")


def test_public_names_are_lazy_and_complete():
    for name in quasiharmonic.__all__:
        assert getattr(quasiharmonic, name).__name__.removeprefix("quasiharmonic.") == name
    assert set(quasiharmonic.__all__) <= set(dir(quasiharmonic))
    with pytest.raises(AttributeError, match="attribute magic"):
        quasiharmonic.magic  # noqa: B018


@cache
def copied():
    """A problem, and maps of it and of another one, for copies."""
    problem, _ = OBSTRUCTED["nothing sees all"]
    return problem, solve(problem), injective_map(*star_problem(n=60))


@pytest.mark.slow
@pytest.mark.parametrize("again", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy, copy.copy])
def test_read_only_arrays_stay_read_only_in_copies(again):
    problem, result, found = copied()
    V, F, _, _ = star_problem(n=60)
    for thing, names in (
        (problem, ["target"]),
        (problem.domain, ["V", "F", "fixed"]),
        (found, ["V"]),
        (found.certificate, ["inverted", "degenerate", "nonfinite", "crossings", "multiply_wound", "loops"]),
        (result.diagnosis.obstructions[0], ["vertices", "edges", "triangles", "loops", "split"]),
        (InverseMap(V, F, found.uv), ["V", "F", "uv"]),
    ):
        other = again(thing)
        for name in names:
            for one in (thing, other):
                value = getattr(one, name)
                arrays = value if isinstance(value, tuple) else [value]
                assert not any(array.flags.writeable for array in arrays), (type(thing), name)
    once = again(replace(found, diagnosis=result.diagnosis))
    assert not once.certificate.inverted.flags.writeable
    assert not once.diagnosis.obstructions[0].split.flags.writeable
