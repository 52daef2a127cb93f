"""Parts of a surface that lie in a plane: they are laid out without stretch and without a search."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.exact.loops import simple_loops
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# Distance from the plane, relative to the part's size, up to which a part counts as planar.
_FLAT = 1e-9


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
    sums = [np.bincount(component, cross[:, k], minlength=count) for k in range(3)]
    normal: FloatArray = np.stack(sums, axis=1).astype(np.float64)
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
