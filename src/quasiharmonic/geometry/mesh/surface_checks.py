"""Checks whether triangles form a valid surface. Each check names the offending elements."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.topology import Edges, components, edges
from quasiharmonic.util.arrays import IntArray, edge_names, names_of


def surface_edges(F: IntArray, n: int, *, closed: bool = False) -> Edges:
    """Edges of triangles that form one connected, consistently oriented surface.

    A ``closed`` surface may have no boundary. Raises a ValueError that names the first offending elements. Causes: a
    triangle that uses a vertex twice or is repeated, a vertex without triangle, non-manifold edges, mixed winding, no
    boundary, several components.
    """
    label = components(F, n)
    connected = not label.any()
    if not connected:
        # A vertex without triangle is a component of its own.
        unused = np.setdiff1d(np.arange(n), F)
        if unused.size:
            raise ValueError(f"{names_of('vertex', 'vertices', unused)}: no triangle uses them; remove them")
    found = manifold_edges(F, n)
    if not closed and not found.boundary.size:
        raise ValueError(
            "the surface is closed: it has no boundary; cut it open first (cut_open; --cut of qhm map and qhm flatten)"
        )
    if not connected:
        first = np.unique(label)
        raise ValueError(
            f"the mesh has {first.size} components, the first ones around {names_of('vertex', 'vertices', first)}: "
            "map each component separately"
        )
    return found


def manifold_edges(F: IntArray, n: int) -> Edges:
    """Edges of triangles that form any number of surfaces, each consistently oriented.

    Raises a ValueError that names the first offending elements. Causes: a triangle that uses a vertex twice or is
    repeated, non-manifold edges, mixed winding.
    """
    found = edges(F, n)
    # An edge from a vertex to itself is never interior, so only the other kinds of edges need a test.
    if found.nonmanifold.size or found.inconsistent.size or np.any(found.boundary[:, 0] == found.boundary[:, 1]):
        _check_collapsed(F)
        _check_repeated(F)
    if found.nonmanifold.size:
        raise ValueError(f"{edge_names(found.nonmanifold)} in more than two triangles: not a surface")
    if found.inconsistent.size:
        raise ValueError(
            f"mixed winding: {edge_names(found.inconsistent)} traversed in the same direction by both triangles; "
            "orient all triangles alike"
        )
    return found


def _check_collapsed(F: IntArray) -> None:
    collapsed = np.flatnonzero((F[:, 0] == F[:, 1]) | (F[:, 1] == F[:, 2]) | (F[:, 2] == F[:, 0]))
    if collapsed.size:
        raise ValueError(f"{names_of('triangle', 'triangles', collapsed)}: a vertex is used twice in a triangle")


def _check_repeated(F: IntArray) -> None:
    corners = np.sort(F, axis=1)
    order = np.lexsort(corners.T)
    same = (corners[order[1:]] == corners[order[:-1]]).all(axis=1)
    if same.any():
        repeats = np.sort(order[1:][same])
        raise ValueError(f"{names_of('triangle', 'triangles', repeats)} repeated: the same three vertices occur before")
