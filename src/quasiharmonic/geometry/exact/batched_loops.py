"""Exact certificates of many small maps at once, at a lower cost than one by one.

Most maps are valid and have one boundary loop. A map is bijective if all triangles are positive and its only loop is
simple (`certify`). These two exact tests of triangles and boundary edges run on all maps together. `certify` then
checks the remaining maps one by one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.geometry.exact.certificate import Certificate, certify, inverted_triangles
from quasiharmonic.geometry.exact.loops import simple_loops
from quasiharmonic.util.arrays import FloatArray, IntArray


def certify_each(
    F: Sequence[IntArray], uv: Sequence[FloatArray], loops: Sequence[Sequence[IntArray]]
) -> list[Certificate]:
    """Certify maps exactly; each result equals that of `certify`.

    The loops are those of `boundary_loops`, not checked.
    """
    if not F:
        return []
    vertices = np.cumsum([0, *map(len, uv)])
    triangles = np.cumsum([0, *map(len, F)])
    positions = np.concatenate(uv)
    good = np.array([len(rims) == 1 for rims in loops]) & (np.diff(triangles) > 0)
    bad = inverted_triangles(np.concatenate([T + first for T, first in zip(F, vertices[:-1], strict=True)]), positions)
    good[np.searchsorted(triangles, bad, side="right") - 1] = False
    candidates = np.flatnonzero(good)
    if candidates.size:
        rims = [loops[k][0] + vertices[k] for k in candidates.tolist()]
        good[candidates] = simple_loops(rims, positions)
    return [
        Certificate(F[k], uv[k], True, loops=tuple(loops[k])) if good[k] else certify(F[k], uv[k], loops=loops[k])
        for k in range(len(F))
    ]
