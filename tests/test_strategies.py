"""The stages of a strategy beyond descent: repair, untangling, restarts, weights."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import pytest

import problems
from quasiharmonic import Problem, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.derivatives import check_energy, random_deformation
from quasiharmonic.energies.energies import Deformation
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import (
    Alternating,
    LocalRepair,
    Newton,
    RandomRestarts,
    Untangling,
    VectorAdam,
    WideRepair,
    random_restarts,
)
from quasiharmonic.solver.methods.base import SearchStage
from quasiharmonic.solver.methods.local_repair import Patch, untangle_fully
from quasiharmonic.solver.methods.random_restarts import find_nearest, left_of, reweight
from quasiharmonic.solver.methods.untangling import GRADINGS, Regularised, untangle
from quasiharmonic.solver.search.stages import STRATEGIES, TentativeStage, stages_of
from quasiharmonic.surfaces import grid
from shared.descent import path
from shared.meshes import bend, boundary_of, lift
from shared.solvable_problems import star_problem, turned_ring


class TestLocalRepair:
    def displaced(self, *vertices):
        """An injective map with some free vertices displaced across their neighbours."""
        V, F = grid(12, 12)
        problem = Problem(V, F, boundary_of(F), bend(V[boundary_of(F)]))
        objective = Objective(problem)
        w = problem.frame.inward(bend(V))
        for vertex in vertices:
            w[vertex] += 0.25
        return objective, objective.of_map(w)

    def test_only_the_patch_changes(self):
        vertex = 5 * 13 + 6
        objective, start = self.displaced(vertex)
        assert start.inverted > 0
        seen = path(LocalRepair(tries=5), objective, start)
        assert seen[-1].inverted == 0
        moved = np.flatnonzero(seen[-1].w != start.w)
        assert vertex in moved
        near = np.abs(objective.problem.V[moved] - objective.problem.V[vertex]).max(axis=1)
        assert near.max() < 4 / 12
        assert not np.isin(moved, objective.problem.fixed).any()

    def test_two_patches_one_after_the_other(self):
        objective, start = self.displaced(2 * 13 + 3, 9 * 13 + 8)
        flips = [i.inverted for i in path(LocalRepair(tries=20), objective, start)]
        assert flips[-1] == 0
        assert np.all(np.diff(flips) < 0)
        assert len(flips) > 2

    def test_gives_a_quasi_harmonic_map(self):
        """Where it ends without inverted triangles, its tensors are those of the map, and V₃ is zero."""
        objective, start = self.displaced(5 * 13 + 6)
        end = path(LocalRepair(tries=5), objective, start)[-1]
        assert end.energy < 1e-20
        np.testing.assert_allclose(objective.evaluate(end.xi).w, end.w, atol=1e-9)

    def test_does_not_change_injective_maps(self):
        objective, start = self.displaced()
        assert path(LocalRepair(tries=5), objective, start) == [start]

    @pytest.mark.slow
    def test_one_wide_patch_repairs_what_takes_many_narrow_ones(self):
        V, F = grid(80, 80)
        problem = Problem(V, F, boundary_of(F), V[boundary_of(F)])
        objective = Objective(problem)
        w = problem.frame.inward(V)
        # Six vertices near each other are displaced by two edge lengths.
        w[[8 * 81 + 8, 8 * 81 + 14, 8 * 81 + 20, 14 * 81 + 8, 14 * 81 + 14, 14 * 81 + 20]] += 0.05
        start = objective.of_map(w)
        assert 0 < start.inverted <= 50
        assert len(path(LocalRepair(tries=30), objective, start)) > 4
        seen = path(WideRepair(), objective, start)
        assert [i.inverted for i in seen] == [start.inverted, 0]
        assert not np.isin(np.flatnonzero(seen[-1].w != start.w), problem.fixed).any()


class TestUntangling:
    def tangled(self, seed=0):
        """A grid whose inner vertices lie at random positions in the square."""
        V, F = grid(8, 8)
        w = V[:, 0] + 1j * V[:, 1]
        rim = boundary_of(F)
        inner = np.setdiff1d(np.arange(len(V)), rim)
        rng = np.random.default_rng(seed)
        w[inner] = rng.random(inner.size) + 1j * rng.random(inner.size)
        return F, w, rim

    @pytest.mark.parametrize("epsilon", [3.0, 0.1, 1e-4])
    def test_derivatives_of_the_energy_on_both_sides_of_zero(self, epsilon, rng):
        positive = random_deformation(60)
        for d in (positive, Deformation.of(positive.q, positive.p)):
            assert check_energy(Regularised(epsilon), d).passed

    def test_energy_becomes_a_barrier(self):
        """As ε → 0 it tends to (a + b + λ(D² + 1))/D if D > 0, and to infinity if D < 0."""
        d = Deformation.of(np.array([1.0 + 0j, 0.5]), np.array([0.5 + 0j, 1.0]))
        positive, inverted = Regularised(1e-9).density(d)
        assert positive == pytest.approx((1.25 + 1e-4 * (0.75**2 + 1)) / 0.75)
        assert inverted > 1e15

    @pytest.mark.parametrize("grading", GRADINGS)
    @pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
    def test_untangles_random_positions(self, grading, scale):
        F, w, rim = self.tangled()
        *_, end = untangle(F, scale * w, rim, grading=grading)
        assert signed_areas(F, w).min() < 0
        assert signed_areas(F, end).min() > 0
        np.testing.assert_array_equal(end[rim], scale * w[rim])

    def test_injective_and_collapsed_maps_are_not_changed(self):
        V, F = grid(4, 4)
        w = V[:, 0] + 1j * V[:, 1]
        assert list(untangle(F, w, boundary_of(F), grading=0.5)) == []
        assert list(untangle(F, 0 * w, boundary_of(F), grading=0.5)) == []

    def test_stops_where_no_map_exists(self):
        """An inverted triangle whose vertices are all fixed."""
        F, w, rim = self.tangled()
        inner = next(t for t in F if not np.isin(t, rim).any())
        w[inner] = [0.4 + 0.4j, 0.5 + 0.6j, 0.6 + 0.4j]
        seen = list(untangle(F, w, np.append(rim, inner), grading=0.0))
        assert 0 < len(seen) < 1000
        assert np.all(np.isfinite(seen[-1].view(float)))

    def test_does_not_change_numpys_error_state(self):
        F, w, rim = self.tangled()
        for _ in untangle(F, w, rim, grading=0.0):
            assert np.geterr()["divide"] == "warn"

    def test_limits_iterations(self):
        objective = Objective(Problem(*turned_ring(180)))
        assert len(path(Untangling(iterations=3), objective)) == 4


class TestRandomRestarts:
    def test_part_of_a_square_left_of_a_line(self):
        square = np.array([0, 1, 1 + 1j, 1j])
        half = left_of(square, 0.25 + 0j, 0.25 + 1j)
        assert sorted(half.tolist(), key=lambda z: (z.real, z.imag)) == [0, 1j, 0.25, 0.25 + 1j]
        assert len(left_of(square, -1 - 1j, -1 + 1j)) == 0
        np.testing.assert_array_equal(left_of(square, 2 - 1j, 2 + 1j), square)

    def test_nearest_point_of_an_outline(self):
        square = np.array([0, 1, 1 + 1j, 1j])
        assert find_nearest(square, 0.4 - 2j) == 0.4
        assert find_nearest(square, 3 + 3j) == 1 + 1j
        assert find_nearest(square, 0.9 + 0.5j) == 1 + 0.5j

    @pytest.mark.long
    def test_moves_a_vertex_around_a_fold(self):
        """A free vertex must lie in a wedge behind a fold of the target, and starts in front of it."""
        case = problems.make(*problems.parse("jam:81:0.943"))
        problem = Problem(case.V, case.F, case.fixed, case.target)
        objective = Objective(problem)
        tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
        *_, w = untangle(problem.F, tutte.w, problem.fixed, grading=0.0)
        stuck = objective.of_map(w)
        assert stuck.inverted > 0
        assert path(LocalRepair(tries=4), objective, stuck)[-1].inverted == stuck.inverted
        end = path(RandomRestarts(max_failures=50), objective, stuck)[-1]
        assert end.inverted == 0
        np.testing.assert_array_equal(end.w[problem.fixed], w[problem.fixed])

    def test_is_deterministic(self):
        objective, start = TestLocalRepair().displaced(5 * 13 + 6)
        first, again = (path(RandomRestarts(max_failures=5), objective, start)[-1] for _ in range(2))
        np.testing.assert_array_equal(first.w, again.w)
        assert first.inverted == 0

    @pytest.mark.slow
    def test_untangles_first_if_local_repair_cannot_succeed(self):
        objective = Objective(Problem(*star_problem(depth=0.2, n=1000)))
        seen = path(RandomRestarts(max_failures=3), objective)
        assert seen[0].inverted > 50
        assert seen[-1].inverted < seen[0].inverted


@pytest.fixture(scope="module")
def stuck():
    """A problem in which several vertices, in front of a fold, must move around it together."""
    case = problems.make(*problems.parse("jam:141:0.838"))
    problem = Problem(case.V, case.F, case.fixed, case.target)
    objective = Objective(problem)
    tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
    *_, w = untangle(problem.F, tutte.w, problem.fixed, grading=0.0)
    w.setflags(write=False)
    fixed = np.isin(np.arange(problem.n), problem.fixed)
    return Patch(problem.F, np.arange(problem.n), fixed), w


class TestReweighting:
    @pytest.mark.long
    def test_repairs_what_the_same_number_of_unweighted_descents_does_not(self, stuck):
        patch, start = stuck
        assert signed_areas(patch.F, start).min() < 0
        w = start
        for grading in 5 * GRADINGS:
            *_, w = untangle(patch.F, w, np.flatnonzero(patch.fixed), grading=grading)
            assert signed_areas(patch.F, w).min() < 0
        ends = [reweight(np.random.default_rng(seed), patch, start, "auto") for seed in range(2)]
        assert any(signed_areas(patch.F, end).min() > 0 for end in ends)
        for end in ends:
            np.testing.assert_array_equal(end[patch.fixed], start[patch.fixed])
            assert np.sum(signed_areas(patch.F, end) <= 0) <= np.sum(signed_areas(patch.F, start) <= 0)

    @pytest.mark.long
    @pytest.mark.parametrize("spoilt", [False, True])
    def test_returns_the_start_if_nothing_is_better(self, stuck, spoilt, monkeypatch):
        """Return the last map of the rounds that is no worse than the given one; if all are worse, the given one."""
        patch, start = stuck
        rounds = []

        def recorded(*arguments):
            # A vertex moved far away gives each map more inverted triangles than the first.
            w = untangle_fully(*arguments)
            rounds.append(w + np.where(np.arange(w.size) == np.flatnonzero(~patch.fixed)[0], 9.0, 0) if spoilt else w)
            return rounds[-1]

        def inverted(w):
            return np.sum(signed_areas(patch.F, w) <= 0)

        monkeypatch.setattr(random_restarts, "untangle_fully", recorded)
        end = reweight(np.random.default_rng(0), patch, start, "auto")
        assert len(rounds) > 1
        no_worse = [w for w in rounds if inverted(w) <= inverted(start)]
        assert bool(no_worse) is not spoilt
        np.testing.assert_array_equal(end, no_worse[-1] if no_worse else start)

    def test_weights_decide_which_of_two_triangles_is_repaired(self):
        """A vertex that can be on the correct side of one of two fixed edges, but not of both."""
        F = np.array([[0, 1, 4], [2, 3, 4]])
        w = np.array([0, 1, 1 + 0.2j, 0.2j, 0.5 + 0.1j]) + np.array([0.4j, 0.4j, 0, 0, 0.3j])
        for heavy in (0, 1):
            weights = np.where(np.arange(2) == heavy, 1e3, 1.0)
            *_, end = untangle(F, w, np.arange(4), grading=0.0, weights=weights)
            areas = signed_areas(F, end)
            assert areas[heavy] > 0 > areas[1 - heavy]


class TestStrategy:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            ({"parameterisation": "log"}, "parameterisation must be one of tanh, si-log"),
            ({"functional": "v3"}, "functional must be one of neumann, sobolev, dirichlet, poisson"),
            ({"reference": "square"}, "reference must be one of"),
            ({"iterations": 0}, "iterations must be an integer of at least 1"),
            ({"iterations": 2.5}, "iterations must be an integer"),
            ({"schedule": "abc"}, "schedule must be pairs"),
            ({"schedule": [(5, -1)]}, "schedule must be pairs"),
            ({"schedule": [(5, 1), (5, 2)]}, "schedule must be pairs"),
            ({"schedule": [(0, np.nan)]}, "schedule must be pairs"),
            ({"momenta": (0.9, 1.0)}, "momenta must be two numbers"),
            ({"momenta": (-0.1, 0.9)}, "momenta must be two numbers"),
            ({"momenta": (np.nan, 0.9)}, "momenta must be two numbers"),
            ({"momenta": 0.9}, "momenta must be two numbers"),
            ({"momenta": None}, "momenta must be two numbers"),
        ],
    )
    def test_invalid_names(self, arguments, words):
        with pytest.raises(ValueError, match=words):
            VectorAdam(**arguments)

    def test_named_strategies_have_stages(self):
        problem = Problem(*star_problem(n=60))
        for name in STRATEGIES:
            assert all(isinstance(stage, SearchStage) for stage in stages_of(name, problem))
        with pytest.raises(ValueError, match="strategy must be one of speed, paper"):
            stages_of("haste", problem)
        for wrong in ([], 3, ["speed"]):
            with pytest.raises(ValueError, match=re.escape(f"or a non-empty list of Descent, not {wrong}")):
                stages_of(wrong, problem)

    def test_problems_with_pins_start_with_si_log(self):
        V, F, fixed, target = star_problem(n=60)
        inner = int(np.setdiff1d(np.arange(len(V)), fixed)[0])
        pinned = Problem(V, F, np.append(fixed, inner), np.vstack([target, [[0, 0]]]))
        assert stages_of("speed", pinned)[0].parameterisation == "si-log"
        assert stages_of("speed", Problem(V, F, fixed, target))[0].parameterisation == "tanh"

    def test_the_papers_strategy_is_si_log_tanh_and_then_two_methods_in_turn(self):
        stages = stages_of("paper", Problem(*star_problem(n=60)))
        assert [stage.begins_with.parameterisation for stage in stages[:3]] == ["si-log", "tanh", "tanh"]
        assert [stage.begins_with.label for stage in stages[:2]] == ["vector-adam"] * 2
        assert [stage.begins_with.label for stage in stages[2:]] == ["alternating", "newton"] * 10
        assert [isinstance(stage, TentativeStage) for stage in stages[2:]] == [True, False] * 10
        assert sum(stage.begins_with.iterations for stage in stages) == 2000

    def test_iterations_of_a_tentative_stage_are_discarded_if_they_find_no_map(self):
        """The alternation lowers V₃ at every step; nevertheless the next stage starts where the alternation started."""
        problem = Problem(*turned_ring(180))
        begun = []

        @dataclass(frozen=True, kw_only=True)
        class Onlooker(Newton):
            def start(self, objective, found):
                begun.append(found.lowest_energy.energy)
                return super().start(objective, found)

        alternation = Alternating(iterations=5, resume=True)
        for tried in ([], [TentativeStage(alternation)], [alternation]):
            solve(problem, strategy=[VectorAdam(iterations=3), *tried, Onlooker(iterations=1, resume=True)])
        alone, discarded, kept = begun
        assert kept < 0.999 * alone
        assert discarded == alone

    def test_si_log_keeps_angles_better_on_a_smooth_surface(self):
        """The si-log map has a lower mean angle distortion than tanh's, as in the paper's Figure 8."""
        V, F, fixed, target = star_problem(depth=0.35, n=800)
        problem = Problem(lift(V[:, :2]), F, fixed, target)
        mesh = problem.domain.mesh("rest")

        def mips(strategy):
            w = np.ascontiguousarray(solve(problem, strategy=strategy).uv).view(complex).ravel()
            p, q, _ = mesh.derivatives(w)
            return np.average(4 * np.abs(q) ** 2 / (np.abs(p) ** 2 - np.abs(q) ** 2), weights=mesh.m)

        assert mips("paper") < mips([VectorAdam(iterations=100)])
