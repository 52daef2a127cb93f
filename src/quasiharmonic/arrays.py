"""What callers hand over, as arrays of one type; refused by name where it is none."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.mesh.topology import named

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def real_array(name: str, values: ArrayLike) -> FloatArray:
    """Real numbers of any type as float64, always a copy.

    Raises
    ------
    ValueError
        When they are no real numbers, or make no array; too large ones become infinite.
    """
    array = _array(name, values)
    if array.dtype.kind not in "iufb":
        raise ValueError(f"{name} must hold real numbers, not {array.dtype}")
    with np.errstate(over="ignore"):
        return np.array(array, dtype=np.float64, order="C")


def index_array(name: str, values: ArrayLike) -> IntArray:
    """Integers of any type as int64, always a copy; nothing at all is an array of none.

    Raises
    ------
    ValueError
        When they are no integers, make no array, or are larger than any index.
    """
    array = _array(name, values)
    if array.size == 0:
        array = np.empty(array.shape, dtype=np.int64)
    if array.dtype.kind not in "iu":
        raise ValueError(f"{name} must hold integer vertex indices, not {array.dtype}")
    if array.dtype.kind == "u" and array.max(initial=0) > np.iinfo(np.int64).max:
        raise ValueError(f"{name} refers to vertex {array.max()}, which no mesh has")
    return np.array(array, dtype=np.int64, order="C")


def check_finite(name: str, one: str, many: str, rows: FloatArray) -> None:
    """Raise a ValueError that names the first rows, such as ``one`` vertex, with NaN or infinite numbers."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise ValueError(f"{name} is not finite at {named(one, many, bad)}")


def check_range(name: str, indices: IntArray, n: int) -> None:
    """Raise a ValueError that names the first indices that are no vertex of ``n``."""
    bad = np.unique(indices[(indices < 0) | (indices >= n)])
    if bad.size:
        there = f"only vertices 0 … {n - 1}" if n else "no vertices"
        raise ValueError(f"{name} refers to {named('vertex', 'vertices', bad)}, but there are {there}")


def _array(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError as error:
        raise ValueError(f"{name} is not an array: its rows differ in length") from error
