"""Unfold small closed components into the plane without stretch, like paper models.

Triangles are joined across the flattest edges, along a tree. All components are unfolded at once, because thousands of
them would take minutes one by one.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.apps.unwrapping.flat_parts import covers_once
from quasiharmonic.apps.unwrapping.hinges import find_hinges
from quasiharmonic.apps.unwrapping.unrolling import lay_along, spanning_links
from quasiharmonic.geometry.mesh.reference import area_vectors
from quasiharmonic.geometry.mesh.splitting import fans, renumber
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# A small component has at most this number of triangles, and at most this share of the area.
_SMALL, _SMALL_SHARE = 24, 0.01


def unfold_small_components(
    V: FloatArray, F: IntArray, undivided: BoolArray, demanded: BoolArray
) -> tuple[BoolArray, list[Chart]]:
    """Unfold the small closed components of a surface that have no demanded cuts.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
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
    component = fans(F)[1]
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
    order = np.argsort(component, kind="stable")
    for k, some in enumerate(np.split(order, np.flatnonzero(np.diff(component[order])) + 1)):
        if good[k]:
            own, corner = renumber(split[some], F[rows[some]])
            vertices = F[rows[some]].ravel()[corner]
            charts.append(Chart(rows[some], own, vertices, uv[split[some].ravel()[corner]], np.ones(some.size), 0.0))
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
    rank = np.empty(bend.size)
    rank[np.argsort(bend, kind="stable")] = np.arange(1, bend.size + 1)
    joined = spanning_links(hinges.first, hinges.second, rank, len(F))
    split, component = fans(F, ~hinges.mark_sides(joined, len(F)))
    place = lay_along(V, F, hinges.one[joined], hinges.other[joined], component)
    uv = np.zeros((int(split.max()) + 1, 2))
    flat = place.ravel()[np.unique(split.ravel(), return_index=True)[1]]
    uv[:, 0], uv[:, 1] = flat.real, flat.imag
    return split, component, uv, covers_once(split, uv, component, np.ones(int(component.max()) + 1, dtype=bool))
