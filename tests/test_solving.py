"""`injective_map`: its certificates, its promises, and its result if no map exists."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import quasiharmonic
import quasiharmonic.linsolve
from quasiharmonic import Problem, Status, injective_map, solve
from quasiharmonic.solver.methods import LBFGS, Newton, VectorAdam
from quasiharmonic.surfaces import disk, grid, random_delaunay
from shared.distinct_steps import DistinctSteps
from shared.exact import inverted
from shared.meshes import bend, boundary_of, lift, signed_areas
from shared.solvable_problems import star_problem, turned_ring


class TestFinds:
    def test_star(self):
        V, F, fixed, target = star_problem()
        result = injective_map(V, F, fixed, target)
        assert result.status is Status.INJECTIVE
        assert result.injective
        assert result.certificate.bijective
        assert inverted(F, result.uv) == 0
        np.testing.assert_array_equal(result.uv[fixed], target)
        assert result.history[0].inverted > 0
        assert result.history[-1].inverted == 0
        assert result.n_iterations == len(result.history) - 1 == sum(s.n_iterations for s in result.stages)
        assert result.linear_solver in quasiharmonic.linsolve.available()

    @pytest.mark.slow
    @pytest.mark.parametrize("degrees", [90, 180, -135])
    def test_turned_rings(self, degrees):
        V, F, fixed, target = turned_ring(degrees)
        result = injective_map(V, F, fixed, target)
        assert result.injective
        assert result.certificate.bijective
        assert inverted(F, result.uv) == 0

    def test_a_found_map_has_no_diagnosis(self):
        """The search examines obstructions before its second stage."""
        result = injective_map(*turned_ring(90), strategy=[VectorAdam(iterations=1), VectorAdam()])
        assert len(result.stages) == 2
        assert result.success
        assert result.diagnosis is None

    def test_two_pins_swapped(self):
        """Figure 17, without a given parameterisation."""
        V, F = grid(20, 20)
        pins = [int(np.argmin(((V - p) ** 2).sum(axis=1))) for p in ((1 / 3, 0.5), (2 / 3, 0.5))]
        fixed = np.append(boundary_of(F), pins)
        target = np.vstack([V[boundary_of(F)], V[pins[::-1]]])
        result = injective_map(V, F, fixed, target)
        assert result.injective
        np.testing.assert_array_equal(result.uv[pins], V[pins[::-1]])
        assert inverted(F, result.uv) == 0

    def test_one_point_moved(self):
        """Figure 11."""
        V, F = grid(16, 16)
        middle = int(np.argmin(((V - 0.5) ** 2).sum(axis=1)))
        fixed = np.append(boundary_of(F), middle)
        result = injective_map(V, F, fixed, np.vstack([V[fixed[:-1]], [[0.2, 0.5]]]))
        assert result.injective
        assert result.uv[middle].tolist() == [0.2, 0.5]

    @pytest.mark.slow
    def test_two_regions_swapped(self):
        """Small regional handles in place of points (§10.3)."""
        V, F = grid(24, 24)
        near = [np.flatnonzero(np.abs(V - p).max(axis=1) < 0.06) for p in ((1 / 3, 0.5), (2 / 3, 0.5))]
        rim = boundary_of(F)
        fixed = np.concatenate([rim, *near])
        target = np.vstack([V[rim], V[near[0]] + [1 / 3, 0], V[near[1]] - [1 / 3, 0]])
        result = injective_map(V, F, fixed, target)
        assert len(fixed) > len(rim) + 8
        assert result.injective

    @pytest.mark.slow
    @pytest.mark.parametrize("functional", ["neumann", "sobolev", "dirichlet"])
    def test_every_functional_turns_the_ring(self, functional):
        """Figure 6 for an eighth of a turn, by the functional's own descent alone."""
        stages = [VectorAdam(functional=functional, iterations=400)]
        assert injective_map(*turned_ring(45), strategy=stages).injective

    @pytest.mark.slow
    def test_ends_close_to_the_least_area_if_no_map_exists(self):
        """Figure 18: the map covers a pin outside the target and little other area."""
        V, F = disk(7)
        rim = boundary_of(F)
        result = injective_map(V, F, np.append(rim, 0), np.vstack([V[rim], [[1.5, 0.0]]]))
        assert result.status is Status.IMPOSSIBLE
        unsigned = np.abs(signed_areas(F, result.uv)).sum() / 2
        assert np.all(np.isfinite(result.uv))
        # The disk's area, and twice the spike to the pin, which is one triangle wide at the boundary.
        assert unsigned < 1.15 * np.pi

    def test_locally_injective_if_the_target_crosses_itself(self):
        """A spiral strip that overlaps itself: every triangle is positive, but the map is not bijective."""
        V, F = grid(60, 3)
        angle, radius = 2 * np.pi * 1.4 * V[:, 0], 2 - 0.8 * V[:, 1]
        spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        fixed = boundary_of(F)
        result = injective_map(V, F, fixed, spiral[fixed])
        assert result.injective
        assert result.certificate.bijective is False

    def test_feasible_by_construction(self):
        for seed in range(3):
            V, F = random_delaunay(200, seed=seed)
            fixed = boundary_of(F)
            assert injective_map(lift(V), F, fixed, bend(V[fixed])).injective


class TestTheory:
    def test_tutte_needs_no_iteration(self):
        """Equilateral triangles and a convex target: positive weights, Tutte's theorem."""
        V, F = disk(8)
        fixed = boundary_of(F)
        target = V[fixed] / np.abs(V[fixed]).sum(axis=1, keepdims=True)
        result = injective_map(lift(V), F, fixed, target * [3.0, 0.5])
        assert result.injective
        assert result.n_iterations == 0

    def test_own_boundary_gives_the_identity(self):
        V, F = random_delaunay(300, seed=1)
        fixed = boundary_of(F)
        result = injective_map(V, F, fixed, V[fixed], reference="rest")
        assert result.n_iterations == 0
        np.testing.assert_allclose(result.uv, V, atol=1e-13)

    def test_energy_tends_to_zero_only_at_injective_maps(self):
        result = injective_map(*star_problem())
        energies = [step.energy for step in result.history]
        assert 0 < energies[-1] < energies[0]


class TestPromises:
    def test_deterministic(self):
        first, second = (injective_map(*star_problem()) for _ in range(2))
        np.testing.assert_array_equal(first.uv, second.uv)
        assert [s.energy for s in first.history] == [s.energy for s in second.history]

    def test_problem_survives_pickling(self):
        problem = Problem(*star_problem())
        first = solve(problem)
        np.testing.assert_array_equal(solve(pickle.loads(pickle.dumps(problem))).uv, first.uv)

    def test_same_from_other_dtypes_and_layouts(self):
        V, F, fixed, target = star_problem()
        V, target = V.astype(np.float32), target.astype(np.float32)
        plain = injective_map(V.astype(float), F, fixed, target.astype(float))
        strided = np.zeros((2 * len(V), 4), np.float32)
        strided[::2, 1:] = V
        other = injective_map(strided[::2, 1:], F.astype(np.uint32), fixed.astype(np.int32), np.asfortranarray(target))
        np.testing.assert_array_equal(plain.uv, other.uv)

    @pytest.mark.parametrize("scale", [1e-200, 1e-12, 1e12, 1e150])
    @pytest.mark.parametrize("reference", [None, "rest", "corrected"])
    def test_scale_of_rest_and_target_do_not_matter(self, scale, reference):
        V, F, fixed, target = star_problem()
        plain = injective_map(V, F, fixed, target, reference=reference)
        for rest, place in ((V * scale, target), (V, target * scale), (V / scale, target * scale)):
            result = injective_map(rest, F, fixed, place, reference=reference)
            assert result.injective
            assert abs(result.n_iterations - plain.n_iterations) <= 2
            np.testing.assert_array_equal(result.uv[fixed], place)

    def test_vertex_order_of_fixed_does_not_matter(self, rng):
        V, F, fixed, target = star_problem()
        order = rng.permutation(len(fixed))
        a, b = injective_map(V, F, fixed, target), injective_map(V, F, fixed[order], target[order])
        assert abs(a.n_iterations - b.n_iterations) <= 1
        np.testing.assert_allclose(a.uv, b.uv, atol=1e-6)

    def test_tiny_meshes(self):
        one = injective_map(np.eye(3), [[0, 1, 2]], [0, 1, 2], [[0, 0], [1, 0], [0, 1]])
        assert one.injective
        assert one.n_iterations == 0
        hub = injective_map([[0, 0], [1, 0], [0, 1], [-1, -1]], [[0, 1, 2], [0, 2, 3], [0, 3, 1]], [1, 2, 3],
                            [[1, 0], [0, 1], [-1, -1]])  # fmt: skip
        assert hub.injective

    def test_large_offset(self):
        V, F, fixed, target = star_problem()
        result = injective_map(V, F, fixed, target + 1e8)
        assert result.injective
        assert inverted(F, result.uv) == 0

    def test_callback_receives_every_step_and_strategy_can_be_a_list(self):
        seen = DistinctSteps()
        stages = [
            LBFGS(parameterisation="si-log", functional="neumann", reference="rest"),
            Newton(resume=True),
        ]
        result = injective_map(*star_problem(), strategy=stages, callback=seen.append)
        assert seen == result.history
        assert result.injective
        assert result.stages[0].name == "l-bfgs, si-log, neumann"
