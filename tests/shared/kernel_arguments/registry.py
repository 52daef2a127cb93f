"""The arguments of kernels by name, and random numbers and triangles for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Arguments = tuple[Any, ...]


ARGUMENTS: dict[str, list[Callable[[np.random.Generator], Arguments]]] = {}


def arguments_of(name: str) -> Callable[[Callable[[np.random.Generator], Arguments]], object]:
    """Register a function that makes arguments of a kernel, of which there may be several; outputs hold any values."""
    return lambda make: ARGUMENTS.setdefault(name, []).append(make)


def numbers(rng: np.random.Generator, *shape: int) -> Any:
    """Random complex numbers of many magnitudes."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * 2.0 ** rng.uniform(-20, 20, shape)


def soup(rng, n: int, f: int) -> Any:
    """Random triangles: edges with one or more triangles, of equal and opposite orientation, and repeated corners."""
    return rng.integers(0, n, (f, 3))


def field_on(rng, triangles: int, scale: float) -> Any:
    """Random ξ of triangles, of few magnitudes, some of them zero."""
    xi = scale * (rng.normal(size=triangles) + 1j * rng.normal(size=triangles))
    xi[::7] = 0
    xi[1::7] *= 1e-9
    return xi
