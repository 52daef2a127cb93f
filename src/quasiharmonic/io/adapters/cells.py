"""Nodes and elements of planar simulation meshes: scikit-fem, meshio, PyVista, DOLFINx, and files.

As in `objects`, no library is imported: the adapter recognises an object by its attribute names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic.geometry.mesh.elements import joined
from quasiharmonic.io.adapters.objects import MeshLike, planar_arrays
from quasiharmonic.util.arrays import FloatArray, IntArray, index_array, kind_of, vertex_array

# Number of nodes by kind of cell, in meshio's and VTK's names; then the kinds to skip, which have no area.
_NODES = {"triangle": 3, "quad": 4, "triangle6": 6, 5: 3, 9: 4, 22: 6}
_PASSED_OVER = ("vertex", "line", "line3", 1, 2, 3, 4, 21)
# VTK's kind number of polygons, which are cut into triangles.
_POLYGON = 7
# Permutation from DOLFINx's node order to the order around the element, by number of nodes.
_AROUND = {3: [0, 1, 2], 4: [0, 1, 3, 2], 6: [0, 1, 2, 5, 3, 4]}
_FILES = (".msh", ".vtk", ".vtu")


def planar_cells(mesh: MeshLike) -> tuple[FloatArray, IntArray]:
    """Return the nodes and the elements of a planar mesh, given as an object, a mapping or a path.

    Parameters
    ----------
    mesh : object, mapping or path
        A mesh of scikit-fem (``doflocs`` and ``dofs.element_dofs``), of DOLFINx (``geometry.x`` and
        ``geometry.dofmap``), of meshio (``cells`` in blocks) or of PyVista (``cells_dict``); the path of a ``.msh``,
        ``.vtk`` or ``.vtu`` file; or any mesh that `quasiharmonic.io.adapters.objects.mesh_arrays` accepts, whose
        larger faces are cut into triangles.

    Returns
    -------
    points : (n, 2) float64
        Nodes in the library's order; (n, 3) if they do not lie in a plane of constant z.
    F : (f, 3), (f, 4) or (f, 6) int64
        Elements in the format of `quasiharmonic.geometry.mesh.elements`.

    Raises
    ------
    ValueError
        If there are cells of other kinds, or six-node triangles together with other elements.
    quasiharmonic.io.MeshFileError
        If the file cannot be read.
    """
    if isinstance(mesh, str | PathLike) and Path(mesh).suffix.lower() in _FILES:
        from quasiharmonic.io.fem.files import read_fem

        read = read_fem(mesh)
        return read.points, read.F
    whole: Any = mesh
    what = kind_of(mesh)
    if hasattr(whole, "doflocs"):
        return _planar(np.asarray(whole.doflocs).T, what), index_array(f"t of {what}", whole.dofs.element_dofs).T
    if hasattr(whole, "geometry"):
        F = index_array(f"dofmap of {what}", whole.geometry.dofmap)
        order = _AROUND.get(F.shape[1] if F.ndim == 2 else 0)
        return _planar(whole.geometry.x, what), F if order is None else F[:, order]
    blocks = _blocks(whole)
    if blocks is None:
        return planar_arrays(mesh)
    return _planar(whole.points, what), _elements(blocks, f"cells of {what}")


def _elements(blocks: Iterable[tuple[Any, Any]], name: str) -> IntArray:
    """Join blocks of elements, each of one kind in meshio's or VTK's names, into rows of one length."""
    rows = []
    for kind, nodes in blocks:
        if kind in _PASSED_OVER:
            continue
        if kind not in _NODES:
            raise ValueError(
                f"{name} have the cell type {kind!r}: only planar meshes of triangles, six-node triangles or "
                "quadrilaterals are supported"
            )
        rows.append(index_array(name, nodes).reshape(-1, _NODES[kind]))
    return joined(rows)


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
