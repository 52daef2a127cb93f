"""The functions that the packages for PyTorch and JAX share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar, Unpack

from numpy.typing import ArrayLike

from quasiharmonic.apps.gradients.layers import (
    FlattenedKeywords,
    Layer,
    SolvedKeywords,
    SolvedOptions,
    make_flattened_layer,
    make_solved_layer,
    make_tensor_layer,
)
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.util.options import FlattenOptions, takes

#: Tensors or arrays of a package.
T = TypeVar("T")


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
        self,
        problem: Problem,
        *,
        target: T | None = None,
        rest: T | None = None,
        **options: Unpack[SolvedKeywords],
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
