"""Unfold small closed components into the plane without stretch, like paper models.

Triangles are joined across the flattest edges, along a tree. All components are unfolded at once, because thousands of
them would take minutes one by one.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.unwrapping.flat_parts import covers_once
from quasiharmonic.apps.unwrapping.hinges import find_hinges
from quasiharmonic.apps.unwrapping.unrolling import lay_along, spanning_links
from quasiharmonic.geometry.mesh.fans import fans
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray


def unfold(V: FloatArray, F: IntArray, undivided: BoolArray) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
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
