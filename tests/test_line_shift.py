"""Line-shift linear programmes along directions, compared with brute force."""

from __future__ import annotations

import numpy as np
import pytest

import problems
from quasiharmonic import Problem, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.methods import Composite, LineShift, LocalRepair, Untangling
from quasiharmonic.solver.methods.line_shift import best_shift, frame_along, shift_along_lines
from quasiharmonic.surfaces import disk, random_delaunay


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.9])
def test_a_frame_inverts_nothing_and_is_as_wide_as_long(rng, angle):
    F = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    w = np.exp(0.4j) * (1e6 * rng.standard_normal(9) + 1j * rng.standard_normal(9))
    x, y, along = frame_along(w, angle)
    np.testing.assert_allclose(np.cov(x, y, bias=True), np.eye(2), atol=1e-9)
    assert np.array_equal(signed_areas(F, w) > 0, signed_areas(F, x + 1j * y) > 0)
    # A step in x only.
    moved = w + 0.3 * along
    before, after = (np.linalg.lstsq(np.c_[w.real, w.imag, np.ones(9)], p, rcond=None)[0] for p in (x, y))
    there = np.c_[moved.real, moved.imag, np.ones(9)]
    np.testing.assert_allclose(there @ before, x + 0.3, atol=1e-6)
    np.testing.assert_allclose(there @ after, y, atol=1e-6)


def test_points_on_a_line_have_no_frame():
    assert frame_along(np.arange(5) * (1 + 0j), 0.3) is None


def test_a_vertex_moves_to_the_line_position_with_the_least_error(rng):
    """A fan whose central vertex alone is free, against brute force over its positions on the line."""
    k = 9
    F = np.stack([np.full(k, k), np.arange(k), np.roll(np.arange(k), -1)], axis=1)
    righted = 0
    for _ in range(20):
        ring = rng.uniform(0.5, 1, k) * np.exp(2j * np.pi * (np.arange(k) + rng.uniform(-0.4, 0.4, k)) / k)
        w = np.append(ring, 1.2 + 0.02j)
        step = best_shift(F, w.real, w.imag, np.arange(k + 1) < k)
        assert np.all(step[:k] == 0)
        # The apex's distance to the base along the line is twice the area, divided by the base's extent across the
        # line.
        base = np.roll(ring, -1).imag - ring.imag
        unit = np.ptp(w.real[F], axis=1).mean()
        distance = 2 * signed_areas(F, w) / np.abs(base) / unit
        least = np.where(distance > 0, np.minimum(0.1 * distance, 1), 1e-3)

        shift = np.append(np.linspace(-4, 4, 4001), step[k]) / unit
        wrong = np.maximum(least - distance + np.multiply.outer(shift, np.sign(base)), 0).sum(axis=1)
        assert wrong[-1] <= wrong.min() + 1e-9
        righted += signed_areas(F, w + step).min() > 0
    assert righted > 10


def test_fixed_vertices_do_not_change_a_bit(rng):
    V, F = random_delaunay(60, rng)
    w = V[:, 0] + 1j * V[:, 1] + 0.2 * (rng.standard_normal(len(V)) + 1j * rng.standard_normal(len(V)))
    held = rng.random(len(V)) < 0.3
    there = shift_along_lines(rng, F, w, held)
    assert np.array_equal(there[held], w[held])
    assert not np.array_equal(there, w)


def test_a_fold_of_many_triangles_is_moved_as_a_whole():
    """The inner half of a disk, moved across its rim, returns in one linear programme."""
    V, F = disk(8)
    z = V[:, 0] + 1j * V[:, 1]
    w = np.where(abs(z) < 0.5, z + 1, z)
    held = abs(z) > 0.99
    assert (signed_areas(F, w) <= 0).sum() > 20
    step = best_shift(F, w.real, w.imag, held)
    assert signed_areas(F, w + step).min() > 0


@pytest.mark.slow
def test_it_solves_a_problem_that_earlier_methods_do_not_solve():
    case = problems.make("needles", 4, 0.972)
    problem = Problem(case.V, case.F, case.fixed, case.target)
    before = [Composite(iterations=100), LocalRepair(resume=True), Untangling(resume=True)]
    assert not solve(problem, strategy=before).injective
    assert solve(problem, strategy=[*before, LineShift(max_failures=20, resume=True)]).injective
