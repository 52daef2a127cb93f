"""Maps as functions of batches of arrays, for automatic differentiation, with forward and backward passes.

The packages for PyTorch and JAX share this module. An argument has the shape of one problem's argument, with optional
leading batch axes. Batches of several arguments are broadcast as in NumPy.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import repeat
from typing import Any, Generic, TypedDict, TypeVar, Unpack, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.apps.flattening.free_boundary import flatten_surface
from quasiharmonic.apps.gradients.derivative import Derivative
from quasiharmonic.apps.gradients.map_derivatives import (
    FlattenDerivativeKeywords,
    differentiate_flattened,
    differentiate_polish,
    quasi_harmonic_derivative,
)
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import polish_options
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.solver.mapping import solve_problem
from quasiharmonic.solver.search.many import ManyKeywords, injective_maps
from quasiharmonic.util.arrays import FloatArray, index_array, real_array
from quasiharmonic.util.options import FlattenOptions, MapOptions, Options, option, takes

#: An argument, converted to NumPy.
Array = NDArray[Any]
#: Tensors or arrays of a package.
T = TypeVar("T")


class MapNotFound(ValueError):  # noqa: N818  what it says is what happened
    """No injective map was found, so there is no derivative; ``result`` is the `MapResult`."""

    def __init__(self, result: MapResult) -> None:
        super().__init__(f"no injective map was found ({result.status.name.lower()}): {result.status.value}")
        self.result = result


class DoubtfulDerivative(UserWarning):
    """Warns that a gradient's derivative has a `Doubt`."""


class SolvedKeywords(TypedDict, total=False):
    """Types of the options of a solved layer."""

    polish: str | Energy
    slide: bool | BoundaryCurves
    start: ArrayLike | None
    linear_solver: str


class FlattenedKeywords(FlattenDerivativeKeywords, total=False):
    """Types of the options of a flattened layer."""

    start: ArrayLike | None


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedOptions(MapOptions):
    """Options of `quasiharmonic.solve` with a polish."""

    polish: Any = option("symmetric-dirichlet")


@dataclass(frozen=True)
class Layer:
    """A map as a function of arrays. Layers with equal settings are equal, so programs are compiled once for them.

    ``shapes`` are the shapes of one problem's arguments, by name. ``derivative`` returns the derivative of one
    problem's map for its arguments, and for its positions (n, 2) if they are known; it raises MapNotFound if there is
    no map. ``find``, if there is one, returns the results of several problems together.
    """

    settings: Hashable
    shapes: Mapping[str, tuple[int, ...]] = field(compare=False)
    derivative: Callable[[Mapping[str, Array], FloatArray | None], Derivative] = field(compare=False)
    find: Callable[[Sequence[Mapping[str, Array]]], Iterator[MapResult]] | None = field(default=None, compare=False)

    @property
    def map_shape(self) -> tuple[int, int]:
        """The shape (n, 2) of one problem's map."""
        return self.shapes["rest"][0], 2

    def batch(self, arrays: Mapping[str, Array]) -> tuple[int, ...]:
        """Return the common batch axes of the arguments; ValueError if they cannot be broadcast."""
        leads = {name: array.shape[: array.ndim - len(self.shapes[name])] for name, array in arrays.items()}
        try:
            return np.broadcast_shapes(*leads.values())
        except ValueError:
            batches = ", ".join(f"{name} {tuple(lead)}" for name, lead in leads.items())
            raise ValueError(f"batch shapes must be broadcastable, not {batches}") from None

    def item(self, arrays: Mapping[str, Array], item: tuple[int, ...]) -> dict[str, Array]:
        """Return the arguments of one item of the batch."""
        own = {}
        for name, array in arrays.items():
            lead = array.shape[: array.ndim - len(self.shapes[name])]
            last = item[len(item) - len(lead) :]
            own[name] = array[tuple(0 if size == 1 else i for i, size in zip(last, lead, strict=True))]
        return own


def make_tensor_layer(problem: Problem, reference: Reference, linear_solver: str) -> Layer:
    """Return `quasiharmonic.quasi_harmonic_map` as a function of ``mu``, ``target`` and ``rest``."""
    check_problem("quasi_harmonic_map", problem)

    def differentiate(arrays: Mapping[str, Array], uv: FloatArray | None) -> Derivative:
        posed = pose_problem(problem, arrays)
        return quasi_harmonic_derivative(posed, arrays.get("mu"), reference=reference, linear_solver=linear_solver)

    shapes = {"mu": (len(problem.F),), "target": problem.target.shape, "rest": problem.V.shape}
    return Layer(_to_comparable(("tensors", problem, reference, linear_solver)), shapes, differentiate)


def make_solved_layer(problem: Problem, options: SolvedKeywords) -> Layer:
    """Return `quasiharmonic.solve` with a polish as a function of ``target`` and ``rest``."""
    check_problem("injective_map", problem)
    checked = SolvedOptions(**options)
    start = None if checked.start is None else np.asarray(checked.start, dtype=np.float64)
    checked = replace(checked, start=start)

    def differentiate(arrays: Mapping[str, Array], uv: FloatArray | None) -> Derivative:
        posed = pose_problem(problem, arrays)
        found = _check_found(solve_problem(posed, checked)) if uv is None else uv
        return differentiate_polish(posed.domain, found, polish_options(checked))

    def find(items: Sequence[Mapping[str, Array]]) -> Iterator[MapResult]:
        given = {name: getattr(checked, name) for name in ManyKeywords.__annotations__}
        problems = (pose_problem(problem, arrays) for arrays in items)
        return cast("Iterator[MapResult]", injective_maps(problems, **given))

    shapes = {"target": problem.target.shape, "rest": problem.V.shape}
    alone = start is not None or checked.slide is not False
    return Layer(_to_comparable(("solved", problem, checked)), shapes, differentiate, None if alone else find)


def make_flattened_layer(rest: Any, F: ArrayLike, target: Any, options: FlattenedKeywords) -> Layer:
    """Return `quasiharmonic.flatten` as a function of ``rest`` and, if there are fixed vertices, ``target``.

    Only the shape of ``rest`` is read, as it may be a traced array.
    """
    checked = FlattenOptions(**options)
    fixed, weights, start = checked.fixed, checked.weights, checked.start
    if (fixed is None) != (target is None):
        raise ValueError("give fixed and target together: fixed vertices and their target positions")
    shape = tuple(getattr(rest, "shape", ()))
    if len(shape) < 2 or shape[-1] not in (2, 3):
        raise ValueError(f"rest must have shape (n, 2) or (n, 3), or batch axes before these, not {shape}")
    checked = replace(
        checked,
        fixed=None if fixed is None else index_array("fixed", fixed),
        weights=None if weights is None else real_array("weights", weights),
        start=None if start is None else real_array("start", start),
    )
    triangles = index_array("F", F)

    def differentiate(arrays: Mapping[str, Array], uv: FloatArray | None) -> Derivative:
        V = arrays["rest"]
        if uv is None:
            uv = _check_found(flatten_surface(V, triangles, replace(checked, target=arrays.get("target"))))
        return differentiate_flattened(V, triangles, uv, checked)

    shapes = {"rest": shape[-2:]} if checked.fixed is None else {"rest": shape[-2:], "target": (checked.fixed.size, 2)}
    return Layer(_to_comparable(("flattened", triangles, shape[-2:], checked)), shapes, differentiate)


def pose_problem(problem: Problem, arrays: Mapping[str, Array]) -> Problem:
    """Return the problem with the target and rest positions of a batch item, where given."""
    target, V = arrays.get("target", problem.target), arrays.get("rest", problem.V)
    if np.array_equal(V, problem.V):
        return problem.with_target(target)
    return Problem(V, problem.F, problem.fixed, target, reference=problem.reference)


def compute_maps(layer: Layer, arrays: Mapping[str, Array]) -> tuple[FloatArray, list[Derivative]]:
    """Compute the maps (…, n, 2) of a batch of problems, and their derivatives.

    If a problem raises an error, such as MapNotFound, a note names the batch item.
    """
    lead = layer.batch(arrays)
    uv, derivatives = np.empty((*lead, *layer.map_shape)), []
    given = [layer.item(arrays, item) for item in np.ndindex(lead)]
    results = layer.find(given) if layer.find is not None and len(given) > 1 else repeat(None)
    for item, own in zip(np.ndindex(lead), given, strict=True):
        try:
            result = next(results)
            derivative = layer.derivative(own, None if result is None else _check_found(result))
        except ValueError as error:
            if lead:
                error.add_note(f"This is item {', '.join(map(str, item))} of the batch.")
            raise
        uv[item] = derivative.uv
        derivatives.append(derivative)
    return uv, derivatives


def compute_gradients(
    layer: Layer, derivatives: Sequence[Derivative], cotangent: FloatArray, wanted: Sequence[str]
) -> dict[str, Array]:
    """Return the gradients of a function of the maps (…, n, 2), by name, each with all batch axes; warn of doubts."""
    lead = cotangent.shape[:-2]
    out: dict[str, Array] = {
        name: np.empty((*lead, *layer.shapes[name]), dtype=argument_types(name)[0]) for name in wanted
    }
    for item, derivative in zip(np.ndindex(lead), derivatives, strict=True):
        _warn(derivative, item)
        gradients = derivative.vjp(cotangent[item])
        for name in wanted:
            out[name][item] = getattr(gradients, name)
    return out


def compute_changes(
    layer: Layer, derivatives: Sequence[Derivative], lead: tuple[int, ...], tangents: Mapping[str, Array]
) -> FloatArray:
    """Return the change of the maps of a batch (…, n, 2) for changes of the arguments."""
    out = np.empty((*lead, *layer.map_shape))
    for item, derivative in zip(np.ndindex(lead), derivatives, strict=True):
        _warn(derivative, item)
        out[item] = derivative.jvp(**layer.item(tangents, item))
    return out


def sum_to_shape(gradient: Any, shape: tuple[int, ...]) -> Any:
    """Sum a gradient, a NumPy or JAX array, over the batch axes that the argument lacks or has with length 1."""
    gradient = gradient.sum(axis=tuple(range(gradient.ndim - len(shape))))
    short = tuple(i for i, size in enumerate(shape) if size == 1 and gradient.shape[i] != 1)
    return gradient.sum(axis=short, keepdims=True) if short else gradient


def argument_types(name: str) -> tuple[str, str]:
    """Return the types of an argument: that of the computation, in double precision, and that in single precision."""
    return ("complex128", "complex64") if name == "mu" else ("float64", "float32")


def select_arguments(
    layer: Layer, arguments: Mapping[str, Any], check: Callable[[str, Any], None], conversion: str, prefix: str = ""
) -> tuple[tuple[str, ...], list[Any], bool]:
    """Return the names and values of a layer's arguments without those that are None, with checked types and shapes.

    Also return whether all of them are in single precision. ``check`` raises an error for a value of another class or
    device. TypeError for another type, with the call ``conversion``; ``prefix`` is that of the names of types.
    ValueError if an argument has neither one problem's shape nor that with batch axes in front.
    """
    given = {name: array for name, array in arguments.items() if array is not None}
    single = bool(given)
    for name, array in given.items():
        check(name, array)
        double, short = (prefix + kind for kind in argument_types(name))
        if str(array.dtype) not in (double, short):
            wanted = f"{double} or {short}, not {array.dtype}: {name}.{conversion.format(double)}"
            raise TypeError(f"{name} must be of {wanted}")
        single &= str(array.dtype) == short
        shape, one = tuple(array.shape), layer.shapes[name]
        if len(shape) < len(one) or shape[len(shape) - len(one) :] != one:
            raise ValueError(f"{name} must have shape {one}, or batch axes before it, not {shape}")
    return tuple(given), list(given.values()), single


def _check_found(result: MapResult) -> FloatArray:
    if not result.injective:
        raise MapNotFound(result)
    return result.uv


def _warn(derivative: Derivative, item: tuple[int, ...]) -> None:
    for doubt in derivative.doubts:
        which = f"item {', '.join(map(str, item))}: " if item else ""
        warnings.warn(f"{which}{doubt.value}", DoubtfulDerivative, stacklevel=4)


def _to_comparable(value: Any) -> Hashable:
    """Return arrays and plain values by content, options and tuples by their entries, and other objects by identity."""
    if isinstance(value, Options):
        value = tuple(getattr(value, one.name) for one in fields(value))
    if isinstance(value, tuple):
        return tuple(_to_comparable(one) for one in value)
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    # The identity stays unique, because the closures of each layer keep the object alive.
    return value if isinstance(value, str | bool | int | float | None) else id(value)


class LayerFunctions(Generic[T]):
    """Maps as functions of the tensors of a package.

    ``apply(make, settings, arguments)`` returns the maps of the layer ``make(*settings)`` for its arguments.
    """

    def __init__(self, apply: Callable[[Callable[..., Layer], tuple[Any, ...], Mapping[str, T | None]], T]) -> None:
        self._apply = apply

    def quasi_harmonic_map(
        self,
        problem: Problem,
        mu: T | None = None,
        *,
        target: T | None = None,
        rest: T | None = None,
        reference: Reference = "equilateral",
        linear_solver: str = "auto",
    ) -> T:
        """Return quasi-harmonic maps of tensors or arrays, as `quasiharmonic.quasi_harmonic_map`.

        Parameters
        ----------
        problem : Problem
            Triangles, fixed vertices, and the values of omitted arguments.
        mu : (…, f) complex128 or complex64, optional
            Beltrami coefficients; zero by default. Their gradient is ``∂/∂Re μ + i ∂/∂Im μ`` in PyTorch and
            ``∂/∂Re μ − i ∂/∂Im μ`` in JAX, by their conventions.
        target : (…, k, 2) float64 or float32, optional
            Target positions of the fixed vertices.
        rest : (…, n, 2) or (…, n, 3) float64 or float32, optional
            Rest positions. They matter only with a ``reference`` other than ``"equilateral"``.
        reference, linear_solver
            As for `quasiharmonic.quasi_harmonic_map`.

        Returns
        -------
        (…, n, 2) float64 or float32
            In single precision if all arguments are. Injective only if the target is convex or μ is suitable.

        Raises
        ------
        TypeError
            If an argument is not a tensor or array, or has the wrong dtype.
        ValueError
            If an argument is on another device or has the wrong shape, or `quasiharmonic.quasi_harmonic_map` raises it.
        """
        settings = problem, reference, linear_solver
        return self._apply(make_tensor_layer, settings, {"mu": mu, "target": target, "rest": rest})

    @takes(SolvedOptions, SolvedKeywords)
    def injective_map(
        self, problem: Problem, *, target: T | None = None, rest: T | None = None, **options: Unpack[SolvedKeywords]
    ) -> T:
        """Return polished injective maps of tensors or arrays, as `quasiharmonic.solve`, converged to rounding.

        Parameters
        ----------
        problem, target, rest
            As for `quasi_harmonic_map`.
        polish, slide, start, linear_solver
            As for `quasiharmonic.solve`; ``start`` is shared by the whole batch. If the boundary slides along curves
            that are not straight, gradients are typically accurate to 0.5 % (see `polish_derivative`).

        Returns
        -------
        (…, n, 2) float64 or float32

        Raises
        ------
        TypeError, ValueError
            As `quasi_harmonic_map`, or as `quasiharmonic.solve`.
        MapNotFound
            If no injective map was found for one item of the batch.
        """
        return self._apply(make_solved_layer, (problem, options), {"target": target, "rest": rest})

    @takes(FlattenOptions, FlattenedKeywords)
    def flatten(self, rest: T, F: ArrayLike, *, target: T | None = None, **options: Unpack[FlattenedKeywords]) -> T:
        """Return maps with a free boundary, as `quasiharmonic.flatten`, converged to rounding.

        Parameters
        ----------
        rest : (…, n, 2) or (…, n, 3) float64 or float32
            Rest positions of one connected surface.
        F : (f, 3) array of int
            Triangles.
        fixed : (k,) array of int, optional
            Fixed vertices.
        target : (…, k, 2) float64 or float32, optional
            Target positions of the fixed vertices.
        energy, weights, start, linear_solver
            As for `quasiharmonic.flatten`; ``start`` is shared by the whole batch.

        Returns
        -------
        (…, n, 2) float64 or float32
            Without ``fixed``, the gradient is that of the map nearest to this one, although `flatten` would lay it out
            differently. Use functions that do not depend on the map's position and rotation.

        Raises
        ------
        TypeError, ValueError
            As `quasi_harmonic_map`, or as `quasiharmonic.flatten`.
        MapNotFound
            If no injective map was found for one item of the batch.
        """
        return self._apply(make_flattened_layer, (rest, F, target, options), {"rest": rest, "target": target})
