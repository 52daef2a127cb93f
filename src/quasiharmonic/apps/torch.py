"""Maps as layers of PyTorch, with gradients.

Tensors are on the CPU, in double or single precision (``mu`` in complex128 or complex64). Maps are computed in double
precision, and returned in single precision if all arguments are. Every argument may have leading batch axes. First
derivatives are available in backward and forward mode. `torch.compile` breaks the graph at a map, and compiles the code
around it. Transforms of `torch.func` are not supported and raise an error.

All maps share one autograd function, behind `apply_layer`, and build on `apps.gradients.layers`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from quasiharmonic.util.hints import explain_missing

with explain_missing("quasiharmonic.torch needs PyTorch", extra="torch"):
    import torch

from quasiharmonic.apps.gradients.derivative import Derivative
from quasiharmonic.apps.gradients.layers import (
    Array,
    DoubtfulDerivative,
    Layer,
    LayerFunctions,
    MapNotFound,
    argument_types,
    compute_changes,
    compute_gradients,
    compute_maps,
    select_arguments,
    sum_to_shape,
)

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
    names, tensors, single = select_arguments(layer, arguments, _check, "to({})", prefix="torch.")
    wide = (tensor.to(getattr(torch, argument_types(name)[0])) for name, tensor in zip(names, tensors, strict=True))
    maps: torch.Tensor = _Map.apply(layer, names, *wide)[0]
    return maps.float() if single else maps


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
    def backward(ctx: Any, cotangent: torch.Tensor | None, _: None) -> tuple[torch.Tensor | None, ...]:
        """Gradients with respect to the arguments that need them; RuntimeError if they are to be differentiated."""
        if cotangent is None:
            return (None,) * (2 + len(ctx.names))
        values = _numpy(cotangent)
        # `once_differentiable` would raise later, and not at all if its node is not needed for the argument.
        if torch.is_grad_enabled():
            raise RuntimeError("maps have first derivatives only: omit create_graph=True, or detach the map")
        needed = [name for name, needs in zip(ctx.names, ctx.needs_input_grad[2:], strict=True) if needs]
        found = compute_gradients(ctx.layer, ctx.derivatives, values, needed)
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
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{name} must be a tensor, not {type(tensor).__name__}")
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} is on {tensor.device}, but maps are computed on the CPU: {name}.cpu()")


_functions = LayerFunctions(apply_layer)
quasi_harmonic_map = _functions.quasi_harmonic_map
injective_map = _functions.injective_map
flatten = _functions.flatten
