"""Array types, conversion and checks of arguments, and names of elements in messages.

All functions that accept ``V``, ``F`` or rows of coordinates use this module, so that each error has one wording. Its
functions raise a ValueError that names the argument and the first elements that are not valid.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from numbers import Integral, Number, Real
from os import PathLike, fspath
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.util.hints import suggest

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
SignArray = NDArray[np.int8]
Scalar = TypeVar("Scalar", bound=np.generic)


class ReadOnly:
    """Base class of objects whose arrays are read-only, also in copies and after unpickling."""

    def _read_only(self) -> Iterable[NDArray[Any]]:
        """The arrays to protect."""
        raise NotImplementedError

    def _seal(self) -> None:
        for array in self._read_only():
            array.flags.writeable = False

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._seal()


def convert_array(name: str, values: ArrayLike) -> NDArray[Any]:
    """Convert values, including PyTorch and JAX arrays, to an array, of any type and perhaps without a copy."""
    # Only arrays with this attribute can be masked; for others, `numpy.ma` need not be imported.
    if hasattr(values, "mask") and np.ma.is_masked(values):
        raise ValueError(f"{name} has masked elements: fill them or leave them out")
    try:
        # `asarray` treats objects that offer their memory only by DLPack as scalars.
        if hasattr(values, "__dlpack__") and not hasattr(values, "__array__"):
            return np.from_dlpack(cast(Any, values))
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        if isinstance(error, ValueError) and isinstance(values, list | tuple):
            raise ValueError(f"{name} is not an array: its rows differ in length") from error
        raise ValueError(f"{name} is {describe(values)} {_explain_failure(name, values, error)}") from error


def real_array(name: str, values: ArrayLike) -> FloatArray:
    """Convert real numbers of any type to float64; always returns a copy. Numbers out of range become infinite."""
    array = convert_array(name, values)
    if array.dtype.kind not in "iufb":
        raise ValueError(f"{name} must contain real numbers, not {_describe_elements(values, array)}")
    if array.dtype == np.float64:
        return np.array(array, order="C")
    # A signalling NaN is invalid in a conversion. It is reported later as not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.array(array, dtype=np.float64, order="C")


def index_array(name: str, values: ArrayLike, *, copy: bool = True) -> IntArray:
    """Convert integers of any type to int64; returns a copy unless ``copy`` is False. Empty input may have any type."""
    array = convert_array(name, values)
    if array.size == 0:
        array = np.empty(array.shape, dtype=np.int64)
    if array.dtype.kind in "fO" and (integers := _integers(values, array)) is not None:
        array = _in_range(name, integers)
    if array.dtype.kind not in "iu":
        advice = ""
        if array.dtype.kind == "b" and array.ndim == 1:
            advice = f": pass numpy.flatnonzero({name})"
        elif array.dtype.kind == "f" and array.ndim == 2:
            advice = "; check the order of the arguments: these may be positions"
        raise ValueError(f"{name} must contain integer indices, not {_describe_elements(values, array)}{advice}")
    if array.dtype.kind == "u" and array.max(initial=0) > np.iinfo(np.int64).max:
        raise ValueError(f"{name} refers to vertex {array.max()}, which is not a valid index")
    return np.array(array, dtype=np.int64, order="C") if copy else np.require(array, np.int64, ["C", "A"])


def number_array(name: str, values: ArrayLike, count: int, element: str) -> IntArray:
    """Convert an integer for each of several elements to int64 (count,); ``element`` is their name, for messages."""
    numbers = index_array(name, values)
    if numbers.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), one for each {element}, not {numbers.shape}")
    return numbers


def _integers(values: ArrayLike, array: NDArray[Any]) -> NDArray[np.object_] | None:
    """Return integers that NumPy converted to floats or objects, as objects; None if not all values are integers."""
    if array.dtype.kind == "f" and not isinstance(values, list | tuple):
        return None
    objects = np.array(values, dtype=object)
    if objects.shape != array.shape:
        return None
    are_integers = all(isinstance(value, Integral) and not isinstance(value, bool) for value in objects.flat)
    return objects if are_integers else None


def _in_range(name: str, integers: NDArray[np.object_]) -> IntArray:
    """Convert integers of any size to int64, or raise a ValueError that names the first one that does not fit."""
    for value in integers.flat:
        if not -(2**63) <= int(value) < 2**63:
            raise ValueError(f"{name} refers to vertex {describe(value)}, which is not a valid index")
    return integers.astype(np.int64)


class _Unchangeable(np.ndarray):
    """Owner of the memory of a result of `make_unchangeable`; only that result refers to it."""


def make_unchangeable(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return the values of an array in memory that no other code can write to.

    An array that this function made, or a view of one, is returned as it is; any other array is copied. A read-only
    flag alone is not enough: other code may write through the base of a view, or set the flag of the array
    back.
    """
    owner = array
    while isinstance(owner, np.ndarray) and not owner.flags.writeable:
        if isinstance(owner, _Unchangeable):
            return array
        owner = cast(Any, owner.base)
    own = _Unchangeable(array.shape, array.dtype)
    own[...] = array
    own.flags.writeable = False
    return own.view(np.ndarray)


def as_offsets(starts: ArrayLike) -> NDArray[np.intp]:
    """Starts of segments (k,) for ``reduceat``, which rejects 64-bit integers on 32-bit systems."""
    return np.asarray(starts, dtype=np.intp)


def repeat_each(values: ArrayLike, counts: ArrayLike) -> NDArray[Any]:
    """Repeat each entry by its count (k,), as ``np.repeat``, which rejects 64-bit counts on 32-bit systems."""
    return np.repeat(values, np.asarray(counts, dtype=np.intp))


def enumerate_each(counts: ArrayLike) -> tuple[IntArray, IntArray]:
    """For each count (k,), its index repeated as often, and the numbers from 0 to the count; (sum,) int64 each."""
    counts = np.asarray(counts, dtype=np.int64)
    return repeat_each(np.arange(counts.size), counts), np.arange(counts.sum()) - repeat_each(
        np.cumsum(counts) - counts, counts
    )


def enumerate_ranges(begin: IntArray, end: IntArray, limit: int) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the pairs of a range (k,) and a number in it, in order; at most ``limit`` or one range at a time."""
    count = end - begin
    total = np.cumsum(count)
    start = done = 0
    while start < begin.size:
        stop = max(int(np.searchsorted(total, done + limit, side="right")), start + 1)
        which = repeat_each(np.arange(start, stop), count[start:stop])
        yield which, np.arange(done, int(total[stop - 1])) + (end - total)[which]
        start, done = stop, int(total[stop - 1])


def mark(n: int, *chosen: IntArray) -> BoolArray:
    """Mask (n,) that is True at the given indices, arrays of any shape."""
    marked = np.zeros(n, dtype=bool)
    for indices in chosen:
        marked[indices] = True
    return marked


def any_corner(marked: BoolArray) -> BoolArray:
    """Whether each triangle has a marked corner (f, 3); (f,) bool, many times faster than NumPy's ``any``."""
    return marked[:, 0] | marked[:, 1] | marked[:, 2]


def list_others(n: int, chosen: IntArray) -> IntArray:
    """Ascending numbers below ``n`` that are not among the given ones."""
    return np.flatnonzero(~mark(n, chosen))


def first_equal(rows: NDArray[Any]) -> IntArray:
    """Index (k,) int64 of the first row that is equal to each row of (k, d)."""
    first = np.arange(len(rows))
    if not len(rows):
        return first
    order = np.argsort(rows[:, 0])
    # Most rows differ from all others in their first number.
    equal = rows[order[1:], 0] == rows[order[:-1], 0]
    some = np.sort(order[np.append(equal, False) | np.append(False, equal)])
    order = some[np.lexsort(rows[some].T)]
    starts = np.ones(order.size, dtype=bool)
    starts[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    first[order] = order[starts][np.cumsum(starts) - 1]
    return first


def cyclic_pairs(loop: IntArray) -> IntArray:
    """Pairs (k, 2) of each element of a closed loop (k,) and the next, such as the edges of a boundary loop."""
    return np.stack([loop, np.roll(loop, -1)], axis=1)


def invert_indices(n: int, chosen: IntArray) -> IntArray:
    """Position in ``chosen`` (k,) of each number below ``n``, -1 for the others; (n,) int64."""
    position = np.full(n, -1, dtype=np.int64)
    position[chosen] = np.arange(len(chosen))
    return position


def to_complex(points: FloatArray) -> ComplexArray:
    """Points (k, 2) as complex numbers x + iy, (k,)."""
    return np.ascontiguousarray(points, dtype=np.float64).view(np.complex128).ravel()


def to_points(w: ComplexArray) -> FloatArray:
    """Complex numbers x + iy, (k,), as points (k, 2)."""
    return np.ascontiguousarray(w).view(np.float64).reshape(-1, 2)


def sum_at(indices: IntArray, values: ComplexArray, n: int) -> ComplexArray:
    """Sum complex values (k,) at each of ``n`` indices; (n,) complex128."""
    return np.bincount(indices, values.real, minlength=n) + 1j * np.bincount(indices, values.imag, minlength=n)


def to_integers(values: FloatArray) -> list[int]:
    """Finite doubles, multiplied by a common power of two that makes all of them integers."""
    ratios = [value.as_integer_ratio() for value in values.ravel().tolist()]
    unit = max(denominator for _, denominator in ratios)  # all are powers of two
    return [numerator * (unit // denominator) for numerator, denominator in ratios]


def find_exponent(values: NDArray[np.floating]) -> int:
    """Binary exponent e of the largest absolute value: ``2**-e`` scales it to between 1/2 and 1; 0 if all are zero.

    Scaling by a power of two rounds nothing, and afterwards squares neither overflow nor underflow.
    """
    return int(np.frexp(np.abs(values).max(initial=0.0))[1])


def scale_to_unit(values: FloatArray) -> FloatArray:
    """Values scaled by a power of two so that the largest absolute value is between 1/2 and 1; see `find_exponent`."""
    return np.ldexp(values, -find_exponent(values))


def own_triangles(F: ArrayLike) -> IntArray:
    """Triangles as from `triangle_rows`, contiguous and unchangeable, as kernels require."""
    return make_unchangeable(triangle_rows(F, copy=False))


def vertex_array(V: ArrayLike, name: str = "V", *, finite: bool = True) -> FloatArray:
    """Convert positions (n, 2) or (n, 3) to float64, finite unless ``finite`` is False; returns a copy."""
    array = real_array(name, V)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"{name} must have shape (n, 2) or (n, 3), not {array.shape}")
    if finite:
        check_finite(name, "vertex", "vertices", array)
    return array


def pad_to_space(V: FloatArray) -> FloatArray:
    """Return positions (n, 3); those in the plane get a third coordinate of zero."""
    return V if V.shape[1] == 3 else np.column_stack([V, np.zeros(len(V))])


def triangle_array(F: ArrayLike, n: int) -> IntArray:
    """Convert triangles (f, 3) among ``n`` vertices, at least one, to int64; returns a copy."""
    array = triangle_rows(F)
    if array.size == 0:
        raise ValueError("the mesh has no triangles")
    check_range("F", array, n)
    return array


def triangle_rows(F: ArrayLike, name: str = "F", *, copy: bool = True) -> IntArray:
    """Convert any number of triangles (f, 3), also zero, to int64 without a check of the index range."""
    array = index_array(name, F, copy=copy)
    if array.size == 0:
        return np.empty((0, 3), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} must have shape (f, 3), triangles only, not {array.shape}")
    return array


def edge_array(name: str, edges: ArrayLike) -> IntArray:
    """Convert edges, pairs of vertices, to (k, 2) int64 without a check of the index range; returns a copy."""
    array = index_array(name, edges)
    if array.size and (array.ndim != 2 or array.shape[1] != 2):
        raise ValueError(f"{name} must have shape (k, 2), not {array.shape}")
    return array.reshape(-1, 2)


def corner_rows(name: str, values: ArrayLike, F: IntArray, rows: int | None = None, *, copy: bool = False) -> IntArray:
    """Convert a table with a row index, or -1 for none, at every corner of triangles F (f, 3) to int64.

    ``rows`` is the number of rows that exist; None if the table decides. Returns a copy only if ``copy``.
    """
    array = triangle_rows(values, name, copy=copy)
    if len(array) != len(F):
        raise ValueError(f"{name} must have as many rows as F, {len(F)}, not {len(array)}")
    check_range(name, array, int(array.max(initial=-1)) + 1 if rows is None else rows, "row", "rows", minimum=-1)
    return array


def map_array(name: str, uv: ArrayLike, n: int | None = None, *, finite: bool = True) -> FloatArray:
    """Convert positions in the plane to (n, 2) float64, finite unless ``finite`` is False; returns a copy.

    ``uv`` may be an object with an attribute ``uv``, such as a result. ``n`` is the required number of rows.
    """
    array = real_array(name, getattr(uv, "uv", uv))
    if array.ndim != 2 or array.shape[1] != 2 or n not in (None, len(array)):
        wanted = "(n, 2)" if n is None else f"({n}, 2), one position for each vertex"
        flat = array.ndim == 2 and array.shape[1] == 3 and n in (None, len(array))
        advice = f"; if the third coordinate has no meaning, pass {name}[:, :2]" if flat else ""
        raise ValueError(f"{name} must have shape {wanted}, not {array.shape}{advice}")
    if finite:
        check_finite(name, "vertex", "vertices", array)
    return array


def vertex_indices(name: str, vertices: ArrayLike, n: int) -> IntArray:
    """Convert indices of some of ``n`` vertices to (k,) int64; returns a copy."""
    array = index_array(name, vertices)
    if array.ndim != 1:
        raise ValueError(f"{name} must have shape (k,), not {array.shape}")
    check_range(name, array, n)
    return array


def distinct_vertices(name: str, vertices: ArrayLike, n: int) -> IntArray:
    """Convert indices of some of ``n`` vertices to (k,) int64 without repetition; returns a copy."""
    array = vertex_indices(name, vertices, n)
    message = f"{name} contains {{}} more than once: list each vertex once"
    reject(np.bincount(array, minlength=n) > 1, "vertex", "vertices", message)
    return array


def target_positions(target: ArrayLike, k: int) -> FloatArray:
    """Convert the target positions of ``k`` fixed vertices to finite (k, 2) float64; returns a copy."""
    array = real_array("target", target)
    if array.shape != (k, 2):
        raise ValueError(f"target must have shape ({k}, 2), one position for each fixed vertex, not {array.shape}")
    check_finite("target", "row", "rows", array)
    return array


def loop_arrays(loops: Iterable[ArrayLike], n: int) -> list[IntArray]:
    """Convert boundary loops of at least three vertices each, among ``n`` vertices, to (l,) int64; returns copies."""
    check_sequence("loops", loops, "boundary loops")
    arrays = []
    for k, loop in enumerate(loops):
        array = index_array(f"loops[{k}]", loop)
        if array.ndim != 1:
            advice = "" if array.ndim else "; pass a list of loops"
            raise ValueError(f"loops[{k}] must have shape (l,), the vertices of one loop, not {array.shape}{advice}")
        check_range(f"loops[{k}]", array, n)
        if len(array) < 3:
            vertices = count_of("vertex", "vertices", len(array))
            raise ValueError(f"loops[{k}] has {vertices}, but a boundary loop has three or more")
        arrays.append(array)
    return arrays


def check_finite(name: str, one: str, many: str, rows: FloatArray, used: IntArray | None = None) -> None:
    """Raise a ValueError that names the first rows with NaN or infinite numbers; ``one``, ``many`` name a row.

    With ``used``, only these rows are checked.
    """
    finite = np.isfinite(rows).all(axis=1)
    if used is not None:
        finite |= ~mark(len(rows), used)
    if not finite.all():
        which = names_of(one, many, np.flatnonzero(~finite))
        raise ValueError(f"{name} is not finite at {which}: give finite numbers")


def reject(found: BoolArray | IntArray, one: str, many: str, message: str) -> None:
    """Raise a ValueError if there are elements in a mask (n,) or an array of indices.

    The message has their names, made of ``one`` and ``many``, in place of ``{}``.
    """
    indices = np.flatnonzero(found) if found.dtype == np.bool_ else found.astype(np.int64)
    if indices.size:
        raise ValueError(message.format(names_of(one, many, indices)))


def check_range(
    name: str, indices: IntArray, n: int, one: str = "vertex", many: str = "vertices", *, minimum: int = 0
) -> None:
    """Raise a ValueError that names the first indices outside ``minimum … n - 1``; ``one``, ``many`` name an element.

    ``minimum`` is -1 if -1 is allowed as a mark.
    """
    if indices.size and (indices.min() < minimum or indices.max() >= n):
        bad = np.unique(indices[(indices < minimum) | (indices >= n)])
        there = f"only {many} 0 … {n - 1}" if n else f"no {many}"
        from_one = name == "F" and indices.min() == 1 and indices.max() == n
        advice = "; if its indices count from 1, pass F - 1" if from_one else ""
        raise ValueError(f"{name} refers to {names_of(one, many, bad)}, but there are {there}{advice}")


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise a ValueError that lists the choices, unless the value is one of them."""
    if not isinstance(value, str) or value not in tuple(choices):
        given = repr(value) if isinstance(value, str) else describe(value)
        raise ValueError(f"{name} must be one of {', '.join(choices)}, not {given}{suggest(value, choices)}")


def _explain_failure(name: str, values: Any, error: Exception) -> str:
    """Explain why an array of another library cannot be converted, and what to do."""
    if getattr(values, "requires_grad", False):
        return (
            f"that requires grad, which this function does not support: pass {name}.detach(), or use "
            f"quasiharmonic.torch"
        )
    if "Tracer" in type(values).__name__:
        return "that JAX traces, so its values are not available: use quasiharmonic.jax"
    device = getattr(values, "device", "cpu")
    if not str(device).startswith("cpu"):
        return f"on {device}: pass {name}.{'cpu' if hasattr(values, 'cpu') else 'get'}()"
    return f"that NumPy cannot convert: {str(error).partition(chr(10))[0]}"


def _describe_elements(values: object, array: NDArray[Any]) -> str:
    """Describe the elements of an array that should be numbers."""
    if not array.ndim:
        return describe(values)
    if array.dtype == object and array.size:
        return f"objects, the first of them {describe(array.flat[0])}"
    return str(array.dtype)


def describe(value: object) -> str:
    """Describe a value for messages: ``a Trimesh``, ``None``, ``'letter:R'``."""
    if isinstance(value, PathLike):
        value = fspath(value)
    if isinstance(value, Integral) and abs(int(value)) >= 10**80:
        # Python refuses to write integers of thousands of digits.
        return f"about {'-' if value < 0 else ''}1e{int(int(value).bit_length() * np.log10(2))}"
    if value is None or isinstance(value, str | bytes | Number):
        text = str(value) if isinstance(value, Number) else repr(value)
        return text if len(text) <= 80 else f"{text[:77]}…"
    return _with_article(type(value).__name__)


def _with_article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}"


def check_integer(name: str, value: Any, *, minimum: int) -> None:
    """Raise a ValueError unless the value is an integer of at least ``minimum``."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < minimum:
        raise ValueError(f"{name} must be an integer of at least {minimum}, not {describe(value)}")


def check_bool(name: str, value: Any) -> None:
    """Raise a ValueError unless the value is a boolean; a non-empty string such as "no" would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, not {describe(value)}")


def _is_non_negative(value: Any) -> bool:
    """Return whether a number is finite and at least zero; integers beyond the range of floats count as infinite."""
    try:
        return 0 <= float(value) < np.inf
    except OverflowError:
        return False


def check_weld(value: Any) -> None:
    """Raise a ValueError unless the value is a boolean or a finite number of at least zero, a relative distance."""
    if not isinstance(value, bool | np.bool_ | Real) or not _is_non_negative(value):
        raise ValueError(
            "weld must be True, False, or a distance relative to the diagonal of the bounding box, a finite number of "
            f"at least 0, not {describe(value)}"
        )


def check_non_negative(name: str, value: Any) -> None:
    """Raise a ValueError unless the value is a finite number of at least zero."""
    if not isinstance(value, Real) or not _is_non_negative(value):
        raise ValueError(f"{name} must be a finite number of at least 0, not {describe(value)}")


def check_numbers(**values: Any) -> None:
    """Raise a ValueError that names the first value that is not a real number; the keywords are the names."""
    for name, value in values.items():
        if not isinstance(value, Real) or isinstance(value, bool):
            raise ValueError(f"{name} must be a number, not {describe(value)}")


def check_positive(**values: Any) -> None:
    """Raise a ValueError unless all values are positive finite numbers; the keywords are the names."""
    check_numbers(**values)
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite, not {value}")


def check_instance(name: str, value: object, kind: type) -> None:
    """Raise a ValueError unless the value is of the given class."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} must be {_with_article(kind.__name__)}, not {describe(value)}")


def check_sequence(name: str, value: object, of: str) -> None:
    """Raise a ValueError unless the value can be iterated over and is not text; ``of`` describes its elements."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        raise ValueError(f"{name} must be a sequence of {of}, not {describe(value)}")


def check_callback(callback: Any) -> None:
    """Raise a ValueError unless the callback is callable or None. Called before any work that reports to it."""
    if callback is not None and not callable(callback):
        raise ValueError(f"callback must be callable, or None, not {describe(callback)}")


def morton_order(points: FloatArray) -> IntArray:
    """Order of points (n, d) along Morton's curve, so that consecutive points are close to each other."""
    # Cells of the curve of `morton_order`: 2 to this power along the longest side of the points' bounding box.
    bits = 10
    if not len(points):
        return np.empty(0, dtype=np.int64)
    # Halve first, so that the extent of numbers near the largest double does not overflow.
    offset = points / 2 - points.min(axis=0) / 2
    size = float(offset.max())
    cell = (offset / (size if size > 0 else 1.0) * ((1 << bits) - 1)).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(bits):
        for axis, along in enumerate(cell.T):
            code |= (along >> bit & 1) << (len(cell.T) * bit + axis)
    return np.argsort(code, kind="stable")


def work(force: ComplexArray, displacement: ComplexArray) -> float:
    """Real inner product ``Re forceᴴ displacement``, without BLAS, because waking its threads takes longer."""
    return float((force.real * displacement.real + force.imag * displacement.imag).sum())


def count_of(one: str, many: str, count: int) -> str:
    """Give the number of some elements in words: ``1 vertex``, ``7 vertices``."""
    return f"{count} {one if count == 1 else many}"


def names_of(one: str, many: str, indices: NDArray[np.integer]) -> str:
    """Name the first few of some elements: ``vertices 3, 8, 11, … (17 in all)``. Each is an index or a row."""
    # Number of elements that a message lists.
    listed_at_most = 5
    listed = ", ".join(str(tuple(i) if isinstance(i, list) else i) for i in indices[:listed_at_most].tolist())
    rest = f", … ({len(indices)} in all)" if len(indices) > listed_at_most else ""
    return f"{one if len(indices) == 1 else many} {listed}{rest}"


def vertex_names(vertices: IntArray) -> str:
    """Name the first few of some vertices: ``vertices 3, 8, 11, … (17 in all)``."""
    return names_of("vertex", "vertices", vertices)


def triangle_names(triangles: IntArray) -> str:
    """Name the first few of some triangles: ``triangle 5``."""
    return names_of("triangle", "triangles", triangles)


def edge_names(pairs: IntArray) -> str:
    """Name the first few of some edges: ``edges (1, 2), (4, 7), … (9 in all)``."""
    return names_of("edge", "edges", pairs)
