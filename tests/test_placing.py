"""Placing: vertices where the triangles around them have most room, against linear programmes solved by another."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog

import problems
from quasiharmonic import Problem, boundary_loops, injective_maps, quasi_harmonic_map, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.methods.relocation import RetrySchedule, placed, placed_each, roomiest
from quasiharmonic.solver.search.strategy import paper, speed
from quasiharmonic.surfaces import random_delaunay


def rings(rng, count, corners):
    """Loops around zero, some of them with no point inside from which all of the loop is seen."""
    angles = np.sort(rng.uniform(0, 2 * np.pi, (count, corners)), axis=1)
    return rng.uniform(0.2, 1, (count, corners)) * np.exp(1j * angles)


def stirred(rng, V, F, share=0.1):
    """A mesh's own places with some of its interior vertices thrown elsewhere, and its boundary."""
    (loop,) = boundary_loops(F, len(V))
    w = V[:, 0] + 1j * V[:, 1]
    some = rng.choice(np.setdiff1d(np.arange(len(V)), loop), int(share * len(V)), replace=False)
    w[some] += 0.5 * (rng.standard_normal(some.size) + 1j * rng.standard_normal(some.size))
    return w, loop


@pytest.mark.parametrize("corners", [3, 4, 6, 9])
def test_the_least_height_is_greatest(rng, corners):
    tails = rings(rng, 30, corners)
    heads = np.roll(tails, -1, axis=1)
    found = roomiest(np.zeros(30, dtype=complex), tails, heads)
    for place, ring in zip(found, tails, strict=True):
        F = np.stack([np.full(corners, corners), np.arange(corners), np.roll(np.arange(corners), -1)], axis=1)
        length = np.abs(np.roll(ring, -1) - ring)
        origin, right, up = (2 * signed_areas(F, np.append(ring, at)) / length for at in (0, 1, 1j))
        # The greatest t with height(x, y) ≥ t.
        A = np.stack([origin - right, origin - up, np.ones(corners)], axis=1)
        best = linprog([0, 0, -1], A_ub=A, b_ub=origin, bounds=[(None, None)] * 3)
        assert (2 * signed_areas(F, np.append(ring, place)) / length).min() == pytest.approx(-best.fun, abs=1e-12)


def test_edges_that_are_there_twice_are_no_matter(rng):
    tails = rings(rng, 10, 6)
    heads = np.roll(tails, -1, axis=1)
    once = roomiest(np.zeros(10, dtype=complex), tails, heads)
    last = np.repeat(np.arange(6), [1, 1, 1, 1, 1, 4])
    np.testing.assert_allclose(roomiest(np.zeros(10, dtype=complex), tails[:, last], heads[:, last]), once, atol=1e-12)


def test_what_turns_and_grows_takes_the_place_with_it(rng):
    tails = rings(rng, 10, 6)
    heads = np.roll(tails, -1, axis=1)
    before = roomiest(np.zeros(10, dtype=complex), tails, heads)
    turn, shift = 1e-6 * np.exp(0.7j), 3 - 2j
    there = roomiest(np.zeros(10, dtype=complex), turn * tails + shift, turn * heads + shift)
    np.testing.assert_allclose((there - shift) / turn, before, atol=1e-8)


def test_without_room_at_all_a_vertex_stays():
    nowhere = np.zeros((1, 5), dtype=complex)
    assert roomiest(np.array([2 + 1j]), nowhere, nowhere) == 2 + 1j
    # Edges that meet infinitely far away: no warning.
    tails, heads = np.array([[0, -1j, 3]]), np.array([[1, 1 - 1j, 3 + 1j]])
    assert roomiest(np.array([2 + 1j]), tails, heads) == 2 + 1j


def test_vertices_thrown_elsewhere_come_back(rng):
    V, F = random_delaunay(900, rng)
    w, loop = stirred(rng, V, F, 0.01)
    given, inverted = w.copy(), signed_areas(F, w) <= 0
    assert inverted.sum() > 10
    there = placed(F, w, loop)
    assert signed_areas(F, there).min() > 0
    assert np.array_equal(w, given)
    assert np.array_equal(there[loop], w[loop])
    # What is far from anything inverted has no reason to move.
    near = inverted
    for _ in range(4):
        near = np.isin(F, F[near]).any(axis=1)
    far = np.setdiff1d(np.arange(len(V)), F[near])
    assert far.size > 20
    assert np.array_equal(there[far], w[far])


def test_where_no_map_exists_there_is_none(rng):
    V, F = random_delaunay(60, rng)
    w, loop = stirred(rng, V, F)
    w[loop] = w[loop].conj()
    assert placed(F, w, loop) is None


def test_side_by_side_each_is_as_by_itself(rng):
    meshes = [random_delaunay(n, seed=n) for n in (60, 90, 40, 120)]
    maps = [stirred(rng, V, F) for V, F in meshes]
    maps[1] = maps[1][0].conj(), maps[1][1]
    starts = np.cumsum([0, *(len(V) for V, _ in meshes)])
    together, righted = placed_each(
        np.concatenate([F + start for (_, F), start in zip(meshes, starts[:-1], strict=True)]),
        np.concatenate([w for w, _ in maps]),
        np.concatenate([loop + start for (_, loop), start in zip(maps, starts[:-1], strict=True)]),
        np.repeat(np.arange(4), [len(F) for _, F in meshes]),
    )
    assert righted.tolist() == [True, False, True, True]
    for k in (0, 2, 3):
        alone = placed(meshes[k][1], *maps[k])
        np.testing.assert_allclose(together[starts[k] : starts[k + 1]], alone, atol=1e-12)


def test_however_many_are_placed_at_once_and_whatever_is_around_them(rng):
    """Where vertices are many, those with five triangles around them are placed apart from those with ten."""
    meshes = [random_delaunay(60, seed=n) for n in range(25)]
    maps = [stirred(rng, V, F) for V, F in meshes]
    starts = np.cumsum([0, *(len(V) for V, _ in meshes)])
    F = np.concatenate([F + start for (_, F), start in zip(meshes, starts[:-1], strict=True)])
    around = np.bincount(F.ravel())
    assert {5, 6, 7, 8, 9} <= set(around.tolist())
    together, righted = placed_each(
        F,
        np.concatenate([w for w, _ in maps]),
        np.concatenate([loop + start for (_, loop), start in zip(maps, starts[:-1], strict=True)]),
        np.repeat(np.arange(25), [len(F) for _, F in meshes]),
    )
    assert righted.sum() > 15
    for k, (_, F) in enumerate(meshes):
        alone = placed(F, *maps[k])
        assert (alone is not None) == righted[k]
        if righted[k]:
            np.testing.assert_allclose(together[starts[k] : starts[k + 1]], alone, atol=1e-12)


def test_tries_are_made_when_fewer_are_left_and_ever_more_rarely():
    tries = RetrySchedule()
    assert not tries.due(0)
    counts = [200, 13, 12, 12, 10, 8, 8, 8, 8, 8, 8, 8, 8, 8, 8]
    assert [k for k, inverted in enumerate(counts) if tries.due(inverted)] == [2, 5, 13]
    # The first map is tried with more.
    assert RetrySchedule().due(100)
    assert not RetrySchedule().due(101)


class TestWithin:
    NAMES = "maze:0:0.5", "comb:1:0.4", "flow:3:0.5", "pins:2:0.4"

    def made(self):
        cases = [problems.make(*problems.parse(name), triangles=400) for name in self.NAMES]
        return [Problem(case.V, case.F, case.fixed, case.target) for case in cases]

    def test_a_descent_ends_sooner_and_its_tensors_are_those_of_its_map(self):
        fewer = 0
        for problem in self.made():
            plain, helped = (solve(problem, strategy=[VectorAdam(placing=placing)]) for placing in (False, True))
            assert helped.injective
            assert helped.iterations <= plain.iterations
            fewer += helped.iterations < plain.iterations
            np.testing.assert_allclose(quasi_harmonic_map(problem, helped.mu), helped.uv, atol=1e-8)
        assert fewer >= 2

    def test_many_together_are_as_each(self):
        for problem, together in zip(self.made(), injective_maps(self.made()), strict=True):
            alone = solve(problem)
            assert [step.inverted for step in together.history] == [step.inverted for step in alone.history]
            np.testing.assert_allclose(together.uv, alone.uv, atol=1e-9)
            np.testing.assert_allclose(together.mu, alone.mu, atol=1e-6)
            np.testing.assert_allclose(together.history[-1].energy, alone.history[-1].energy, atol=1e-12)

    def test_the_papers_pipeline_does_without(self):
        problem = self.made()[0]
        assert any(getattr(stage.begins_with, "placing", False) for stage in speed(problem))
        assert not any(getattr(stage.begins_with, "placing", False) for stage in paper(problem))
