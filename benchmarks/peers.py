"""Methods that `speed` compares with; each takes the arrays of a mesh and its fixed vertices, and returns a map."""

from __future__ import annotations

import numpy as np

from quasiharmonic import boundary_loops
from quasiharmonic.util.arrays import FloatArray, IntArray


def igl_harmonic(V: FloatArray, F: IntArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """Return libigl's harmonic map, the baseline: one assembly, factorisation and solve; triangles may be inverted."""
    import igl

    return igl.harmonic(V, F, fixed, target, 1)


def scipy_splu(V: FloatArray, F: IntArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """Return the same map by SciPy's SuperLU in symmetric mode, from libigl's cotangent Laplacian."""
    import igl
    from scipy.sparse.linalg import splu

    free = np.setdiff1d(np.arange(len(V)), fixed)
    rows = -igl.cotmatrix(V, F).tocsr()[free]
    factor = splu(
        rows[:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    uv = np.empty((len(V), 2))
    uv[fixed] = target
    uv[free] = factor.solve(-(rows[:, fixed] @ target))
    return uv


def mouette_untangle(V: FloatArray, F: IntArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """Return Mouette's foldover-free map with fixed boundary, from libigl's harmonic map until it has no inversions."""
    from mouette.processing.parametrization.winslow import untangle

    start = igl_harmonic(V, F, fixed, target)
    a, b, c = start[F].transpose(1, 0, 2)
    # Use Mouette's own defaults: triangles of unit area on average, all of the same ideal shape.
    scale = np.sqrt(len(F) / (0.5 * np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1))).sum()))
    locked = np.zeros(len(V), dtype=bool)
    locked[fixed] = True
    points = untangle(start * scale, locked, F, np.tile(np.eye(2), (len(F), 1, 1)), stop_if_positive=True)
    return points.reshape(-1, 2) / scale


def igl_composite(V: FloatArray, F: IntArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    """Return libigl's composite of harmonic maps, the first into a disk; for one boundary loop without pins."""
    import igl

    loops = boundary_loops(F, len(V))
    if len(loops) > 1 or len(loops[0]) < len(fixed):
        raise ValueError("composite harmonic maps are for one boundary loop without pins")
    angle = np.arange(len(loops[0])) * (2 * np.pi / len(loops[0]))
    flat = igl.harmonic(V, F, loops[0], np.stack([np.cos(angle), np.sin(angle)], axis=1), 1)
    return igl.bijective_composite_harmonic_mapping(flat, F, fixed, target)


PEERS = {
    "igl.harmonic": igl_harmonic,
    "scipy splu": scipy_splu,
    "mouette": mouette_untangle,
    "igl composite": igl_composite,
}
