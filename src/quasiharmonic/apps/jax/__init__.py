"""Maps as functions of JAX, with gradients.

Parameters, results and errors are those of the functions of the same names in `quasiharmonic.torch`, with JAX arrays in
place of tensors. First call ``jax.config.update("jax_enable_x64", True)``. Besides leading batch axes, `jax.vmap` adds
one as well. Under `jax.jit` the maps are computed by a callback (`jax.pure_callback`), and JAX raises its own error
with the message of `MapNotFound`. First derivatives are available in reverse mode (`jax.grad`, `jax.vjp`). JAX does not
support `jax.jvp` of these functions.

The package builds on `apps.gradients.layers`. Start reading here, then `callbacks`.
"""

from __future__ import annotations

from typing import Unpack

from quasiharmonic.util.optional import explain_missing

with explain_missing("quasiharmonic.jax needs JAX", "'quasiharmonic[jax]'"):
    import jax

from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.layers import (
    DoubtfulDerivative,
    FlattenedKeywords,
    MapNotFound,
    SolvedKeywords,
    SolvedOptions,
    make_flattened_layer,
    make_solved_layer,
    make_tensor_layer,
)
from quasiharmonic.apps.jax.callbacks import apply_layer
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.util.options import FlattenOptions, takes

__all__ = ["DoubtfulDerivative", "MapNotFound", "flatten", "injective_map", "quasi_harmonic_map"]


def quasi_harmonic_map(
    problem: Problem,
    mu: jax.Array | None = None,
    *,
    target: jax.Array | None = None,
    rest: jax.Array | None = None,
    reference: Reference = "equilateral",
    linear_solver: str = "auto",
) -> jax.Array:
    """Return quasi-harmonic maps (…, n, 2) float64 of arrays, as `quasiharmonic.torch.quasi_harmonic_map`.

    The gradient by ``mu`` is ``∂/∂Re μ − i ∂/∂Im μ``, JAX's convention.
    """
    settings = problem, reference, linear_solver
    return apply_layer(make_tensor_layer, settings, {"mu": mu, "target": target, "rest": rest})


@takes(SolvedOptions, SolvedKeywords)
def injective_map(
    problem: Problem,
    *,
    target: jax.Array | None = None,
    rest: jax.Array | None = None,
    **options: Unpack[SolvedKeywords],
) -> jax.Array:
    """Return polished injective maps (…, n, 2) float64 of arrays, as `quasiharmonic.torch.injective_map`."""
    return apply_layer(make_solved_layer, (problem, options), {"target": target, "rest": rest})


@takes(FlattenOptions, FlattenedKeywords)
def flatten(
    rest: jax.Array, F: ArrayLike, *, target: jax.Array | None = None, **options: Unpack[FlattenedKeywords]
) -> jax.Array:
    """Return maps (…, n, 2) float64 with a free boundary, as `quasiharmonic.torch.flatten`."""
    return apply_layer(make_flattened_layer, (rest, F, target, options), {"rest": rest, "target": target})
