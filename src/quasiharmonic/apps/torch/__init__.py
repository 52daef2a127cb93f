"""Maps as layers of PyTorch, with gradients.

Tensors are in double precision (``mu`` in complex128) and on the CPU. Every argument may have leading batch axes. First
derivatives are available in backward and forward mode. `torch.compile` breaks the graph at a map, and compiles the code
around it. Transforms of `torch.func` are not supported and raise an error.

The package builds on `apps.gradients.layers`. Start reading here, then `function`.
"""

from __future__ import annotations

from typing import Unpack

from quasiharmonic.util.optional import explain_missing

with explain_missing("quasiharmonic.torch needs PyTorch", "'quasiharmonic[torch]'"):
    import torch

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
from quasiharmonic.apps.torch.function import apply_layer
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.util.options import FlattenOptions, takes

__all__ = ["DoubtfulDerivative", "MapNotFound", "flatten", "injective_map", "quasi_harmonic_map"]


def quasi_harmonic_map(
    problem: Problem,
    mu: torch.Tensor | None = None,
    *,
    target: torch.Tensor | None = None,
    rest: torch.Tensor | None = None,
    reference: Reference = "equilateral",
    linear_solver: str = "auto",
) -> torch.Tensor:
    """Return quasi-harmonic maps of tensors, as `quasiharmonic.quasi_harmonic_map`.

    Parameters
    ----------
    problem : Problem
        Triangles, fixed vertices, and the values of omitted arguments.
    mu : (…, f) complex128, optional
        Beltrami coefficients; zero by default. Their gradient is ``∂/∂Re μ + i ∂/∂Im μ``, PyTorch's convention.
    target : (…, k, 2) float64, optional
        Target positions of the fixed vertices.
    rest : (…, n, 2) or (…, n, 3) float64, optional
        Rest positions. They matter only with a ``reference`` other than ``"equilateral"``.
    reference, linear_solver
        As for `quasiharmonic.quasi_harmonic_map`.

    Returns
    -------
    (…, n, 2) float64
        Injective only if the target is convex or μ is suitable.

    Raises
    ------
    TypeError
        If an argument is not a tensor, or has the wrong dtype.
    ValueError
        If an argument is on another device or has the wrong shape, or `quasiharmonic.quasi_harmonic_map` raises it.
    """
    settings = problem, reference, linear_solver
    return apply_layer(make_tensor_layer, settings, {"mu": mu, "target": target, "rest": rest})


@takes(SolvedOptions, SolvedKeywords)
def injective_map(
    problem: Problem,
    *,
    target: torch.Tensor | None = None,
    rest: torch.Tensor | None = None,
    **options: Unpack[SolvedKeywords],
) -> torch.Tensor:
    """Return polished injective maps of tensors, as `quasiharmonic.solve`, converged to rounding.

    Parameters
    ----------
    problem, target, rest
        As for `quasi_harmonic_map`.
    polish, slide, start, linear_solver
        As for `quasiharmonic.solve`; ``start`` is shared by the whole batch. If the boundary slides along curves that
        are not straight, gradients are typically accurate to 0.5 % (see `polish_derivative`).

    Returns
    -------
    (…, n, 2) float64

    Raises
    ------
    TypeError, ValueError
        As `quasi_harmonic_map`, or as `quasiharmonic.solve`.
    MapNotFound
        If no injective map was found for one item of the batch.
    """
    return apply_layer(make_solved_layer, (problem, options), {"target": target, "rest": rest})


@takes(FlattenOptions, FlattenedKeywords)
def flatten(
    rest: torch.Tensor, F: ArrayLike, *, target: torch.Tensor | None = None, **options: Unpack[FlattenedKeywords]
) -> torch.Tensor:
    """Return maps with a free boundary, as `quasiharmonic.flatten`, converged to rounding.

    Parameters
    ----------
    rest : (…, n, 2) or (…, n, 3) tensor of float64
        Rest positions of one connected surface.
    F : (f, 3) array of int
        Triangles.
    fixed : (k,) array of int, optional
        Fixed vertices.
    target : (…, k, 2) tensor of float64, optional
        Target positions of the fixed vertices.
    energy, weights, start, linear_solver
        As for `quasiharmonic.flatten`; ``start`` is shared by the whole batch.

    Returns
    -------
    (…, n, 2) float64
        Without ``fixed``, the gradient is that of the map nearest to this one, although `flatten` would lay it out
        differently. Use functions that do not depend on the map's position and rotation.

    Raises
    ------
    TypeError, ValueError
        As `quasi_harmonic_map`, or as `quasiharmonic.flatten`.
    MapNotFound
        If no injective map was found for one item of the batch.
    """
    return apply_layer(make_flattened_layer, (rest, F, target, options), {"rest": rest, "target": target})
