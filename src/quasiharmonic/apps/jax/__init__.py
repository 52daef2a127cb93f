"""Maps as functions of JAX, with gradients.

Parameters, results and errors are those of the functions of the same names in `quasiharmonic.torch`, with JAX arrays in
place of tensors. First call ``jax.config.update("jax_enable_x64", True)``. Besides leading batch axes, `jax.vmap` adds
one as well. Under `jax.jit` the maps are computed by a callback (`jax.pure_callback`), and JAX raises its own error
with the message of `MapNotFound`. First derivatives are available in reverse mode (`jax.grad`, `jax.vjp`). JAX does not
support `jax.jvp` of these functions.

The package builds on `apps.gradients.layers`. Start reading here, then `callbacks`.
"""

from __future__ import annotations

from quasiharmonic.util.optional import explain_missing

with explain_missing("quasiharmonic.jax needs JAX", "'quasiharmonic[jax]'"):
    import jax

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.layers import (
    DoubtfulDerivative,
    FlattenLayer,
    MapNotFound,
    PolishLayer,
    TensorLayer,
)
from quasiharmonic.apps.jax.callbacks import apply_layer
from quasiharmonic.energies.energies import Energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem

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
    return apply_layer(TensorLayer(problem, reference, linear_solver), {"mu": mu, "target": target, "rest": rest})


def injective_map(
    problem: Problem,
    *,
    target: jax.Array | None = None,
    rest: jax.Array | None = None,
    polish: str | Energy = "symmetric-dirichlet",
    slide: bool | BoundaryCurves = False,
    start: ArrayLike | None = None,
    linear_solver: str = "auto",
) -> jax.Array:
    """Return polished injective maps (…, n, 2) float64 of arrays, as `quasiharmonic.torch.injective_map`."""
    first = None if start is None else np.asarray(start, dtype=np.float64)
    return apply_layer(PolishLayer(problem, polish, slide, first, linear_solver), {"target": target, "rest": rest})


def flatten(
    rest: jax.Array,
    F: ArrayLike,
    *,
    fixed: ArrayLike | None = None,
    target: jax.Array | None = None,
    energy: str | Energy = "symmetric-dirichlet",
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
    linear_solver: str = "auto",
) -> jax.Array:
    """Return maps (…, n, 2) float64 with a free boundary, as `quasiharmonic.torch.flatten`."""
    layer = FlattenLayer.of(rest, F, fixed, target, energy=energy, weights=weights, start=start, solver=linear_solver)
    return apply_layer(layer, {"rest": rest, "target": target})
