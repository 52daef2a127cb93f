"""Arguments for kernels, by name: what a kernel's text in NumPy and its text in C are both given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from quasiharmonic.surfaces import disk

Arguments = tuple[Any, ...]
ARGUMENTS: dict[str, list[Callable[[np.random.Generator], Arguments]]] = {}


def arguments_of(name: str) -> Callable[[Callable[[np.random.Generator], Arguments]], object]:
    """Arguments of the kernel of this name, of which there may be several; what it is to fill in holds anything."""
    return lambda make: ARGUMENTS.setdefault(name, []).append(make)


def numbers(rng: np.random.Generator, *shape: int) -> Any:
    """Complex ones of many magnitudes."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * 2.0 ** rng.uniform(-20, 20, shape)


@arguments_of("wirtinger")
def _(rng):
    V, F = disk(4)
    f = len(F)
    return numbers(rng, len(V)), F, numbers(rng, 2, f), numbers(rng, f), numbers(rng, f), np.empty(f)


@arguments_of("wirtinger")
def _(rng):
    """Gradients that are the same everywhere, of some of the triangles."""
    V, F = disk(4)
    gamma = np.broadcast_to(numbers(rng, 2, 1), (2, len(F)))[:, 5:40]
    return numbers(rng, len(V)), F[5:40], gamma, numbers(rng, 35), numbers(rng, 35), np.empty(35)
