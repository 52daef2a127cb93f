"""The derivative of quasi-harmonic maps against differences of `quasi_harmonic_map` itself."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from quasiharmonic import Problem, quasi_harmonic_derivative, quasi_harmonic_map
from quasiharmonic.apps.gradients import Doubt
from shared.derivative_problems import held_ring, tensors, worst_difference


@pytest.mark.parametrize("curved", [False, True], ids=["flat", "curved"])
@pytest.mark.parametrize("reference", ["equilateral", "rest", "corrected"])
def test_every_argument_against_differences(reference, curved):
    problem = held_ring(curved, pins=2)
    arguments = {"mu": tensors(len(problem.F)), "target": problem.target, "rest": problem.V}
    if reference == "equilateral":
        del arguments["rest"]

    def make(mu, target, rest=problem.V):
        return quasi_harmonic_derivative(Problem(rest, problem.F, problem.fixed, target), mu, reference=reference)

    off, skew = worst_difference(make, arguments)
    assert off < 1e-8
    assert skew < 1e-12


def test_a_clockwise_mesh():
    problem = held_ring()
    mirrored = problem.V * [1, -1]

    def make(mu, target, rest):
        return quasi_harmonic_derivative(Problem(rest, problem.F, problem.fixed, target), mu, reference="corrected")

    arguments = {"mu": tensors(len(problem.F)), "target": problem.target * [1, -1], "rest": mirrored}
    off, skew = worst_difference(make, arguments)
    assert off < 1e-8
    assert skew < 1e-12


def test_the_map_equals_that_of_the_library():
    problem, mu = held_ring(), tensors(len(held_ring().F))
    derivative = quasi_harmonic_derivative(problem, mu)
    assert np.array_equal(derivative.uv, quasi_harmonic_map(problem, mu))
    assert not derivative.uv.flags.writeable
    # Equilateral triangles do not depend on the surface.
    assert not derivative.jvp(rest=problem.V).any()
    assert not derivative.vjp(derivative.uv).rest.any()


def test_clipped_tensors_are_doubtful():
    problem = held_ring()
    mu = tensors(len(problem.F))
    mu[0] = 1 - 1e-10
    assert quasi_harmonic_derivative(problem, mu).doubts == (Doubt.CLIPPED,)


def test_threads_get_equal_results():
    problem = held_ring()
    cotangents = np.random.default_rng(4).standard_normal((8, problem.n, 2))
    # Two derivatives of one problem alternate in the memory of one factor.
    derivatives = [quasi_harmonic_derivative(problem, mu) for mu in (None, tensors(len(problem.F)))]
    wanted = [[d.vjp(c).target for c in cotangents] for d in derivatives]
    found = [[None] * len(cotangents) for _ in derivatives]

    def work(k):
        for i, cotangent in enumerate(cotangents):
            found[k][i] = derivatives[k].vjp(cotangent).target

    threads = [threading.Thread(target=work, args=(k,)) for k in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.array_equal(found, wanted)


def test_errors():
    problem = held_ring()
    derivative = quasi_harmonic_derivative(problem, tensors(len(problem.F)))
    with pytest.raises(ValueError, match=r"target must have shape \(\d+, 2\)"):
        derivative.jvp(target=problem.target[:3])
    with pytest.raises(ValueError, match=r"rest must have the shape of the rest positions, .* not \(3, 2\)"):
        derivative.jvp(rest=problem.V[:3])
    with pytest.raises(ValueError, match=r"mu must contain \d+ numbers"):
        derivative.jvp(mu=np.zeros(3))
    with pytest.raises(ValueError, match="mu is not finite at triangle 1"):
        derivative.jvp(mu=np.where(np.arange(len(problem.F)) == 1, np.nan, 0))
    cotangent = np.zeros((problem.n, 2))
    cotangent[4] = np.inf
    with pytest.raises(ValueError, match="cotangent is not finite at vertex 4"):
        derivative.vjp(cotangent)
    with pytest.raises(ValueError, match="cotangent must have shape"):
        derivative.vjp(np.zeros((3, 2)))
