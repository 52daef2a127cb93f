"""Decorators for functions that accept one mesh in place of ``V`` and ``F``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from os import PathLike
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io.adapters.cells import simulation_cells
from quasiharmonic.io.adapters.objects import MeshLike, mesh_arrays, stands_for_mesh
from quasiharmonic.util.arrays import FloatArray, IntArray, describe

P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
Path = str | PathLike[str]


class AcceptsMesh(Protocol[P, R_co]):
    """A function of ``V``, ``F`` and further arguments, or of a mesh and these arguments."""

    @overload
    def __call__(self, V: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> R_co: ...
    @overload
    def __call__(self, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


class WriterAcceptsMesh(Protocol[P, R_co]):
    """A function of a file to write, ``V``, ``F`` and further arguments, or of a file, a mesh and these arguments."""

    @overload
    def __call__(self, path: Path, V: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> R_co: ...
    @overload
    def __call__(self, path: Path, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


class AcceptsPlanarMesh(Protocol[P, R_co]):
    """A function of ``points``, ``F`` and further arguments, or of a planar mesh and these arguments."""

    @overload
    def __call__(self, points: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> R_co: ...
    @overload
    def __call__(self, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


def accepts_mesh(function: Callable[Concatenate[ArrayLike, ArrayLike, P], R]) -> AcceptsMesh[P, R]:
    """Decorate a function of ``V``, ``F``, … so that it accepts one mesh in their place."""
    return _decorate(function, 0)


def writer_accepts_mesh(function: Callable[Concatenate[Path, ArrayLike, ArrayLike, P], R]) -> WriterAcceptsMesh[P, R]:
    """Decorate a function of a path, ``V``, ``F``, … so that it accepts one mesh in place of ``V`` and ``F``."""
    return _decorate(function, 1)


def accepts_planar_mesh(function: Callable[Concatenate[ArrayLike, ArrayLike, P], R]) -> AcceptsPlanarMesh[P, R]:
    """Decorate a function of ``points`` and elements ``F`` so that it accepts one simulation mesh in their place."""
    return _decorate(function, 0, simulation_cells)


def init_accepts_mesh(init: Callable[..., None]) -> Callable[..., None]:
    """Decorate an ``__init__`` of ``V``, ``F``, … so that it accepts one mesh in their place."""
    made: Callable[..., None] = _decorate(init, 1)
    return made


def init_accepts_planar_mesh(init: Callable[..., None]) -> Callable[..., None]:
    """Decorate an ``__init__`` of ``points`` and elements ``F`` so that it accepts one simulation mesh."""
    made: Callable[..., None] = _decorate(init, 1, simulation_cells)
    return made


def _decorate(
    function: Callable[..., Any], index: int, arrays: Callable[[Any], tuple[FloatArray, IntArray]] = mesh_arrays
) -> Any:
    """Return a function that also accepts a mesh as argument number ``index``, in place of positions and ``F``."""
    first = list(inspect.signature(function).parameters)[index]

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        if len(args) > index and stands_for_mesh(args[index]):
            mesh, before, after = args[index], args[:index], args[index + 1 :]
            _check_room(function, mesh, len(args) + 1, kwargs)
            args = (*before, *arrays(mesh), *after)
        elif len(args) > index and isinstance(args[index], tuple) and np.ndim(args[index][:1]) > 2:
            pair = f"a tuple of {len(args[index])} arrays"
            raise TypeError(f"V is {pair}: pass them as separate arguments, as in {function.__name__}(*mesh)")
        elif first in kwargs and "F" not in kwargs and stands_for_mesh(kwargs[first]):
            kwargs[first], kwargs["F"] = arrays(kwargs[first])
        return function(*args, **kwargs)

    return wrapper


def _check_room(function: Callable[..., Any], mesh: object, count: int, kwargs: dict[str, Any]) -> None:
    """Raise a TypeError if both a mesh and ``F`` were passed."""
    parameters = inspect.signature(function).parameters.values()
    max_count = sum(parameter.kind is not inspect.Parameter.KEYWORD_ONLY for parameter in parameters)
    if "F" in kwargs or count > max_count:
        raise TypeError(f"{describe(mesh)} provides both V and F: omit F, or pass the array V instead")
