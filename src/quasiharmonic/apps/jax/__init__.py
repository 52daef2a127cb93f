"""Maps as functions of JAX, with gradients.

Arrays are in double precision (``mu`` in complex128), so ``jax.config.update("jax_enable_x64", True)`` comes first,
and on the CPU. Every argument may have further axes in front, over which it is a batch; `jax.vmap` adds one as well.
Under `jax.jit` the maps are made by calling back (`jax.pure_callback`). There are gradients, once (`jax.grad`,
`jax.vjp`); JAX refuses `jax.jvp` of them.

The package builds on `apps.gradients.layers`. Start reading here, then `callbacks`.
"""

from __future__ import annotations

try:
    import jax
except ImportError as error:
    raise ImportError("quasiharmonic.jax needs JAX: pip install 'quasiharmonic[jax]'") from error

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.layers import (
    DoubtfulDerivative,
    FlattenLayer,
    MapNotFound,
    PolishedLayer,
    TensorLayer,
)
from quasiharmonic.apps.jax.callbacks import applied
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
    """`quasiharmonic.quasi_harmonic_map` of arrays.

    Parameters
    ----------
    problem : Problem
        Triangles, which vertices are held, and what stands in for arguments that are left out.
    mu : (…, f) array of complex128, optional
        Beltrami coefficients; zero by default. Their gradient is ``∂/∂Re μ − i ∂/∂Im μ``, as JAX has it.
    target : (…, k, 2) array of float64, optional
    rest : (…, n, 2) or (…, n, 3) array of float64, optional
        It matters only with a ``reference`` other than ``"equilateral"``.
    reference, linear_solver
        As of `quasiharmonic.quasi_harmonic_map`.

    Returns
    -------
    (…, n, 2) array of float64
        Injective only where the target is convex or μ is right.

    Raises
    ------
    TypeError
        When an argument is no array, or of another dtype.
    ValueError
        When it is on another device, has another shape, or `quasiharmonic.quasi_harmonic_map` raises it.
    """
    return applied(TensorLayer(problem, reference, linear_solver), {"mu": mu, "target": target, "rest": rest})


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
    """Injective maps, polished and brought to rest to rounding: `quasiharmonic.solve` of arrays.

    Parameters
    ----------
    problem : Problem
        Triangles, which vertices are held, and what stands in for arguments that are left out.
    target : (…, k, 2) array of float64, optional
    rest : (…, n, 2) or (…, n, 3) array of float64, optional
    polish, slide, start, linear_solver
        As of `quasiharmonic.solve`; ``start`` serves the whole batch. Where the boundary slides along curves that are
        not straight gradients are good to half a percent as a rule, not to rounding (`polish_derivative`).

    Returns
    -------
    (…, n, 2) array of float64

    Raises
    ------
    TypeError
        When an argument is no array, or of another dtype.
    ValueError
        When it is on another device, has another shape, or `quasiharmonic.solve` raises it.
    MapNotFound
        When no injective map was found for one of the batch. Under `jax.jit` it comes as an error of JAX's own that
        has this one's words.
    """
    first = None if start is None else np.asarray(start, dtype=np.float64)
    return applied(PolishedLayer(problem, polish, slide, first, linear_solver), {"target": target, "rest": rest})


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
    """Maps with a free boundary, brought to rest to rounding: `quasiharmonic.flatten` of arrays.

    Parameters
    ----------
    rest : (…, n, 2) or (…, n, 3) array of float64
        Rest positions of one connected surface.
    F : (f, 3) array of int
        Triangles.
    fixed : (k,) array of int, optional
        Vertices held at ``target``.
    target : (…, k, 2) array of float64, optional
        Their positions.
    energy, weights, start, linear_solver
        As of `quasiharmonic.flatten`; ``start`` serves the whole batch.

    Returns
    -------
    (…, n, 2) array of float64
        Without ``fixed`` its gradient is that of the map which stays nearest to this one, wherever `flatten` would
        lay it: let nothing depend on where it lies.

    Raises
    ------
    TypeError
        When an argument is no array, or of another dtype.
    ValueError
        When it is on another device, has another shape, or `quasiharmonic.flatten` raises it.
    MapNotFound
        When no injective map was found for one of the batch. Under `jax.jit` it comes as an error of JAX's own that
        has this one's words.
    """
    layer = FlattenLayer.of(rest, F, fixed, target, energy=energy, weights=weights, start=start, solver=linear_solver)
    return applied(layer, {"rest": rest, "target": target})
