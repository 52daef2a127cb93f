"""Maps with seams: the islands into which they cut a surface.

A map that is cut along seams gives a vertex several places, so its triangles refer to places by indices of their
own. What counts here is how the triangles are joined in the plane: two are, along an edge, if they share it on the
surface and put both of its ends at the same places, by whatever index. A vertex of an island is a fan of triangles
joined in that way; an island is a component, and always a surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.arrays import FloatArray, IntArray, check_range, map_array, triangle_rows
from quasiharmonic.mesh.topology import edge_keys


@dataclass(frozen=True, eq=False)
class Island:
    """A part of a map between its seams, numbered on its own.

    Attributes
    ----------
    F : (k, 3) int64
        Its triangles, by its own vertices.
    triangles : (k,) int64
        Which triangles of the mesh they are, ascending.
    vertices : (m,) int64
        Which vertex of the mesh each of its own is, ascending. A seam may run to both sides of a vertex, which is
        then there repeatedly.
    uv : (m, 2) float64
        Where its vertices are.
    """

    F: IntArray
    triangles: IntArray
    vertices: IntArray
    uv: FloatArray


def islands(F: ArrayLike, uv: ArrayLike, FT: ArrayLike | None = None) -> list[Island]:
    """Take a map apart at its seams.

    Parameters
    ----------
    F : (f, 3) array of int
        Triangles of the mesh.
    uv : (m, 2) array
        Places.
    FT : (f, 3) array of int, optional
        For every corner the row of ``uv`` it is at; a triangle with a corner at -1 has no place. By default ``F``:
        a map without seams.

    Returns
    -------
    list of Island
        By their first triangle. Edges at which three or more triangles meet, or two that are wound differently,
        are seams.

    Raises
    ------
    ValueError
        When the shapes do not fit, or there is no such row of ``uv``; the message names the rows.
    """
    F, places, FT = _checked(F, uv, FT)
    mapped = np.flatnonzero((FT >= 0).all(axis=1))
    # Equal numbers are one place, those that are none included.
    pairs = np.ascontiguousarray(places + 0.0).view(np.complex128).ravel()
    place = np.unique(pairs, return_inverse=True)[1].ravel()
    corners = F[mapped] * len(places) + place[FT[mapped]]
    welded = np.unique(corners, return_inverse=True)[1].reshape(-1, 3)
    split, island = fans(welded)
    by_island = np.argsort(island, kind="stable")
    found = []
    for rows in np.split(by_island, np.flatnonzero(np.diff(island[by_island])) + 1) if mapped.size else []:
        triangles = mapped[rows]
        of_mesh, at = F[triangles].ravel(), FT[triangles].ravel()
        own, first = renumbered(split[rows], F[triangles])
        found.append(Island(own, triangles, of_mesh[first], places[at[first]]))
    return found


def fans(F: IntArray, cut: IntArray | None = None) -> tuple[IntArray, IntArray]:
    """Split vertices at which triangles touch without being joined by edges.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles, of any kind.
    cut : (k, 2) int64, optional
        Edges at which no triangles are joined, either end first.

    Returns
    -------
    split : (f, 3) int64
        The same triangles with a vertex of its own for every fan around one: now a surface, with a boundary where
        an edge was not shared by exactly two triangles that are wound alike.
    component : (f,) int64
        The component of each triangle; both are numbered by first appearance.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    corner = np.arange(F.size).reshape(-1, 3)
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    ahead = corner[:, (1, 2, 0)].ravel()
    n = int(F.max(initial=0)) + 1
    key = edge_keys(tail, head, n)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    first = first[np.diff(first, append=key.size) == 2]
    if cut is not None:
        first = first[~np.isin(key[order[first]], edge_keys(cut[:, 0], cut[:, 1], n))]
    one, other = order[first], order[first + 1]
    opposed = (tail[one] == head[other]) & (tail[one] != tail[other])
    one, other = one[opposed], other[opposed]
    # The half-edge of a corner begins there: a joined pair identifies begin with end and end with begin.
    joined = np.concatenate([one, ahead[one]]), np.concatenate([ahead[other], other])
    ones = np.ones(joined[0].size, dtype=np.int8)
    split = connected_components(coo_array((ones, joined), shape=(F.size, F.size)), directed=False)[1]
    pairs = one // 3, other // 3
    component = connected_components(coo_array((ones[: one.size], pairs), shape=(len(F), len(F))), directed=False)[1]
    return _by_appearance(split).reshape(-1, 3), _by_appearance(component)


def renumbered(split: IntArray, F: IntArray) -> tuple[IntArray, IntArray]:
    """Give the vertices of some triangles numbers without gaps.

    Parameters
    ----------
    split : (k, 3) int64
        Triangles, as `fans` has them.
    F : (k, 3) int64
        The same triangles by the vertices that were split. These decide the order: one that was not split and has
        no gap keeps its numbers.

    Returns
    -------
    renumbered : (k, 3) int64
    first : (m,) int64
        For every vertex a corner that it is at, as an index into the flattened triangles.
    """
    _, first, own = np.unique(split.ravel(), return_index=True, return_inverse=True)
    order = np.argsort(F.ravel()[first], kind="stable")
    return np.argsort(order)[own.reshape(-1, 3)], first[order]


def _by_appearance(label: NDArray[np.integer]) -> IntArray:
    """Labels numbered in the order in which they appear."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(first.size, dtype=np.int64)
    rank[np.argsort(first)] = np.arange(first.size)
    return rank[inverse.ravel()]


def _checked(F: ArrayLike, uv: ArrayLike, FT: ArrayLike | None) -> tuple[IntArray, FloatArray, IntArray]:
    triangles, places = triangle_rows(F), map_array("uv", uv, finite=False)
    if FT is None:
        check_range("F", triangles, len(places))
        return triangles, places, triangles
    # How many vertices there are is not known here, only that none is below 0.
    check_range("F", triangles, int(triangles.max(initial=-1)) + 1)
    rows = triangle_rows(FT, "FT")
    if len(rows) != len(triangles):
        raise ValueError(f"FT must have as many rows as F, {len(triangles)}, not {len(rows)}")
    check_range("FT", rows, len(places), "row", "rows", least=-1)
    return triangles, places, rows
