"""Relocation: vertices move to the point with the largest height, against another solver's linear programmes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

import problems
from quasiharmonic import Problem, boundary_loops, injective_maps, quasi_harmonic_map, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.methods.relocation import RetrySchedule, highest_positions, relocate, relocate_each
from quasiharmonic.solver.search.stages import paper, speed
from quasiharmonic.surfaces import random_delaunay


def rings(rng, count, corners):
    """Loops around zero, some without an interior point that sees the whole loop."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, (count, corners)), axis=1)
    return rng.uniform(0.2, 1, (count, corners)) * np.exp(1j * angles)


def stirred(rng, V, F, share=0.1):
    """A mesh's own positions with some interior vertices displaced, and its boundary."""
    (loop,) = boundary_loops(F, len(V))
    w = V[:, 0] + 1j * V[:, 1]
    some = rng.choice(np.setdiff1d(np.arange(len(V)), loop), int(share * len(V)), replace=False)
    w[some] += 0.5 * (rng.standard_normal(some.size) + 1j * rng.standard_normal(some.size))
    return w, loop


@pytest.mark.parametrize("corners", [3, 4, 6, 9])
def test_the_smallest_height_is_maximal(rng, corners):
    tails = rings(rng, 30, corners)
    heads = np.roll(tails, -1, axis=1)
    found = highest_positions(np.zeros(30, dtype=complex), tails, heads)
    for place, ring in zip(found, tails, strict=True):
        F = np.stack([np.full(corners, corners), np.arange(corners), np.roll(np.arange(corners), -1)], axis=1)
        length = np.abs(np.roll(ring, -1) - ring)
        origin, right, up = (2 * signed_areas(F, np.append(ring, at)) / length for at in (0, 1, 1j))
        # The greatest t with height(x, y) ≥ t.
        A = np.stack([origin - right, origin - up, np.ones(corners)], axis=1)
        best = linprog([0, 0, -1], A_ub=A, b_ub=origin, bounds=[(None, None)] * 3)
        assert (2 * signed_areas(F, np.append(ring, place)) / length).min() == pytest.approx(-best.fun, abs=1e-12)


def test_duplicate_edges_do_not_matter(rng):
    tails = rings(rng, 10, 6)
    heads = np.roll(tails, -1, axis=1)
    once = highest_positions(np.zeros(10, dtype=complex), tails, heads)
    last = np.repeat(np.arange(6), [1, 1, 1, 1, 1, 4])
    np.testing.assert_allclose(
        highest_positions(np.zeros(10, dtype=complex), tails[:, last], heads[:, last]), once, atol=1e-12
    )


def test_rotation_and_scaling_move_the_solution_along(rng):
    tails = rings(rng, 10, 6)
    heads = np.roll(tails, -1, axis=1)
    before = highest_positions(np.zeros(10, dtype=complex), tails, heads)
    turn, shift = 1e-6 * np.exp(0.7j), 3 - 2j
    there = highest_positions(np.zeros(10, dtype=complex), turn * tails + shift, turn * heads + shift)
    np.testing.assert_allclose((there - shift) / turn, before, atol=1e-8)


def test_a_vertex_without_a_valid_position_does_not_move():
    nowhere = np.zeros((1, 5), dtype=complex)
    assert highest_positions(np.array([2 + 1j]), nowhere, nowhere) == 2 + 1j
    # Edges that meet at infinity: no warning.
    tails, heads = np.array([[0, -1j, 3]]), np.array([[1, 1 - 1j, 3 + 1j]])
    assert highest_positions(np.array([2 + 1j]), tails, heads) == 2 + 1j


def test_displaced_vertices_return(rng):
    V, F = random_delaunay(900, rng)
    w, loop = stirred(rng, V, F, 0.01)
    given, inverted = w.copy(), signed_areas(F, w) <= 0
    assert inverted.sum() > 10
    there = relocate(F, w, loop)
    assert signed_areas(F, there).min() > 0
    assert np.array_equal(w, given)
    assert np.array_equal(there[loop], w[loop])
    # Vertices far from inverted triangles have no reason to move.
    near = inverted
    for _ in range(4):
        near = np.isin(F, F[near]).any(axis=1)
    far = np.setdiff1d(np.arange(len(V)), F[near])
    assert far.size > 20
    assert np.array_equal(there[far], w[far])


def test_no_map_is_returned_where_none_exists(rng):
    V, F = random_delaunay(60, rng)
    w, loop = stirred(rng, V, F)
    w[loop] = w[loop].conj()
    assert relocate(F, w, loop) is None


def test_batched_problems_are_solved_as_if_alone(rng):
    meshes = [random_delaunay(n, seed=n) for n in (60, 90, 40, 120)]
    maps = [stirred(rng, V, F) for V, F in meshes]
    maps[1] = maps[1][0].conj(), maps[1][1]
    starts = np.cumsum([0, *(len(V) for V, _ in meshes)])
    together, righted = relocate_each(
        np.concatenate([F + start for (_, F), start in zip(meshes, starts[:-1], strict=True)]),
        np.concatenate([w for w, _ in maps]),
        np.concatenate([loop + start for (_, loop), start in zip(maps, starts[:-1], strict=True)]),
        np.repeat(np.arange(4), [len(F) for _, F in meshes]),
    )
    assert righted.tolist() == [True, False, True, True]
    for k in (0, 2, 3):
        alone = relocate(meshes[k][1], *maps[k])
        np.testing.assert_allclose(together[starts[k] : starts[k + 1]], alone, atol=1e-12)


@pytest.mark.slow
def test_any_number_of_vertices_with_any_neighbours(rng):
    """In large batches, vertices with five triangles around them are placed separately from those with ten."""
    meshes = [random_delaunay(60, seed=n) for n in range(25)]
    maps = [stirred(rng, V, F) for V, F in meshes]
    starts = np.cumsum([0, *(len(V) for V, _ in meshes)])
    F = np.concatenate([F + start for (_, F), start in zip(meshes, starts[:-1], strict=True)])
    around = np.bincount(F.ravel())
    assert {5, 6, 7, 8, 9} <= set(around.tolist())
    together, righted = relocate_each(
        F,
        np.concatenate([w for w, _ in maps]),
        np.concatenate([loop + start for (_, loop), start in zip(maps, starts[:-1], strict=True)]),
        np.repeat(np.arange(25), [len(F) for _, F in meshes]),
    )
    assert righted.sum() > 15
    for k, (_, F) in enumerate(meshes):
        alone = relocate(F, *maps[k])
        assert (alone is not None) == righted[k]
        if righted[k]:
            np.testing.assert_allclose(together[starts[k] : starts[k + 1]], alone, atol=1e-12)


def test_attempts_run_with_fewer_inverted_triangles_and_increasingly_rarely():
    tries = RetrySchedule()
    assert not tries.is_due(0)
    counts = [200, 13, 12, 12, 10, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8]
    assert [k for k, inverted in enumerate(counts) if tries.is_due(inverted)] == [2, 5, 13]
    # The first map is attempted with more.
    assert RetrySchedule().is_due(100)
    assert not RetrySchedule().is_due(101)


class TestInDescent:
    NAMES = "maze:0:0.5", "comb:1:0.4", "flow:3:0.5", "pins:2:0.4"

    def made(self):
        cases = [problems.make(*problems.parse(name), triangles=400) for name in self.NAMES]
        return [Problem(case.V, case.F, case.fixed, case.target) for case in cases]

    @pytest.mark.slow
    def test_a_descent_ends_sooner_with_the_tensors_of_its_map(self):
        fewer = 0
        for problem in self.made():
            plain, helped = (
                solve(problem, strategy=[VectorAdam(relocation=relocation)]) for relocation in (False, True)
            )
            assert helped.injective
            assert helped.n_iterations <= plain.n_iterations
            fewer += helped.n_iterations < plain.n_iterations
            np.testing.assert_allclose(quasi_harmonic_map(problem, helped.mu), helped.uv, atol=1e-8)
        assert fewer >= 2

    @pytest.mark.slow
    def test_batched_descents_agree_with_single_ones(self):
        for problem, together in zip(self.made(), injective_maps(self.made()), strict=True):
            alone = solve(problem)
            assert [step.inverted for step in together.history] == [step.inverted for step in alone.history]
            np.testing.assert_allclose(together.uv, alone.uv, atol=1e-9)
            np.testing.assert_allclose(together.mu, alone.mu, atol=1e-6)
            np.testing.assert_allclose(together.history[-1].energy, alone.history[-1].energy, atol=1e-12)

    def test_the_papers_strategy_does_not_use_it(self):
        problem = self.made()[0]
        assert any(getattr(stage.begins_with, "relocation", False) for stage in speed(problem))
        assert not any(getattr(stage.begins_with, "relocation", False) for stage in paper(problem))
