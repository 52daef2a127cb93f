"""Nodes and elements of simulation meshes: scikit-fem, meshio, PyVista, DOLFINx, and files.

As in `objects`, no library is imported: the adapter recognises an object by its attribute names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic.geometry.mesh.elements import join_elements, split_solids
from quasiharmonic.io.adapters.objects import MeshLike, planar_arrays
from quasiharmonic.io.registry import suffixes
from quasiharmonic.util.arrays import FloatArray, IntArray, describe, index_array, vertex_array

# Number of nodes by kind of cell, in meshio's and VTK's names; then the kinds to skip, which have no area.
_NODES = {"triangle": 3, "quad": 4, "triangle6": 6, 5: 3, 9: 4, 22: 6}
_TETRAHEDRA = ("tetra", 10)
_SOLIDS = ("tetra10", "hexahedron", "wedge", "pyramid", "hexahedron20", "hexahedron27", 11, 12, 13, 14, 24, 25)
_SKIPPED_CELLS = ("vertex", "line", "line3", 1, 2, 3, 4, 21)
# VTK's kind number of polygons, which are cut into triangles.
_POLYGON = 7
# Permutation from DOLFINx's node order to the order around the element, by number of nodes.
_DOLFINX_ORDER = {3: [0, 1, 2], 4: [0, 1, 3, 2], 6: [0, 1, 2, 5, 3, 4]}


def simulation_cells(mesh: MeshLike) -> tuple[FloatArray, IntArray]:
    """Return the nodes and the elements of a simulation mesh, given as an object, a mapping or a path.

    If the mesh has tetrahedra, these are positions (n, 3) and tetrahedra (t, 4), and cells without volume are skipped.
    Otherwise they are those of `planar_cells`. ValueError for second-order tetrahedra and other cells with volume.
    """
    given: Any = mesh
    what = describe(mesh)
    if isinstance(mesh, str | PathLike):
        if Path(mesh).suffix.lower() in suffixes("read_elements"):
            from quasiharmonic.io.fem.files import read_volume

            read = read_volume(mesh)
            T, H = split_solids(read.F)
            if len(H):
                raise ValueError(f"{what} has hexahedra: only tetrahedra are supported")
            if len(T):
                return read.points, T
        return planar_cells(mesh)
    if hasattr(given, "doflocs"):
        X, T = np.asarray(given.doflocs).T, np.asarray(given.dofs.element_dofs).T
        if X.shape[1:] == (3,):
            return vertex_array(X, f"doflocs of {what}", finite=False), index_array(f"t of {what}", T)
    elif hasattr(given, "geometry"):
        X, T = np.asarray(given.geometry.x), np.asarray(given.geometry.dofmap)
        if X.ndim == 2 and X.shape[1] == 3 and T.shape[1:] in ((4,), (10,)) and len(X) and np.ptp(X[:, 2]):
            return vertex_array(X, f"geometry of {what}", finite=False), index_array(f"dofmap of {what}", T)
    else:
        blocks = [(kind, nodes) for kind, nodes in _blocks(mesh) or () if kind in _TETRAHEDRA or kind in _SOLIDS]
        other = [kind for kind, _ in blocks if kind in _SOLIDS]
        if other:
            raise ValueError(
                f"cells of {what} have the cell type {other[0]!r}: only tetrahedra of four nodes are supported"
            )
        if blocks and np.ndim(given.points) == 2 and np.shape(given.points)[1] == 3:
            X = vertex_array(given.points, f"points of {what}", finite=False)
            return X, np.concatenate([index_array(f"cells of {what}", nodes).reshape(-1, 4) for _, nodes in blocks])
    return planar_cells(mesh)


def planar_cells(mesh: MeshLike) -> tuple[FloatArray, IntArray]:
    """Return the nodes and the elements of a planar mesh, given as an object, a mapping or a path.

    Objects are meshes of scikit-fem (``doflocs`` and ``dofs.element_dofs``), DOLFINx (``geometry.x`` and
    ``geometry.dofmap``), meshio (``cells`` in blocks) or PyVista (``cells_dict``), and all that `mesh_arrays` accepts.
    A path ends in ``.msh``, ``.vtk`` or ``.vtu``. Nodes (n, 2) have the library's order; they are (n, 3) if they do not
    lie in a plane of constant z. Elements have the format of `geometry.mesh.elements`. ValueError for cells of other
    kinds, or six-node triangles together with other elements; MeshFileError if the file cannot be read.
    """
    if isinstance(mesh, str | PathLike) and Path(mesh).suffix.lower() in suffixes("read_elements"):
        from quasiharmonic.io.fem.files import read_fem

        read = read_fem(mesh)
        return read.points, read.F
    given: Any = mesh
    what = describe(mesh)
    if hasattr(given, "doflocs"):
        return _planar(np.asarray(given.doflocs).T, what), index_array(f"t of {what}", given.dofs.element_dofs).T
    if hasattr(given, "geometry"):
        F = index_array(f"dofmap of {what}", given.geometry.dofmap)
        order = _DOLFINX_ORDER.get(F.shape[1] if F.ndim == 2 else 0)
        return _planar(given.geometry.x, what), F if order is None else F[:, order]
    blocks = _blocks(given)
    if blocks is None:
        return planar_arrays(mesh)
    return _planar(given.points, what), _elements(blocks, f"cells of {what}")


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


def _planar(points: Any, what: str) -> FloatArray:
    V = vertex_array(points, f"points of {what}", finite=False)
    return V[:, :2].copy() if V.shape[1] == 3 and len(V) and not np.ptp(V[:, 2]) else V
