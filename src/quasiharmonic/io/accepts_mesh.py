"""Decorators for functions that accept one mesh in place of ``V`` and ``F``.

Simulation meshes have nodes and elements: those of scikit-fem, meshio, PyVista, DOLFINx, and of files. As in `objects`,
no library is imported: an object is recognised by its attribute names.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from os import PathLike
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.elements import join_elements, split_solids
from quasiharmonic.io.fem.files import read_fem, read_volume
from quasiharmonic.io.objects import MeshLike, mesh_arrays, planar_arrays, stands_for_mesh, without_constant_z
from quasiharmonic.io.registry import FilePath, has_elements
from quasiharmonic.util.arrays import FloatArray, IntArray, describe, index_array, vertex_array

# Kinds of cells in meshio's and VTK's names: number of nodes of planar ones, solids, and those without area.
_NODES = {"triangle": 3, "quad": 4, "triangle6": 6, 5: 3, 9: 4, 22: 6}
_TETRAHEDRA = ("tetra", 10)
_SOLIDS = ("tetra10", "hexahedron", "wedge", "pyramid", "hexahedron20", "hexahedron27", 11, 12, 13, 14, 24, 25)
_SKIPPED_CELLS = ("vertex", "line", "line3", 1, 2, 3, 4, 21)
# VTK's kind number of polygons, which are cut into triangles.
_POLYGON = 7
# Permutation from DOLFINx's node order to the order around the element, by number of nodes.
_DOLFINX_ORDER = {4: [0, 1, 3, 2], 6: [0, 1, 2, 5, 3, 4]}
# Number of nodes of its tetrahedra, of first and of second order.
_DOLFINX_SOLIDS = 4, 10
P = ParamSpec("P")
R = TypeVar("R")


def simulation_cells(mesh: MeshLike) -> tuple[FloatArray, IntArray]:
    """Return the nodes and the elements of a simulation mesh, given as an object, a mapping or a path.

    Objects are meshes of scikit-fem (``doflocs`` and ``dofs.element_dofs``), DOLFINx (``geometry.x`` and
    ``geometry.dofmap``), meshio (``cells`` in blocks) or PyVista (``cells_dict``), and all that `mesh_arrays` accepts.
    A path ends in ``.msh``, ``.vtk``, ``.vtu`` or ``.mesh``. Nodes (n, 2) have the library's order; they are (n, 3) if
    they do not lie in a plane of constant z. Elements have the format of `geometry.mesh.elements`. If the mesh has
    tetrahedra (t, 4), only these are returned.

    ValueError for cells of other kinds, second-order tetrahedra, or six-node triangles together with other elements;
    MeshFileError if the file cannot be read.
    """
    what = describe(mesh)
    if isinstance(mesh, str | PathLike):
        if not has_elements(mesh):
            return planar_arrays(mesh)
        read = read_volume(mesh)
        T, H = split_solids(read.F)
        if len(H):
            raise ValueError(f"{what} has hexahedra: split them into tetrahedra")
        if len(T):
            return read.points, T
        read = read_fem(mesh)
        return read.points, read.F
    given: Any = mesh
    if hasattr(given, "doflocs"):
        X = vertex_array(np.asarray(given.doflocs).T, f"doflocs of {what}", finite=False)
        return X, index_array(f"t of {what}", np.asarray(given.dofs.element_dofs).T)
    if hasattr(getattr(given, "geometry", None), "dofmap"):
        X = without_constant_z(vertex_array(given.geometry.x, f"geometry of {what}", finite=False))
        F = index_array(f"dofmap of {what}", given.geometry.dofmap)
        nodes = F.shape[1] if F.ndim == 2 else 0
        solid = X.shape[1] == 3 and nodes in _DOLFINX_SOLIDS
        return X, F if solid or nodes not in _DOLFINX_ORDER else F[:, _DOLFINX_ORDER[nodes]]
    blocks = _blocks(given)
    simplices: Any = getattr(given, "simplices", None)
    if np.shape(simplices)[1:] == (4,):
        blocks = [("tetra", simplices)]
    if blocks is None:
        return planar_arrays(mesh)
    if solids := [kind for kind, _ in blocks if kind in _SOLIDS]:
        raise ValueError(
            f"cells of {what} have the cell type {solids[0]!r}: only tetrahedra of four nodes are supported"
        )
    X, name = vertex_array(given.points, f"points of {what}", finite=False), f"cells of {what}"
    tetrahedra = [nodes for kind, nodes in blocks if kind in _TETRAHEDRA]
    if tetrahedra and X.shape[1] == 3:
        return X, np.concatenate([index_array(name, nodes).reshape(-1, 4) for nodes in tetrahedra])
    return without_constant_z(X), _elements(blocks, name)


def _elements(blocks: Iterable[tuple[Any, Any]], name: str) -> IntArray:
    """Join blocks of elements, each of one kind in meshio's or VTK's names, into rows of one length."""
    rows = []
    for kind, nodes in blocks:
        if kind in _SKIPPED_CELLS:
            continue
        if kind not in _NODES:
            raise ValueError(
                f"{name} have the cell type {kind!r}: only planar meshes of triangles, six-node triangles or "
                "quadrilaterals are supported"
            )
        rows.append(index_array(name, nodes).reshape(-1, _NODES[kind]))
    return join_elements(rows)


def _blocks(mesh: Any) -> list[tuple[Any, Any]] | None:
    """Return kinds of cells and their nodes from meshio's or PyVista's attributes; None if the mesh has neither."""
    cells = getattr(mesh, "cells", None)
    if isinstance(cells, Sequence) and cells and all(hasattr(block, "data") for block in cells):
        return [(block.type, block.data) for block in cells]
    if _POLYGON in np.asarray(getattr(mesh, "celltypes", ())):
        return None
    by_kind = getattr(mesh, "cells_dict", None)
    return None if by_kind is None else list(by_kind.items())


R_co = TypeVar("R_co", covariant=True)


class AcceptsMesh(Protocol[P, R_co]):
    """A function of ``V``, ``F`` and further arguments, or of a mesh and these arguments."""

    @overload
    def __call__(self, V: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> R_co: ...
    @overload
    def __call__(self, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


class WriterAcceptsMesh(Protocol[P, R_co]):
    """A function of a file to write, ``V``, ``F`` and further arguments, or of a file, a mesh and these arguments."""

    @overload
    def __call__(self, path: FilePath, V: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> R_co: ...
    @overload
    def __call__(self, path: FilePath, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


class AcceptsPlanarMesh(Protocol[P, R_co]):
    """A function of ``points``, ``F`` and further arguments, or of a planar mesh and these arguments."""

    @overload
    def __call__(self, points: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> R_co: ...
    @overload
    def __call__(self, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> R_co: ...


def accepts_mesh(function: Callable[Concatenate[ArrayLike, ArrayLike, P], R]) -> AcceptsMesh[P, R]:
    """Decorate a function of ``V``, ``F``, … so that it accepts one mesh in their place."""
    return _decorate(function, 0)


def writer_accepts_mesh(
    function: Callable[Concatenate[FilePath, ArrayLike, ArrayLike, P], R],
) -> WriterAcceptsMesh[P, R]:
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
