"""Maps as layers of PyTorch, with gradients.

Tensors are in double precision (``mu`` in complex128) and on the CPU. Every argument may have leading batch axes. First
derivatives are available in backward and forward mode. `torch.compile` breaks the graph at a map, and compiles the code
around it. Transforms of `torch.func` are not supported and raise an error.

All maps share one autograd function, `apply_layer`, and build on `apps.gradients.layers`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Unpack

from quasiharmonic.util.optional import explain_missing, with_extra

with explain_missing("quasiharmonic.torch needs PyTorch", with_extra("torch")):
    import torch
    from torch.autograd.function import once_differentiable

from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.derivative import Derivative
from quasiharmonic.apps.gradients.layers import (
    Array,
    DoubtfulDerivative,
    FlattenedKeywords,
    Layer,
    MapNotFound,
    SolvedKeywords,
    SolvedOptions,
    compute_changes,
    compute_gradients,
    compute_maps,
    make_flattened_layer,
    make_solved_layer,
    make_tensor_layer,
    select_arguments,
    sum_to_shape,
)
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.util.options import FlattenOptions, takes

__all__ = ["DoubtfulDerivative", "MapNotFound", "flatten", "injective_map", "quasi_harmonic_map"]

_COMPILED = "maps are computed by NumPy and SciPy, so torch.compile breaks the graph here"


@torch.compiler.disable(reason=_COMPILED)  # type: ignore[untyped-decorator]
def apply_layer(
    make: Callable[..., Layer], settings: tuple[Any, ...], arguments: Mapping[str, torch.Tensor | None]
) -> torch.Tensor:
    """Return the maps of a layer for its arguments, without those that are None; check types, devices and shapes.

    The layer is made from its settings here, because `torch.compile` does not follow this function.
    """
    layer = make(*settings)
    names, tensors = select_arguments(layer, arguments, _check)
    maps: torch.Tensor = _Map.apply(layer, names, *tensors)[0]
    return maps


class _Map(torch.autograd.Function):  # type: ignore[misc]
    """The autograd function from arguments to maps."""

    @staticmethod
    def forward(
        layer: Layer, names: tuple[str, ...], *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, Sequence[Derivative]]:
        """Compute the maps and their derivatives."""
        arrays = {name: _numpy(tensor) for name, tensor in zip(names, tensors, strict=True)}
        uv, derivatives = compute_maps(layer, arrays)
        return torch.from_numpy(uv), derivatives

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        """Keep the derivatives for the backward and forward modes."""
        ctx.layer, ctx.names, *tensors = inputs
        uv, ctx.derivatives = output
        ctx.shapes, ctx.lead = [tuple(tensor.shape) for tensor in tensors], tuple(uv.shape[:-2])
        ctx.set_materialize_grads(False)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, cotangent: torch.Tensor | None, _: None) -> tuple[torch.Tensor | None, ...]:
        """Gradients with respect to the arguments that need them."""
        if cotangent is None:
            return (None,) * (2 + len(ctx.names))
        needed = [name for name, needs in zip(ctx.names, ctx.needs_input_grad[2:], strict=True) if needs]
        found = compute_gradients(ctx.layer, ctx.derivatives, _numpy(cotangent), needed)
        return (
            None,
            None,
            *(
                torch.from_numpy(sum_to_shape(found[name], shape)) if name in found else None
                for name, shape in zip(ctx.names, ctx.shapes, strict=True)
            ),
        )

    @staticmethod
    def jvp(ctx: Any, _layer: None, _names: None, *tangents: torch.Tensor | None) -> tuple[torch.Tensor, None]:
        """The change of the maps with the arguments."""
        moved = {
            name: _numpy(tangent) for name, tangent in zip(ctx.names, tangents, strict=True) if tangent is not None
        }
        return torch.from_numpy(compute_changes(ctx.layer, ctx.derivatives, ctx.lead, moved)), None

    @staticmethod
    def vmap(info: Any, in_dims: Any, *arguments: Any) -> Any:
        """Raise NotImplementedError."""
        raise NotImplementedError(
            "compute a batch of maps in one call, with batch axes first in the arguments: do not use torch.func.vmap"
        )


def _numpy(tensor: torch.Tensor) -> Array:
    """A tensor's values; raises NotImplementedError for the placeholder tensors of `torch.func`."""
    try:
        # Conjugated or negated tensors are lazy until they are resolved.
        return tensor.detach().resolve_conj().resolve_neg().numpy()
    except RuntimeError as error:
        raise NotImplementedError(
            "maps support backward(), torch.autograd.grad and forward mode, but not torch.func"
        ) from error


def _check(name: str, tensor: Any) -> None:
    wanted = torch.complex128 if name == "mu" else torch.float64
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{name} must be a tensor, not {type(tensor).__name__}")
    if tensor.dtype != wanted:
        raise TypeError(f"{name} must be of {wanted}, not {tensor.dtype}: {name}.to({wanted})")
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} is on {tensor.device}, but maps are computed on the CPU: {name}.cpu()")


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
