"""Elements of planar meshes: triangles of three and of six nodes, and quadrilaterals.

A row lists the nodes of an element, corners first, in order around the element. In a triangle of six nodes the mid-side
nodes follow the corners: between corners 0 and 1, corners 1 and 2, and corners 2 and 0, as in Gmsh and VTK. A row of
four nodes whose last two are equal is a triangle among quadrilaterals.

The Jacobian determinant of a triangle of six nodes is here in Bernstein form [1]_. The triangle is the image of the
reference triangle under a quadratic map. The derivatives towards the second and the third corner are linear in the
barycentric coordinates λ, so the determinant is a quadratic form,

    2 J(λ) = Σᵢⱼ λᵢ λⱼ cᵢⱼ,        cᵢⱼ = xᵀ Sᵢⱼ y.

The six coefficients are its Bézier control values, one for each corner and each side. They are bilinear in the
coordinates x and y of the nodes, with antisymmetric integer matrices Sᵢⱼ. If the sides are straight and the mid-side
nodes lie at their midpoints, all coefficients equal four times the area.

References
----------
.. [1] A. Johnen, J.-F. Remacle, C. Geuzaine, Geometrical validity of curvilinear finite elements. Journal of
   Computational Physics 233 (2013).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import edges, find_sides
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_range,
    edge_names,
    index_array,
    names_of,
    reject,
    triangle_names,
)

#: Pairs of corners of a six-node triangle, and the mid-side node between each pair.
SIDES = np.array([(0, 1), (1, 2), (2, 0)])
MIDDLES = np.array([3, 4, 5])
# The four triangles of a six-node triangle; the halves of a quadrilateral; its four corner triangles.
_QUARTERS = np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)])
_HALVES = np.array([(0, 1, 2), (0, 2, 3)])
_CORNERS = np.array([(0, 1, 2), (1, 2, 3), (2, 3, 0), (3, 0, 1)])
# Order of the nodes in the opposite direction around the element, by the number of nodes.
_REVERSED = {3: [0, 2, 1], 4: [0, 3, 2, 1], 6: [0, 2, 1, 5, 4, 3]}
#: The corners of each coefficient: a corner twice, or two corners.
PAIRS = np.array([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)])


def element_array(F: ArrayLike, n: int) -> IntArray:
    """Convert elements among ``n`` nodes to (f, 3), (f, 4) or (f, 6) int64; returns a copy.

    Raises a ValueError if there are no elements, the shape is wrong, a node does not exist, or an element repeats a
    node. Also if a mid-side node lies between different corners in different elements.
    """
    array = element_rows(F, n)
    if array.size == 0:
        raise ValueError("the mesh has no triangles")
    ordered = np.sort(np.delete(array, 3, axis=1) if array.shape[1] == 4 else array, axis=1)
    twice = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if array.shape[1] == 4:
        twice |= (array[:, 3:] == array[:, :2]).any(axis=1)
    if twice.any():
        raise ValueError(f"{name_elements(array, np.flatnonzero(twice))} with a node twice: remove them")
    if array.shape[1] == 6:
        _check_middles(array)
    return array


def element_rows(F: ArrayLike, n: int) -> IntArray:
    """Convert elements among ``n`` nodes to (f, 3), (f, 4) or (f, 6) int64, where f may be 0; returns a copy."""
    array = index_array("F", F)
    if array.size == 0:
        return np.empty((0, 3), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] not in _REVERSED:
        raise ValueError(
            "F must have shape (f, 3), (f, 4) or (f, 6), triangles, quadrilaterals or six-node triangles, not "
            f"{array.shape}"
        )
    check_range("F", array, n)
    return array


def _check_middles(F: IntArray) -> None:
    """Raise if neighbouring six-node triangles (f, 6) place a mid-side node between different corners."""
    ends = np.sort(F[:, SIDES].reshape(-1, 2), axis=1)
    middle, first, number = np.unique(F[:, MIDDLES], return_index=True, return_inverse=True)
    differs = (ends != ends[first][number.ravel()]).any(axis=1)
    reject(
        middle[np.unique(number.ravel()[differs])],
        "node",
        "nodes",
        "{} between different corners in one triangle than in another: a row of F needs the three corners, then the "
        "nodes between the first and the second, the second and the third, the third and the first",
    )


def check_spread(F: IntArray, n: int) -> None:
    """Raise if neighbouring elements of a planar mesh of ``n`` nodes overlap; elements are counterclockwise."""
    found = edges(covering_triangles(F)[0], n)
    if found.inconsistent.size and not found.nonmanifold.size:
        raise ValueError(
            f"the rest mesh is folded at {edge_names(found.inconsistent)}: both elements lie on the same side, so "
            "some are inverted. Pass a valid mesh, with the argument rest= of `morph`"
        )


def join_elements(blocks: Sequence[IntArray]) -> IntArray:
    """Join blocks of elements (k, 3), (k, 4) or (k, 6) into rows of one length.

    Raises a ValueError if there are six-node triangles and other elements.
    """
    sizes = {block.shape[1] for block in blocks if len(block)}
    if len(sizes) > 1 and 6 in sizes:
        raise ValueError(
            "the mesh has both six-node triangles and other elements: all elements must have the same order"
        )
    # A triangle among quadrilaterals repeats its last node.
    return _join_rows(blocks, 3)


def join_solids(blocks: Sequence[IntArray]) -> IntArray:
    """Join blocks of tetrahedra (k, 4) and hexahedra (k, 8) into rows of one length.

    A tetrahedron among hexahedra repeats its last node.
    """
    return _join_rows(blocks, 4)


def _join_rows(blocks: Sequence[IntArray], shortest: int) -> IntArray:
    """Join blocks of elements into rows of the largest length; shorter rows repeat their last node."""
    rows = [block for block in blocks if len(block)]
    width = max((block.shape[1] for block in rows), default=shortest)
    padded = [np.pad(block, ((0, 0), (0, width - block.shape[1])), mode="edge") for block in rows]
    return np.concatenate([np.empty((0, width), dtype=np.int64), *padded])


def split_solids(F: IntArray) -> tuple[IntArray, IntArray]:
    """Return the tetrahedra (t, 4) and the hexahedra (h, 8) of rows of `join_solids`, each in order."""
    tetrahedra = np.full(len(F), F.shape[1] == 4) | (F[:, 3] == F[:, -1])
    return F[tetrahedra, :4], F[~tetrahedra].reshape(-1, 8)


def name_elements(F: IntArray, which: IntArray) -> str:
    """Name the first few of the given elements: ``quadrilaterals 3, 8``."""
    if F.shape[1] == 4:
        return names_of("quadrilateral", "quadrilaterals", which)
    return triangle_names(which)


def covering_triangles(F: IntArray) -> tuple[IntArray, IntArray]:
    """Return triangles (t, 3) among all nodes that cover every element once, and the element (t,) of each.

    There are four for a six-node triangle, two for a quadrilateral.
    """
    if F.shape[1] == 3:
        return F, np.arange(len(F))
    if F.shape[1] == 6:
        return _parts(F, _QUARTERS)
    triangles, of = _parts(F, _HALVES)
    kept = triangles[:, 1] != triangles[:, 2]
    return triangles[kept], of[kept]


def nets_of(F: IntArray) -> list[IntArray]:
    """Triangle sets on which to search for a map, in the order to try them.

    For six-node triangles the first set joins the corners and ignores curved sides; the second covers the elements.
    """
    covering, _ = covering_triangles(F)
    return [F[:, :3], covering] if F.shape[1] == 6 else [covering]


def corner_triangles(F: IntArray) -> tuple[IntArray, IntArray]:
    """Return the corner triangles (4f, 3) of quadrilaterals (f, 4), and the element of each.

    All are positive if and only if the quadrilaterals are convex. The corner is the middle node. A triangle among
    quadrilaterals occurs twice, so every element is covered twice.
    """
    triangles, of = _parts(F, _CORNERS)
    at = np.arange(len(of)) % len(_CORNERS)
    kept = (F[:, 2] != F[:, 3])[of] | np.isin(at, (0, 3))
    return triangles[kept], of[kept]


def rim(F: IntArray) -> IntArray:
    """Ascending nodes on sides that belong to one element only; the orientation of elements does not matter."""
    triangles, _ = covering_triangles(F)
    pairs, side = find_sides(triangles, int(triangles.max(initial=-1)) + 1)
    return np.unique(pairs[np.bincount(side.ravel()) == 1])


def reverse_elements(F: IntArray) -> IntArray:
    """The same elements with their nodes in the opposite direction, starting at the same node."""
    turned: IntArray = F[:, _REVERSED[F.shape[1]]]
    if F.shape[1] == 4:
        triangles = F[:, 2] == F[:, 3]
        turned[triangles] = F[triangles][:, [0, 2, 1, 1]]
    return turned


def _parts(F: IntArray, parts: IntArray) -> tuple[IntArray, IntArray]:
    return F[:, parts].reshape(-1, 3), np.repeat(np.arange(len(F)), len(parts))


def _forms() -> IntArray:
    """The matrices Sᵢⱼ of the six coefficients; (6, 6, 6) int64."""
    # Twice the Bézier points of the element by its nodes: corners, and 2 · middle − half of either end.
    net = np.zeros((3, 3, 6), dtype=np.int64)
    for corner in range(3):
        net[corner, corner, corner] = 2
    for middle, (i, j) in zip((3, 4, 5), ((0, 1), (1, 2), (2, 0)), strict=True):
        net[i, j, middle] = net[j, i, middle] = 4
        net[i, j, [i, j]] = net[j, i, [i, j]] = -1
    # The derivatives towards corners 1 and 2, at corner i.
    along, across = net[1] - net[0], net[2] - net[0]
    forms = [np.outer(along[i], across[j]) + np.outer(along[j], across[i]) for i, j in PAIRS]
    return np.array([form - form.T for form in forms])


#: Sᵢⱼ in the order of `PAIRS`; (6, 6, 6) int64.
FORMS = _forms()


def jacobian_coefficients(x: FloatArray, y: FloatArray) -> FloatArray:
    """Control values (f, 6) of twice the Jacobian determinant, in floating point, for coordinates (f, 6) of nodes.

    They have the order of `PAIRS`: three corners, then the sides 01, 12 and 20.
    """
    return np.asarray(np.einsum("fa,kab,fb->fk", x, FORMS.astype(np.float64), y, optimize=True))


def min_jacobian(values: FloatArray) -> FloatArray:
    """Minimum of quadratic forms on the triangle where barycentric coordinates are non-negative.

    ``values`` (f, 6) are control values, as returned by `jacobian_coefficients`. The result is correct up to rounding
    relative to the largest control value. The minimum is attained at a corner, or at a critical point on a side or in
    the interior.
    """
    scale = np.abs(values).max(axis=1)
    values = values / np.where(scale > 0, scale, 1.0)[:, None]
    (a, b, c), (ab, bc, ca) = values[:, :3].T, values[:, 3:].T
    lowest = np.minimum(np.minimum(a, b), c)
    for start, end, between in ((a, b, ab), (b, c, bc), (c, a, ca)):
        fall, rise = start - between, end - between
        within = (fall > 0) & (rise > 0)
        share = fall / np.where(within, fall + rise, 1.0)
        lowest = np.where(within, np.minimum(lowest, start - fall * share), lowest)
    # Slopes at the first corner towards the second and the third, and half the second derivatives. For straight sides
    # these are noise, and so is the critical point. The form is evaluated there, so noise cannot give too low a
    # minimum.
    second, third, bb, cc, cross = ab - a, ca - a, a + b - 2 * ab, a + c - 2 * ca, a + bc - ab - ca
    det = bb * cc - cross**2
    convex = (det > 0) & (bb > 0)
    at = np.stack([cross * third - cc * second, cross * second - bb * third]) / np.where(convex, det, 1.0)
    inside = convex & (at > 0).all(axis=0) & (at.sum(axis=0) < 1)
    s, t = np.where(inside, at, 0.0)
    value = a + 2 * (second * s + third * t) + bb * s**2 + cc * t**2 + 2 * cross * s * t
    return np.asarray(scale * np.minimum(lowest, value))
