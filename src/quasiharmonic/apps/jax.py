"""Maps as functions of JAX, with gradients.

Arrays are in double or single precision (``mu`` in complex128 or complex64). Maps are computed in double precision, and
returned in single precision if all arguments are, or JAX does not use double (``jax_enable_x64``). Besides leading
batch axes, `jax.vmap` adds one as well. Under `jax.jit` the maps are computed by a callback (`jax.pure_callback`), and
JAX raises its own error with the message of `MapNotFound`. First derivatives are available in reverse mode (`jax.grad`,
`jax.vjp`). JAX does not support `jax.jvp` of these functions.

All maps share one function with a custom gradient, `apply_layer`, and build on `apps.gradients.layers`.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any

from quasiharmonic.util.hints import explain_missing

with explain_missing("quasiharmonic.jax needs JAX", extra="jax"):
    import jax
    import jax.numpy as jnp

import numpy as np

from quasiharmonic.apps.gradients.derivative import Derivative
from quasiharmonic.apps.gradients.layers import (
    Array,
    DoubtfulDerivative,
    Layer,
    LayerFunctions,
    MapNotFound,
    argument_types,
    compute_gradients,
    compute_maps,
    select_arguments,
    sum_to_shape,
)
from quasiharmonic.util.arrays import FloatArray

__all__ = ["DoubtfulDerivative", "MapNotFound", "flatten", "injective_map", "quasi_harmonic_map"]

# JAX passes only arrays from the forward to the backward pass. This cache keeps the last derivatives; older ones are
# computed again from their maps.
_MAX_RECENT = 16
_lock = Lock()
_recent: OrderedDict[tuple[Layer, bytes], Derivative] = OrderedDict()


def apply_layer(make: Callable[..., Layer], settings: tuple[Any, ...], arguments: Mapping[str, Any]) -> jax.Array:
    """Return the maps of a layer for its arguments, without those that are None; check types, devices and shapes."""
    layer = make(*settings)
    names, given, single = select_arguments(layer, arguments, _check, "astype({!r})")
    # All arrays get the same number of leading axes, so that the axis that `jax.vmap` adds is the first of each.
    axes = [np.ndim(array) - len(layer.shapes[name]) for name, array in zip(names, given, strict=True)]
    most = max(axes, default=0)
    arrays = [
        jnp.expand_dims(jnp.asarray(array, dtype=_find_dtype(name)), tuple(range(most - own)))
        for name, array, own in zip(names, given, axes, strict=True)
    ]
    if any(isinstance(array, jax.core.Tracer) for array in arrays):
        maps: jax.Array = _map(layer, names, *arrays)
    else:
        # Errors of a callback would lose their class.
        maps = jnp.asarray(_compute(layer, names, *arrays))
    return maps.astype(np.float32) if single else maps


def _find_dtype(name: str) -> np.dtype[Any]:
    """The type in which JAX passes an argument or ``"uv"``: double precision if enabled."""
    found: np.dtype[Any] = jax.dtypes.canonicalize_dtype(argument_types(name)[0])
    return found


@dataclass(frozen=True)
class _Call:
    """A function bound to a layer. Instances with equal fields compare equal, so JAX compiles one program for them."""

    function: Callable[..., Any]
    layer: Layer
    names: tuple[str, ...]

    def __call__(self, *arrays: Any) -> Any:
        return self.function(self.layer, self.names, *arrays)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _map(layer: Layer, names: tuple[str, ...], *arrays: jax.Array) -> jax.Array:
    shape = jax.ShapeDtypeStruct((*_lead(layer, names, arrays), *layer.map_shape), _find_dtype("uv"))
    maps: jax.Array = jax.pure_callback(_Call(_compute, layer, names), shape, *arrays, vmap_method="expand_dims")
    return maps


def _forward(layer: Layer, names: tuple[str, ...], *arrays: jax.Array) -> tuple[jax.Array, tuple[Any, jax.Array]]:
    uv = _map(layer, names, *arrays)
    return uv, (arrays, uv)


def _backward(
    layer: Layer, names: tuple[str, ...], kept: tuple[tuple[jax.Array, ...], jax.Array], cotangent: jax.Array
) -> tuple[jax.Array, ...]:
    arrays, uv = kept
    lead = _lead(layer, names, arrays)
    shapes = [
        jax.ShapeDtypeStruct((*lead, *layer.shapes[name]), array.dtype)
        for name, array in zip(names, arrays, strict=True)
    ]
    pulled = jax.pure_callback(
        _Call(_pull_back, layer, names), shapes, uv, cotangent, *arrays, vmap_method="expand_dims"
    )
    return tuple(sum_to_shape(gradient, array.shape) for gradient, array in zip(pulled, arrays, strict=True))


_map.defvjp(_forward, _backward)


def _lead(layer: Layer, names: tuple[str, ...], arrays: tuple[jax.Array, ...]) -> tuple[int, ...]:
    return layer.batch(dict(zip(names, arrays, strict=True)))


def _compute(layer: Layer, names: tuple[str, ...], *arrays: Any) -> FloatArray:
    """Compute the maps, and cache their derivatives."""
    given = _by_name(names, arrays)
    exact, derivatives = compute_maps(layer, given)
    uv = exact.astype(_find_dtype("uv"))
    with _lock:
        for item, derivative in zip(np.ndindex(uv.shape[:-2]), derivatives, strict=True):
            key = _key(layer, layer.item(given, item), uv[item].astype(np.float64))
            _recent[key] = derivative
            _recent.move_to_end(key)
        while len(_recent) > _MAX_RECENT:
            _recent.popitem(last=False)
    return uv


def _pull_back(layer: Layer, names: tuple[str, ...], uv: Any, cotangent: Any, *arrays: Any) -> list[Array]:
    """The gradients with respect to all arguments, for the whole batch."""
    given = _by_name(names, arrays)
    uv, cotangent = (np.asarray(array, dtype=np.float64) for array in (uv, cotangent))
    lead = np.broadcast_shapes(uv.shape[:-2], cotangent.shape[:-2])
    uv, cotangent = (np.broadcast_to(array, (*lead, *layer.map_shape)) for array in (uv, cotangent))
    derivatives = []
    for item in np.ndindex(lead):
        own = layer.item(given, item)
        with _lock:
            derivative = _recent.get(_key(layer, own, uv[item]))
        derivatives.append(derivative or layer.derivative(own, uv[item]))
    found = compute_gradients(layer, derivatives, cotangent, names)
    # JAX's convention is ∂/∂Re − i ∂/∂Im.
    return [found[name].conj().astype(_find_dtype(name)) for name in names]


def _by_name(names: tuple[str, ...], arrays: tuple[Any, ...]) -> dict[str, Array]:
    return {name: np.asarray(array, dtype=argument_types(name)[0]) for name, array in zip(names, arrays, strict=True)}


def _key(layer: Layer, own: Mapping[str, Array], uv: FloatArray) -> tuple[Layer, bytes]:
    """The cache key of a derivative: its layer and a digest of its arrays."""
    digest = hashlib.blake2b(np.ascontiguousarray(uv).tobytes())
    for array in own.values():
        digest.update(np.ascontiguousarray(array).tobytes())
    return layer, digest.digest()


def _check(name: str, array: Any) -> None:
    if not isinstance(array, jax.Array | np.ndarray):
        raise TypeError(f"{name} must be an array, not {type(array).__name__}")
    if isinstance(array, jax.Array) and not isinstance(array, jax.core.Tracer):
        elsewhere = [device for device in array.devices() if device.platform != "cpu"]
        if elsewhere:
            raise ValueError(
                f"{name} is on {elsewhere[0]}, but maps are computed on the CPU: "
                f"jax.device_put({name}, jax.devices('cpu')[0])"
            )


_functions = LayerFunctions(apply_layer)
quasi_harmonic_map = _functions.quasi_harmonic_map
injective_map = _functions.injective_map
flatten = _functions.flatten
