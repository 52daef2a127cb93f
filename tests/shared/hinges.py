"""The interior edges of a model, and what an unwrap makes of them, by formulas different from the library's."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


class Edges(NamedTuple):
    """The edges (e,) of exactly two triangles of a model without repeated vertices.

    Attributes
    ----------
    ends : (e, 2) int64
        Ascending.
    left, right : (e,) int64
        The triangles.
    degrees : (e,) float64
        Angle between their normals.
    length : (e,) float64
    seam : (e,) bool
        Whether the triangles have different rows of texture coordinates at an end.
    """

    ends: np.ndarray
    left: np.ndarray
    right: np.ndarray
    degrees: np.ndarray
    length: np.ndarray
    seam: np.ndarray


def unit_normals(V, F):
    """The unit normals (f, 3) of triangles with an area."""
    normals = np.cross(V[F[:, 0]] - V[F[:, 2]], V[F[:, 1]] - V[F[:, 2]])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def edges_of(V, F, indices):
    """Return the edges of a model, given the rows of texture coordinates (f, 3) of its triangles."""
    V, F = np.asarray(V, dtype=float), np.asarray(F)
    users = {}
    for t, (triangle, rows) in enumerate(zip(F.tolist(), np.asarray(indices).tolist(), strict=True)):
        for k in range(3):
            one, two = sorted(((triangle[k], rows[k]), (triangle[k - 1], rows[k - 1])))
            users.setdefault((one[0], two[0]), []).append((t, one[1], two[1]))
    inner = {ends: pair for ends, pair in users.items() if len(pair) == 2}
    ends = np.array(list(inner), dtype=np.int64).reshape(-1, 2)
    left, right = np.array([[pair[0][0], pair[1][0]] for pair in inner.values()], dtype=np.int64).reshape(-1, 2).T
    normals = unit_normals(V, F)
    # For small angles the arc cosine would lose half of the digits.
    half = np.linalg.norm(normals[left] - normals[right], axis=1) / 2
    return Edges(
        ends,
        left,
        right,
        np.degrees(2 * np.arcsin(np.minimum(half, 1))),
        np.linalg.norm(V[ends[:, 0]] - V[ends[:, 1]], axis=1),
        np.array([pair[0][1:] != pair[1][1:] for pair in inner.values()], dtype=bool),
    )


def groups(count, left, right):
    """Return the connected component (count,) of each triangle, given links between triangles."""
    return connected_components(coo_array((np.ones(len(left)), (left, right)), shape=(count, count)), directed=False)[1]


def cut_flat_edges(V, F, indices, tolerance=1e-4):
    """Return the seams (k, 2) between triangles in one plane, up to an angle in degrees."""
    edges = edges_of(V, F, indices)
    return edges.ends[edges.seam & (edges.degrees < tolerance)]


def count_flat_faces(V, F):
    """The number of flat faces of a model, single triangles included."""
    edges = edges_of(V, F, F)
    flat = edges.degrees < 1e-4
    return len(np.unique(groups(len(F), edges.left[flat], edges.right[flat])))


def euler_characteristic(rows):
    """Vertices minus edges plus triangles, of triangles (k, 3)."""
    sides = np.sort(np.concatenate([rows[:, [0, 1]], rows[:, [1, 2]], rows[:, [2, 0]]]), axis=1)
    return len(np.unique(rows)) - len(np.unique(sides, axis=0)) + len(rows)


def outline(indices):
    """Return the sides (s, 2) of the charts' outlines."""
    sides = np.sort(np.concatenate([indices[:, [0, 1]], indices[:, [1, 2]], indices[:, [2, 0]]]), axis=1)
    ends, count = np.unique(sides, axis=0, return_counts=True)
    return ends[count == 1]


def straight_share(indices, uvs, degrees=0.1):
    """The share of the charts' outlines, by length, that lies along the axes of the texture."""
    step = np.diff(uvs[outline(indices)], axis=1)[:, 0]
    low, high = np.sort(np.abs(step), axis=1).T
    return float(np.hypot(low, high)[low <= np.tan(np.radians(degrees)) * high].sum() / np.hypot(low, high).sum())


def stretches(V, F, result):
    """Return the smallest and the largest ratio (f,) of lengths in texels to lengths on the model, times a constant."""
    P = V[F]
    frame = np.linalg.qr(np.transpose(P[:, 1:] - P[:, :1], (0, 2, 1)))[1]
    Q = (np.asarray(result.uvs)[result.indices])[:, 1:] - np.asarray(result.uvs)[result.indices][:, :1]
    values = np.linalg.svd(np.transpose(Q, (0, 2, 1)) @ np.linalg.inv(frame), compute_uv=False)
    return values[:, 1], values[:, 0]
