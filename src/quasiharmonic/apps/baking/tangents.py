"""Tangent spaces of normal maps, by the rules of MikkTSpace: smooth tangents at corners, interpolated in triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.io.models.meshdata import MeshData, normals_of
from quasiharmonic.util.arrays import FloatArray, IntArray


class TangentFrames(NamedTuple):
    """Frames at the corners of triangles.

    Attributes
    ----------
    normal, tangent : (f, 3, 3) float64
        Unit vectors.
    side : (f,) float64
        1 if the bitangent is normal × tangent, -1 if it is opposite to it.
    """

    normal: FloatArray
    tangent: FloatArray
    side: FloatArray

    def at(self, triangle: IntArray, barycentric: FloatArray) -> FloatArray:
        """Return tangent, bitangent and normal (k, 3, 3), as rows, at points of triangles; they need not be unit."""
        normal = np.einsum("kc,kcd->kd", barycentric, self.normal[triangle])
        tangent = np.einsum("kc,kcd->kd", barycentric, self.tangent[triangle])
        bitangent = np.cross(normal, tangent) * self.side[triangle, None]
        return np.stack([tangent, bitangent, normal], axis=1)


def corner_normals(mesh: MeshData) -> FloatArray:
    """Return unit normals (f, 3, 3) at the corners: those of the file, or of the triangles where it has none."""
    a, b, c = mesh.V[mesh.F].swapaxes(0, 1)
    flat = np.repeat(_normalise(np.cross(b - a, c - a))[:, None], 3, axis=1)
    given = normals_of(mesh)
    if given is None or mesh.FN is None:
        return flat
    own = _normalise(given[mesh.FN])
    return np.where((own != 0).any(axis=2, keepdims=True), own, flat)


def tangent_frames(mesh: MeshData, uv: FloatArray) -> TangentFrames:
    """Return the frames of texture coordinates (f, 3, 2), v upwards; NaN counts as 0.

    The tangents of triangles are projected to the normals, and averaged by angle among corners of one vertex that have
    one normal, one pair of texture coordinates and one side.
    """
    normal = corner_normals(mesh)
    corners, uv = mesh.V[mesh.F], np.nan_to_num(uv)
    (du1, dv1), (du2, dv2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = du1 * dv2 - dv1 * du2
    side = np.where(area < 0, -1.0, 1.0)
    along = (first * dv2[:, None] - second * dv1[:, None]) * side[:, None]
    # Without texture coordinates, any tangent serves.
    along[area == 0] = first[area == 0]
    tangent = _reject(along[:, None], normal)
    angle: FloatArray = np.empty(mesh.F.shape)
    for i in range(3):
        one, other = (_reject(corners[:, (i + j) % 3] - corners[:, i], normal[:, i]) for j in (1, 2))
        angle[:, i] = np.arccos(np.clip((one * other).sum(axis=1), -1, 1))
    keys = np.concatenate([uv, normal, np.repeat(side[:, None, None], 3, axis=1)], axis=2).reshape(mesh.F.size, -1)
    keys = np.column_stack([mesh.F.ravel(), (keys + 0.0).view(np.int64)])
    group = _number_rows(keys)
    weighted = (tangent * angle[:, :, None]).reshape(-1, 3)
    total: FloatArray = np.stack([np.bincount(group, weighted[:, i]) for i in range(3)], axis=1)
    smooth = _reject(total[group].reshape(tangent.shape), normal)
    return TangentFrames(normal, np.where((smooth != 0).any(axis=2, keepdims=True), smooth, tangent), side)


def _number_rows(keys: IntArray) -> IntArray:
    """Return a number for each row of integers (k, d), equal for equal rows."""
    order = np.lexsort(keys.T)
    new = np.concatenate([[True], (np.diff(keys[order], axis=0) != 0).any(axis=1)])
    number = np.empty(len(keys), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return number


def _reject(vectors: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the unit vectors of the parts of vectors (..., 3) that are orthogonal to unit normals."""
    return _normalise(vectors - (vectors * normal).sum(axis=-1, keepdims=True) * normal)


def _normalise(vectors: FloatArray) -> FloatArray:
    """Return unit vectors (..., 3); zero for zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
