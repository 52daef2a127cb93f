"""Lay parts of a surface into the plane without stretch: planar parts, and small closed components like paper models.

All components are unfolded at once, because thousands of them would take minutes one by one. Their triangles are joined
across the flattest edges, along a tree.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from quasiharmonic.apps.unwrapping.chart import Chart, cut_out_chart
from quasiharmonic.apps.unwrapping.hinges import Hinges, find_hinges
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.exact.loops import simple_loops
from quasiharmonic.geometry.mesh.reference import area_vectors, rest_frames
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import ahead, boundary_loops, edge_keys, group_by_label
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, mark, to_points

#: Two sides of an edge are at one place if their ends are at most this fraction of its length apart.
SAME = 1e-3
# Distance from the plane, relative to the part's size, up to which a part counts as planar.
_FLAT = 1e-9
# A small component has at most this number of triangles, and at most this share of the area.
_SMALL, _SMALL_SHARE = 24, 0.01


def find_forest(F: IntArray, hinges: Hinges, preferred: IntArray) -> tuple[BoolArray, IntArray, IntArray]:
    """Return a mask (e,) of hinges that join triangles (f, 3) to a spanning forest, and `fans` joined at these only.

    ``preferred`` (k,) are the hinges that may be used, best first.
    """
    rank, ends = np.arange(1.0, preferred.size + 1), (hinges.first[preferred], hinges.second[preferred])
    links = csr_array((rank, tuple(end.astype(np.int32) for end in ends)), shape=(len(F), len(F)))
    linked = mark(hinges.one.size, preferred[np.isin(rank, minimum_spanning_tree(links).data)])
    return linked, *fans(F, ~hinges.mark_sides(linked, len(F)))


def lay_along(V: FloatArray, F: IntArray, one: IntArray, other: IntArray, component: IntArray) -> ComplexArray:
    """Lay triangles next to each other along a forest of joined sides.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    one, other : (k,) int64
        The sides that are joined. They connect the triangles of each component without circles.
    component : (f,) int64
        Component of each triangle.

    Returns
    -------
    (f, 3) complex128
        Position of every corner. The first triangle of a component keeps the frame of `rest_frames`.
    """
    f = len(F)
    z1, z2 = rest_frames(V, F)
    z = np.stack([np.zeros(f, dtype=np.complex128), z1.astype(np.complex128), z2], axis=1)
    first, second = one // 3, other // 3
    roots = np.unique(component, return_index=True)[1]
    tails, heads = np.concatenate([first, np.full(roots.size, f)]), np.concatenate([second, roots])
    forest = csr_array((np.ones(tails.size), (tails.astype(np.int32), heads.astype(np.int32))), shape=(f + 1, f + 1))
    _, before = breadth_first_order(forest, f, directed=False)
    # The sides that join each triangle to the one before it: its own and the other's.
    forward = before[second] == first
    rows, parents = np.where(forward, second, first), np.where(forward, first, second)
    own, there = np.where(forward, other, one) % 3, np.where(forward, one, other) % 3
    start, end = z[parents, (there + 1) % 3], z[parents, there]
    tail, head = z[rows, own], z[rows, (own + 1) % 3]
    # The motion of each triangle into the frame of a triangle before it, at first the next one; ``f`` after the root.
    turn, shift = np.ones(f + 1, dtype=np.complex128), np.zeros(f + 1, dtype=np.complex128)
    turn[rows] = (end - start) / (head - tail)
    turn /= np.abs(turn)
    shift[rows] = start - tail * turn[rows]
    above = np.where(before < 0, f, before)
    while (above != f).any():
        turn, shift, above = turn[above] * turn, turn[above] * shift + shift[above], above[above]
    turn /= np.abs(turn)
    return z * turn[:f, None] + shift[:f, None]


def meet(place: ComplexArray, hinges: Hinges, chosen: IntArray) -> BoolArray:
    """Return which of some hinges (k,) have both sides at one place, up to `SAME`, given the corners' places (f, 3)."""
    z, one, other = place.ravel(), hinges.one[chosen], hinges.other[chosen]
    apart = np.maximum(np.abs(z[one] - z[ahead(other)]), np.abs(z[ahead(one)] - z[other]))
    return np.asarray(apart <= SAME * hinges.length[chosen])


def lay_flat_parts(V: FloatArray, F: IntArray, component: IntArray) -> tuple[BoolArray, FloatArray]:
    """Lay out all parts that lie in a plane and do not overlap themselves.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        Triangles; parts have no common vertices.
    component : (f,) int64
        Part of each triangle; every number from 0 on occurs.

    Returns
    -------
    flat : (c,) bool
        Which parts are laid out.
    uv : (n, 2) float64
        Their positions, isometric; 0 elsewhere.
    """
    count = int(component.max(initial=-1)) + 1
    first = np.unique(component, return_index=True)[1]
    corners = V[F] - V[F[first, 0]][component][:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.zeros(count)
        np.maximum.at(size, component, np.abs(corners).max(axis=(1, 2)))
        corners /= np.where(size > 0, size, 1.0)[component][:, None, None]
    along, across = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(along, across)
    normal = np.stack([np.bincount(component, axis, count) for axis in cross.T], axis=1).astype(np.float64)
    length = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(length > 0, length, 1.0)[:, None]
    height = np.abs((corners * normal[component][:, None]).sum(axis=2)).max(axis=1)
    flat = (length > 0) & (size > 0)
    flat[component[(height > _FLAT) | ~((cross * normal[component]).sum(axis=1) > 0)]] = False
    # An orthonormal frame; the first axis is the first side of the part.
    axis = along[first] - (along[first] * normal).sum(axis=1)[:, None] * normal
    width = np.linalg.norm(axis, axis=1)
    axis /= np.where(width > 0, width, 1.0)[:, None]
    frame = np.stack([axis, np.cross(normal, axis)], axis=1)
    local = np.einsum("fkx,fdx->fkd", corners, frame[component])
    uv = np.zeros((len(V), 2))
    uv[F] = np.where(flat, size, 0.0)[component][:, None, None] * local
    return flat & covers_once(F, uv, component, flat), uv


def covers_once(F: IntArray, uv: FloatArray, component: IntArray, candidates: BoolArray) -> BoolArray:
    """Which of the candidate parts (c,) do not overlap themselves."""
    good = candidates.copy()
    good[component[inverted_triangles(F, uv)]] = False
    if not good.any():
        return good
    loops = boundary_loops(F[good[component]], len(uv))
    part = np.zeros(len(uv), dtype=np.int64)
    part[F] = component[:, None]
    owner = np.array([part[loop[0]] for loop in loops], dtype=np.int64)
    number = np.bincount(owner, minlength=len(good))
    # Positive triangles inside one simple loop cover it once.
    single = number[owner] == 1
    alone = [loop for loop, one in zip(loops, single.tolist(), strict=True) if one]
    if alone:
        good[owner[single]] = simple_loops(alone, uv)
    for k in np.flatnonzero(good & (number > 1)).tolist():
        used, own = np.unique(F[component == k], return_inverse=True)
        good[k] = bool(certify(own.reshape(-1, 3), uv[used]).bijective)
    return good


def unfold_small_components(
    V: FloatArray, F: IntArray, hinges: Hinges, undivided: BoolArray, demanded: BoolArray
) -> tuple[BoolArray, list[Chart]]:
    """Unfold the small closed components of a surface that have no demanded cuts.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    hinges : Hinges
    undivided, demanded : (f, 3) bool
        Sides across which triangles are joined first, such as those inside polygons, and sides that must be seams.

    Returns
    -------
    mask : (f,) bool
        The triangles of the components that do not overlap themselves when they are unfolded.
    charts : list of Chart
        One for each of these components.
    """
    mask, charts = np.zeros(len(F), dtype=bool), list[Chart]()
    component = fans(F, pairs=(hinges.one, hinges.other))[1]
    chosen = np.bincount(component) <= _SMALL
    if not chosen.any():
        return mask, charts
    area = np.linalg.norm(area_vectors(V, F), axis=1)
    chosen &= np.bincount(component, area) <= _SMALL_SHARE * area.sum()
    sides = edge_keys(F, F[:, (1, 2, 0)], len(V))
    _, edge, times = np.unique(sides, return_inverse=True, return_counts=True)
    chosen[component[((times[edge].reshape(sides.shape) < 2) | demanded).any(axis=1)]] = False
    rows = np.flatnonzero(chosen[component])
    if not rows.size:
        return mask, charts
    split, component, uv, good = _unfold(V, F[rows], undivided[rows])
    for k, some in enumerate(group_by_label(component)):
        if good[k]:
            charts.append(cut_out_chart(rows[some], split[some], F[rows[some]], uv[split[some]], np.ones(some.size)))
    mask[rows[good[component]]] = True
    return mask, charts


def _unfold(V: FloatArray, F: IntArray, undivided: BoolArray) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Unfold closed surfaces.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        Triangles of closed surfaces.
    undivided : (f, 3) bool
        Sides across which triangles are joined first, such as those inside polygons.

    Returns
    -------
    split : (f, 3) int64
        Triangles by vertices of the unfolded surfaces.
    component : (f,) int64
        Surface of each triangle, by first appearance.
    uv : (m, 2) float64
        Positions of the unfolded vertices.
    good : (c,) bool
        Which surfaces do not overlap themselves.
    """
    hinges = find_hinges(V, F)
    bend = 1 - np.cos(hinges.angle)
    bend[undivided.ravel()[hinges.one] | undivided.ravel()[hinges.other]] = -1.0
    joined, split, component = find_forest(F, hinges, np.argsort(bend, kind="stable"))
    place = lay_along(V, F, hinges.one[joined], hinges.other[joined], component)
    uv = to_points(place.ravel()[np.unique(split.ravel(), return_index=True)[1]])
    return split, component, uv, covers_once(split, uv, component, np.ones(int(component.max()) + 1, dtype=bool))
