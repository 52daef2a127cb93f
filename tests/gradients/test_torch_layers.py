"""Maps as functions of PyTorch: gradcheck, batches, compilation, and errors."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import injective_map, injective_maps, polish_derivative
from quasiharmonic.apps.gradients import Doubt
from quasiharmonic.apps.gradients import layers as shared_layers
from shared.derivative_problems import flattened_ring, held_ring, tensors

torch = pytest.importorskip("torch")
layers = pytest.importorskip("quasiharmonic.torch")

# A warning of PyTorch about itself.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")


def leaf(values):
    return torch.tensor(values, requires_grad=True)


def check(function, *arguments):
    assert torch.autograd.gradcheck(
        function, tuple(map(leaf, arguments)), fast_mode=True, check_forward_ad=True, atol=1e-6
    )


@pytest.mark.parametrize("reference", ["equilateral", "rest", "corrected"])
def test_quasi_harmonic_maps(reference):
    problem = held_ring(curved=True)
    check(
        lambda mu, target, rest: layers.quasi_harmonic_map(problem, mu, target=target, rest=rest, reference=reference),
        tensors(len(problem.F)),
        np.stack([problem.target, 1.1 * problem.target]),
        problem.V,
    )


def test_injective_maps():
    problem = held_ring(curved=True)
    check(lambda target, rest: layers.injective_map(problem, target=target, rest=rest), problem.target, problem.V)


@pytest.mark.parametrize("pins", [(), (3, 20, 31)], ids=["free", "three pins"])
def test_flat_maps(pins):
    V, F, fixed, places, _ = flattened_ring(pins)
    if len(pins):
        check(lambda rest, target: layers.flatten(rest, F, fixed=fixed, target=target), V, places)
        return

    def shape(rest):
        # A loss that does not depend on the position of the map.
        uv = layers.flatten(rest, F)
        return torch.linalg.vector_norm(uv[..., F, :] - uv[..., np.roll(F, 1, axis=1), :], dim=-1)

    check(shape, np.stack([V, 1.2 * V]))


def test_batches_are_evaluated_together():
    problem = held_ring()
    targets = leaf(np.stack([[problem.target, 1.1 * problem.target], [1.2 * problem.target, 0.9 * problem.target]]))
    mu = leaf(np.stack([tensors(len(problem.F)), tensors(len(problem.F)).conj()]))
    maps = layers.quasi_harmonic_map(problem, mu, target=targets)
    assert maps.shape == (2, 2, problem.n, 2)
    (maps**3).sum().backward()
    mine = leaf(targets.detach()[1, 0].numpy()), leaf(mu.detach()[0].numpy())
    one = layers.quasi_harmonic_map(problem, mine[1], target=mine[0])
    (one**3).sum().backward()
    assert torch.equal(one, maps[1, 0])
    assert torch.allclose(targets.grad[1, 0], mine[0].grad)
    # Gradients in quantities shared by a batch are sums.
    other = leaf(mu.detach()[0].numpy())
    (layers.quasi_harmonic_map(problem, other, target=targets.detach()[:, 0]) ** 3).sum().backward()
    assert torch.allclose(mu.grad[0], other.grad)


def test_lazily_conjugated_tensors():
    """PyTorch conjugates when necessary, and until then marks a tensor as conjugated."""
    problem = held_ring()
    mu = leaf(tensors(len(problem.F)))
    maps = layers.quasi_harmonic_map(problem, mu.conj())
    assert torch.equal(maps, layers.quasi_harmonic_map(problem, mu.detach().conj().resolve_conj()))
    (maps**3).sum().backward()
    other = leaf(mu.detach().conj().resolve_conj().numpy())
    (layers.quasi_harmonic_map(problem, other) ** 3).sum().backward()
    assert torch.allclose(mu.grad, other.grad.conj())


def test_the_map_is_the_converged_map_of_the_library():
    problem = held_ring()
    maps = layers.injective_map(problem, target=leaf(problem.target))
    found = injective_map(problem.V, problem.F, problem.fixed, problem.target, polish="symmetric-dirichlet")
    derivative = polish_derivative(problem.V, problem.F, found.uv, fixed=problem.fixed)
    assert np.array_equal(maps.detach().numpy(), derivative.uv)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_compiled_programs_break_the_graph_around_it():
    problem = held_ring()
    target = torch.tensor(problem.target)

    def loss(scale):
        return (layers.quasi_harmonic_map(problem, target=scale * target) ** 2).sum()

    scale, other = leaf(1.5), leaf(1.5)
    torch.compile(loss, backend="eager")(scale).backward()
    loss(other).backward()
    assert torch.equal(scale.grad, other.grad)


def test_full_graph_compilation_names_the_reason_of_failure():
    problem = held_ring()
    target = torch.tensor(problem.target)
    whole = torch.compile(lambda t: layers.quasi_harmonic_map(problem, target=t), backend="eager", fullgraph=True)
    with pytest.raises(Exception, match="maps are computed by NumPy and SciPy"):
        whole(target)


def test_a_second_derivative_is_rejected():
    problem = held_ring()
    target = leaf(problem.target)
    maps = layers.quasi_harmonic_map(problem, target=target)
    with pytest.raises(RuntimeError, match="first derivatives only: omit create_graph=True"):
        torch.autograd.grad((maps**2).sum(), target, create_graph=True)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.functional.hessian(
            lambda target: layers.quasi_harmonic_map(problem, target=target).square().sum(), target.detach()
        )


def test_errors():
    problem = held_ring()
    target = leaf(problem.target)
    with pytest.raises(TypeError, match=r"target must be a tensor, not ndarray"):
        layers.quasi_harmonic_map(problem, target=problem.target)
    with pytest.raises(TypeError, match=r"target must be of torch.float64 or torch.float32, not torch.float16: target"):
        layers.injective_map(problem, target=target.half())
    with pytest.raises(TypeError, match=r"mu must be of torch.complex128 or torch.complex64, not torch.float64"):
        layers.quasi_harmonic_map(problem, torch.zeros(len(problem.F), dtype=torch.float64))
    with pytest.raises(ValueError, match="target is on meta, but maps are computed on the CPU"):
        layers.injective_map(problem, target=target.to("meta"))
    with pytest.raises(ValueError, match=r"target must have shape \(\d+, 2\), or batch axes before it, not \(3"):
        layers.injective_map(problem, target=target[:3])
    with pytest.raises(ValueError, match="give fixed and target together"):
        layers.flatten(leaf(problem.V), problem.F, target=target)
    with pytest.raises(NotImplementedError, match=r"do not use torch\.func\.vmap"):
        torch.func.vmap(lambda target: layers.quasi_harmonic_map(problem, target=target))(target[None])
    with pytest.raises(NotImplementedError, match=r"but not torch\.func"):
        torch.func.grad(lambda target: layers.quasi_harmonic_map(problem, target=target).sum())(target)


def test_the_error_for_a_map_that_is_not_found_names_it():
    problem = held_ring()
    mirrored = np.stack([problem.target, problem.target * [1, -1]])
    with pytest.raises(layers.MapNotFound, match="no injective map was found") as caught:
        layers.injective_map(problem, target=leaf(mirrored))
    assert caught.value.__notes__ == ["This is item 1 of the batch."]
    assert not caught.value.result.injective


def test_a_doubtful_gradient_warns():
    problem = held_ring()
    mu = tensors(len(problem.F))
    mu[0] = 1 - 1e-10
    maps = layers.quasi_harmonic_map(problem, leaf(mu))
    with pytest.warns(layers.DoubtfulDerivative, match=Doubt.CLIPPED.value[:20]):
        maps.sum().backward()


def test_single_precision_is_computed_in_double():
    problem = held_ring()
    exact, mu = leaf(problem.target), leaf(tensors(len(problem.F)))
    single = exact.detach().float().requires_grad_()
    mu_single = mu.detach().to(torch.complex64).requires_grad_()
    for function, wide, narrow in (
        (lambda t: layers.injective_map(problem, target=t), exact, single),
        (lambda m: layers.quasi_harmonic_map(problem, m), mu, mu_single),
    ):
        maps = function(narrow)
        assert maps.dtype == torch.float32
        torch.testing.assert_close(maps.double(), function(wide), rtol=1e-5, atol=1e-6)
        (maps**2).sum().backward()
        (function(wide) ** 2).sum().backward()
        assert narrow.grad.dtype == narrow.dtype
        torch.testing.assert_close(narrow.grad.to(wide.dtype), wide.grad, rtol=1e-3, atol=1e-4)
    assert layers.quasi_harmonic_map(problem, mu_single, target=exact).dtype == torch.float64


def test_a_batch_is_solved_as_a_batch(monkeypatch):
    problem, calls = held_ring(), []

    def count(problems, **given):
        calls.append(given)
        return injective_maps(problems, **given)

    monkeypatch.setattr(shared_layers, "injective_maps", count)
    targets = leaf(np.stack([problem.target, 1.1 * problem.target, problem.target * [1, 0.9]]))
    maps = layers.injective_map(problem, target=targets)
    assert len(calls) == 1
    for uv, target in zip(maps, targets, strict=True):
        torch.testing.assert_close(uv, layers.injective_map(problem, target=target), rtol=1e-9, atol=1e-9)
    assert len(calls) == 1
