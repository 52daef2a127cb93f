"""Maps as functions of JAX: its own gradient check, jit, vmap, batches, and errors."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from quasiharmonic.apps.gradients.layers import make_flattened_layer, make_solved_layer
from shared.derivative_problems import flattened_ring, held_ring, tensors

jax = pytest.importorskip("jax")
layers = pytest.importorskip("quasiharmonic.jax")


@pytest.fixture(autouse=True)
def double():
    """In double precision, like the maps."""
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def check(function, *arguments):
    from jax.test_util import check_grads

    check_grads(function, arguments, order=1, modes=["rev"], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("reference", ["equilateral", "rest", "corrected"])
@pytest.mark.parametrize("wrapped", [lambda f: f, jax.jit], ids=["as it is", "jit"])
def test_quasi_harmonic_maps(wrapped, reference):
    problem = held_ring(curved=True)

    def maps(mu, target, rest):
        return layers.quasi_harmonic_map(problem, mu, target=target, rest=rest, reference=reference)

    check(wrapped(maps), tensors(len(problem.F)), np.stack([problem.target, 1.1 * problem.target]), problem.V)


def test_injective_maps():
    problem = held_ring(curved=True)
    maps = jax.jit(lambda target, rest: layers.injective_map(problem, target=target, rest=rest))
    check(maps, problem.target, problem.V)


@pytest.mark.parametrize("pins", [(), (3, 20, 31)], ids=["free", "three pins"])
def test_flat_maps(pins):
    V, F, fixed, places, _ = flattened_ring(pins)
    if len(pins):
        check(lambda rest, target: layers.flatten(rest, F, fixed=fixed, target=target), V, places)
        return

    def shape(rest):
        # A loss that does not depend on the position of the map.
        uv = layers.flatten(rest, F)
        return jax.numpy.sum((uv[..., F, :] - uv[..., np.roll(F, 1, axis=1), :]) ** 2, axis=-1)

    check(shape, np.stack([V, 1.2 * V]))


def test_vmap_is_a_batch():
    problem = held_ring()
    targets = np.stack([problem.target, 1.1 * problem.target, 0.9 * problem.target])
    mu = tensors(len(problem.F))

    def loss(mu, target):
        return (layers.quasi_harmonic_map(problem, mu, target=target) ** 3).sum()

    by_vmap = jax.jit(jax.vmap(jax.grad(loss, argnums=(0, 1)), in_axes=(None, 0)))(mu, targets)
    together = jax.grad(loss, argnums=(0, 1))(mu, targets)
    assert np.allclose(by_vmap[0].sum(axis=0), together[0])
    assert np.allclose(by_vmap[1], together[1])
    one = jax.grad(loss, argnums=1)(mu, targets[1])
    assert np.allclose(one, together[1][1])


@pytest.mark.parametrize("count", [2, 3])
def test_vmap_over_one_argument_of_a_batch_over_another(count):
    """Three targets inside, and tensors outside: as many as there are targets, or another number."""
    problem = held_ring()
    targets = np.stack([problem.target, 1.1 * problem.target, 0.9 * problem.target])
    mu = np.stack([0.2 * (k + 1) * tensors(len(problem.F)) for k in range(count)])

    def loss(mu):
        return (layers.quasi_harmonic_map(problem, mu, target=targets) ** 3).sum()

    gradients = jax.vmap(jax.grad(loss))(mu)
    assert np.allclose(gradients, np.stack([jax.grad(loss)(one) for one in mu]), rtol=1e-12)
    maps = jax.vmap(lambda mu: layers.quasi_harmonic_map(problem, mu, target=targets))(mu)
    assert np.array_equal(maps[1, 2], layers.quasi_harmonic_map(problem, mu[1], target=targets[2]))


def test_programs_are_compiled_once():
    """Layers that are made in each iteration of a loop with the same settings are equal for JAX."""
    problem = held_ring()
    V, F, _, _, _ = flattened_ring()
    traced = []

    @partial(jax.jit, static_argnums=0)
    def program(layer):
        traced.append(layer)
        return 0

    for _ in range(3):
        program(make_solved_layer(problem, {"polish": "mips", "start": 1.0 * V}))
        program(make_flattened_layer(V, F.copy(), None, {"energy": "mips"}))
    assert len(traced) == 2
    program(make_solved_layer(problem, {"polish": "mips", "start": 1.1 * V}))
    program(make_solved_layer(held_ring(), {"polish": "mips", "start": 1.0 * V}))
    assert len(traced) == 4


def test_more_maps_than_derivatives_are_cached():
    problem = held_ring()
    targets = np.stack([(1 + 0.01 * k) * problem.target for k in range(20)])
    gradient = jax.grad(lambda target: (layers.injective_map(problem, target=target) ** 2).sum())(targets)
    first = jax.grad(lambda target: (layers.injective_map(problem, target=target) ** 2).sum())(targets[0])
    assert np.allclose(gradient[0], first, rtol=1e-8)


def test_errors():
    problem = held_ring()
    with pytest.raises(ValueError, match=r"batch shapes must be broadcastable, not mu \(2,\), target \(3,\)"):
        layers.quasi_harmonic_map(
            problem, np.zeros((2, len(problem.F)), complex), target=np.stack([problem.target] * 3)
        )
    with pytest.raises(TypeError, match="target must be an array, not list"):
        layers.injective_map(problem, target=[1.0])
    with pytest.raises(TypeError, match=r"target must be of float64 or float32, not int64: target.astype\('float64'\)"):
        layers.injective_map(problem, target=problem.target.astype(np.int64))
    with pytest.raises(TypeError, match="mu must be of complex128 or complex64"):
        layers.quasi_harmonic_map(problem, np.zeros(len(problem.F)))
    with pytest.raises(ValueError, match=r"target must have shape \(\d+, 2\), or batch axes before it, not \(3"):
        layers.injective_map(problem, target=problem.target[:3])
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(lambda target: layers.injective_map(problem, target=target), (problem.target,), (problem.target,))


def test_the_error_for_a_map_that_is_not_found_names_it():
    problem = held_ring()
    mirrored = np.stack([problem.target, problem.target * [1, -1]])
    with pytest.raises(layers.MapNotFound, match="no injective map was found") as found:
        layers.injective_map(problem, target=mirrored)
    assert found.value.result.diagnosis is not None
    with pytest.raises(Exception, match="MapNotFound") as caught:
        jax.jit(lambda target: layers.injective_map(problem, target=target))(mirrored).block_until_ready()
    assert "no injective map was found" in str(caught.value)


@pytest.mark.parametrize("double", [True, False])
def test_single_precision_is_computed_in_double(double):
    problem = held_ring()

    def loss(target):
        return (layers.injective_map(problem, target=target) ** 2).sum()

    exact, slope = layers.injective_map(problem, target=problem.target), jax.grad(loss)(problem.target)
    jax.config.update("jax_enable_x64", double)
    target = np.float32(problem.target)
    maps = jax.jit(lambda target: layers.injective_map(problem, target=target))(target)
    assert maps.dtype == np.float32
    np.testing.assert_allclose(maps, exact, rtol=1e-5, atol=1e-6)
    gradient = jax.grad(loss)(target)
    assert gradient.dtype == np.float32
    np.testing.assert_allclose(gradient, slope, rtol=1e-3, atol=1e-4)
