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


def soup(rng, n: int, f: int) -> Any:
    """Triangles at random: edges of one, two, three and more of them, wound alike and not, corners repeated."""
    return rng.integers(0, n, (f, 3))


@arguments_of("sort_edges")
def _(rng):
    V, F = disk(4)
    return F, len(V), np.empty((F.size, 2), dtype=np.int64), np.empty(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    return soup(rng, 9, 70), 9, np.zeros((210, 2), dtype=np.int64), np.empty(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    """A fan around the first vertex."""
    F = np.stack([np.zeros(99, dtype=np.int64), np.arange(1, 100), rng.permutation(np.arange(2, 101))], axis=1)
    return F, 101, np.zeros((297, 2), dtype=np.int64), np.empty(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    return soup(rng, 9, 5), 4, np.zeros((15, 2), dtype=np.int64), np.zeros(4, dtype=np.int64)


@arguments_of("sort_edges")
def _(rng):
    return soup(rng, 9, 0), 0, np.zeros((0, 2), dtype=np.int64), np.zeros(4, dtype=np.int64)


@arguments_of("link_nodes")
def _(rng):
    """Columns of triangles, as components has them."""
    F = soup(rng, 200, 40)
    return F[:, :2], F[:, 1:], np.empty(200, dtype=np.int64)


@arguments_of("link_nodes")
def _(rng):
    return rng.integers(0, 50, 30), rng.integers(0, 50, 30), np.empty(50, dtype=np.int64)


@arguments_of("follow_loops")
def _(rng):
    """A short loop, and a long one."""
    around = rng.permutation(60)
    loops = np.concatenate([np.stack([some, np.roll(some, 1)], axis=1) for some in (around[:4], around[4:])])
    return rng.permutation(loops), np.zeros(60, dtype=np.int64), np.zeros(60, dtype=np.int64)


@arguments_of("follow_loops")
def _(rng):
    """A vertex passed twice."""
    loops = np.array([[0, 1], [1, 2], [2, 0], [2, 3], [3, 4], [4, 2]])
    return rng.permutation(loops), np.zeros(6, dtype=np.int64), np.zeros(6, dtype=np.int64)
