"""Checks whether triangles form a valid surface. Each check names the offending elements."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.topology import Edges, are_collapsed, components, edges, find_twins
from quasiharmonic.util.arrays import IntArray, edge_names, names_of


def surface_edges(F: IntArray, n: int) -> Edges:
    """Edges of triangles that form one connected, consistently oriented surface with a boundary.

    Raises a ValueError that names the first offending elements. Causes: a triangle that uses a vertex twice or is
    repeated, a vertex without triangle, non-manifold edges, mixed winding, no boundary, several components.
    """
    label = components(F, n)
    connected = not label.any()
    if not connected:
        # A vertex without triangle is a component of its own.
        unused = np.setdiff1d(np.arange(n), F)
        if unused.size:
            raise ValueError(f"{names_of('vertex', 'vertices', unused)}: no triangle uses them; remove them")
    found = manifold_edges(F, n)
    if not found.boundary.size:
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
        _check_triangles(F)
    if found.nonmanifold.size:
        raise ValueError(f"{edge_names(found.nonmanifold)} in more than two triangles: not a surface")
    if found.inconsistent.size:
        raise ValueError(
            f"mixed winding: {edge_names(found.inconsistent)} traversed in the same direction by both triangles; "
            "orient all triangles alike"
        )
    return found


def _check_triangles(F: IntArray) -> None:
    collapsed = np.flatnonzero(are_collapsed(F))
    if collapsed.size:
        raise ValueError(f"{names_of('triangle', 'triangles', collapsed)}: a vertex is used twice in a triangle")

    repeats = np.flatnonzero(find_twins(F) < np.arange(len(F)))
    if repeats.size:
        raise ValueError(f"{names_of('triangle', 'triangles', repeats)} repeated: the same three vertices occur before")
