"""Elements of planar meshes: triangles of three and of six nodes, and quadrilaterals.

A row has an element's nodes, corners first, one after another around it. A triangle of six nodes has its mid-side nodes
behind its corners, between the first and the second, the second and the third, the third and the first, as Gmsh and VTK
order them. A row of four whose last two are one node is a triangle among quadrilaterals.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import edges
from quasiharmonic.util.arrays import IntArray, check_range, index_array, named, named_edges

#: Pairs of a six-node triangle's corners, and the mid-side node between each.
SIDES = np.array([(0, 1), (1, 2), (2, 0)])
MIDDLES = np.array([3, 4, 5])
# The four triangles of a six-node one, and of a quadrilateral: those on either side of a diagonal, and at its corners.
_QUARTERS = np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)])
_HALVES = np.array([(0, 1, 2), (0, 2, 3)])
_CORNERS = np.array([(0, 1, 2), (1, 2, 3), (2, 3, 0), (3, 0, 1)])
# Nodes of a row, by how many they are: in the other direction around the element.
_TURNED = {3: [0, 2, 1], 4: [0, 3, 2, 1], 6: [0, 2, 1, 5, 4, 3]}


def element_array(F: ArrayLike, n: int) -> IntArray:
    """Elements among ``n`` nodes as (f, 3), (f, 4) or (f, 6) int64; a copy.

    Raises
    ------
    ValueError
        When there are none, they are no such elements, refer to nodes that there are not, have a node twice, or a node
        is between other corners in one element than in another.
    """
    array = element_rows(F, n)
    if array.size == 0:
        raise ValueError("the mesh has no triangles")
    ordered = np.sort(np.delete(array, 3, axis=1) if array.shape[1] == 4 else array, axis=1)
    twice = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if array.shape[1] == 4:
        twice |= (array[:, 3:] == array[:, :2]).any(axis=1)
    if twice.any():
        raise ValueError(f"{name_elements(array, np.flatnonzero(twice))} with a node twice")
    if array.shape[1] == 6:
        _check_middles(array)
    return array


def element_rows(F: ArrayLike, n: int) -> IntArray:
    """Any number of elements among ``n`` nodes, and be it none, as (f, 3), (f, 4) or (f, 6) int64; a copy.

    Raises
    ------
    ValueError
        When they are no elements by their shape, or refer to nodes that there are not.
    """
    array = index_array("F", F)
    if array.size == 0:
        return np.empty((0, 3), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] not in _TURNED:
        raise ValueError(
            "F must have shape (f, 3), (f, 4) or (f, 6), triangles, quadrilaterals or six-node triangles, not "
            f"{array.shape}"
        )
    check_range("F", array, n)
    return array


def _check_middles(F: IntArray) -> None:
    """Refuse six-node triangles (f, 6) in another order of nodes, as far as neighbours show it."""
    ends = np.sort(F[:, SIDES].reshape(-1, 2), axis=1)
    middle, first, number = np.unique(F[:, MIDDLES], return_index=True, return_inverse=True)
    torn = (ends != ends[first][number.ravel()]).any(axis=1)
    if torn.any():
        raise ValueError(
            f"{named('node', 'nodes', middle[np.unique(number.ravel()[torn])])} between different "
            f"corners in one triangle "
            "than in another: a row of F needs the three corners, then the nodes between the first and the second, "
            "the second and the third, the third and the first"
        )


def check_spread(F: IntArray, n: int) -> None:
    """Refuse a planar mesh of ``n`` nodes, its elements made counterclockwise, of which neighbours lie on each other.

    Raises
    ------
    ValueError
        Names the sides on which that is so.
    """
    found = edges(covering_triangles(F)[0], n)
    if found.inconsistent.size and not found.nonmanifold.size:
        raise ValueError(
            f"the rest mesh is folded at {named_edges(found.inconsistent)}: both elements lie on the same side, so "
            "some are inverted. Pass a valid mesh, with the argument rest= of `morph`"
        )


def joined(blocks: Sequence[IntArray]) -> IntArray:
    """Blocks of elements (k, 3), (k, 4) or (k, 6), one after another, as rows of one length.

    Raises
    ------
    ValueError
        When there are six-node triangles beside others.
    """
    sizes = {block.shape[1] for block in blocks if len(block)}
    if len(sizes) > 1 and 6 in sizes:
        raise ValueError(
            "the mesh has both six-node triangles and other elements: all elements must have the same order"
        )
    width = max(sizes, default=3)
    # A triangle among quadrilaterals has its last node twice.
    whole = [block[:, [*range(block.shape[1]), 2][:width]] for block in blocks if len(block)]
    return np.concatenate([np.empty((0, width), dtype=np.int64), *whole])


def name_elements(F: IntArray, which: IntArray) -> str:
    """Name the first few of some elements: ``quadrilaterals 3, 8``."""
    if F.shape[1] == 4:
        return named("quadrilateral", "quadrilaterals", which)
    return named("triangle", "triangles", which)


def covering_triangles(F: IntArray) -> tuple[IntArray, IntArray]:
    """Triangles among all nodes that cover every element once.

    Returns
    -------
    triangles : (t, 3) int64
        Of a six-node triangle four, of a quadrilateral two.
    of : (t,) int64
        The element of each.
    """
    if F.shape[1] == 3:
        return F, np.arange(len(F))
    if F.shape[1] == 6:
        return _parts(F, _QUARTERS)
    triangles, of = _parts(F, _HALVES)
    kept = triangles[:, 1] != triangles[:, 2]
    return triangles[kept], of[kept]


def nets_of(F: IntArray) -> list[IntArray]:
    """Sets of triangles to search for a map on, one after the other until a map will do.

    Of six-node triangles those between the corners, which see no curved side, and then those that cover them.
    """
    covering, _ = covering_triangles(F)
    return [F[:, :3], covering] if F.shape[1] == 6 else [covering]


def corner_triangles(F: IntArray) -> tuple[IntArray, IntArray]:
    """The triangles at the corners of quadrilaterals (f, 4), which are all positive just where these are convex.

    Returns
    -------
    triangles : (t, 3) int64
        Four of each quadrilateral, and where it is a triangle that one twice, so that all are covered twice. The
        corner is the node in the middle.
    of : (t,) int64
        The element of each.
    """
    triangles, of = _parts(F, _CORNERS)
    at = np.arange(len(of)) % len(_CORNERS)
    kept = (F[:, 2] != F[:, 3])[of] | np.isin(at, (0, 3))
    return triangles[kept], of[kept]


def rim(F: IntArray) -> IntArray:
    """Nodes on sides that one element alone has, however elements are wound; ascending."""
    triangles, _ = covering_triangles(F)
    pairs = np.sort(triangles[:, SIDES].reshape(-1, 2), axis=1)
    found, count = np.unique(pairs, axis=0, return_counts=True)
    return np.unique(found[count == 1])


def turned_over(F: IntArray) -> IntArray:
    """The same elements with their nodes in the other direction around them, beginning at the same one."""
    turned: IntArray = F[:, _TURNED[F.shape[1]]]
    if F.shape[1] == 4:
        triangles = F[:, 2] == F[:, 3]
        turned[triangles] = F[triangles][:, [0, 2, 1, 1]]
    return turned


def _parts(F: IntArray, parts: IntArray) -> tuple[IntArray, IntArray]:
    return F[:, parts].reshape(-1, 3), np.repeat(np.arange(len(F)), len(parts))
