"""Boundary vertices that slide along flat parts of the boundary of a tetrahedral mesh.

A vertex keeps the boundary in shape if it moves only along directions that lie in the planes of all boundary triangles
around it: two directions on a plane, one on an edge between planes, none at a corner or on a curved surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import FloatArray, IntArray, check_finite, real_array

# Largest sine of the angle between a triangle and a plane, and largest distance from it relative to the mesh's extent.
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Sliding:
    """Vertices that slide (k,), ascending, and the projections (k, 3, 3) to their directions."""

    vertices: IntArray
    projections: FloatArray

    def restrict(self, free: IntArray) -> FloatArray | None:
        """Return the projections (m, 3, 3) of free vertices (m,), ascending; None if no vertex slides."""
        if not self.vertices.size:
            return None
        P = np.broadcast_to(np.eye(3), (free.size, 3, 3)).copy()
        P[np.searchsorted(free, self.vertices)] = self.projections
        return P


#: No vertex slides.
NO_SLIDING = Sliding(np.empty(0, dtype=np.int64), np.empty((0, 3, 3)))


def find_sliding(F: IntArray, X: FloatArray, moved: IntArray, slide: bool | ArrayLike) -> Sliding:
    """Return the vertices of boundary triangles F (f, 3) that can slide, without those that are ``moved``.

    ``slide`` is True for all flat parts of the boundary, or the planes (m, 4) of those parts: ``(a, b, c, d)`` has the
    points with ``a x + b y + c z = d``. A vertex between a named and another part is fixed.
    ValueError if a plane has no direction or contains no boundary triangle.
    """
    everywhere = isinstance(slide, bool | np.bool_)
    if everywhere and not slide:
        return NO_SLIDING
    used = np.unique(F)
    centre = X[used].mean(axis=0)
    with np.errstate(all="ignore"):
        extent = np.abs(X[used] - centre).max()
        P = (X - centre) / extent
        a, b, c = P[F].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
    # Triangles without area restrict nothing.
    normals[~np.isfinite(normals).all(axis=1)] = 0.0
    if not everywhere:
        normals, named = _snap_to_planes(slide, F, P, normals, centre, extent)
        used = np.setdiff1d(used, F[~named])
    vertices = np.setdiff1d(used, moved)
    number = np.full(len(X), -1)
    number[vertices] = np.arange(vertices.size)
    squares = np.zeros((vertices.size, 3, 3))
    for corner in number[F].T:
        inside = corner >= 0
        np.add.at(squares, corner[inside], normals[inside, :, None] * normals[inside, None, :])
    values, directions = np.linalg.eigh(squares)
    # Directions across which no triangle leans.
    directions *= (values < _TOLERANCE**2)[:, None, :]
    free = directions.any(axis=(1, 2)) & (values[:, -1] > 0)
    directions = directions[free]
    return Sliding(vertices[free], directions @ directions.transpose(0, 2, 1))


def _snap_to_planes(
    slide: ArrayLike, F: IntArray, P: FloatArray, normals: FloatArray, centre: FloatArray, extent: float
) -> tuple[FloatArray, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Return the normals with those of planes where triangles lie on one, and which triangles do."""
    planes = real_array("slide", slide)
    if planes.ndim != 2 or planes.shape[1] != 4:
        raise ValueError(f"slide must be a bool or planes of shape (m, 4), not of shape {planes.shape}")
    check_finite("slide", "plane", "planes", planes)
    named = np.zeros(len(F), dtype=np.bool_)
    normals = normals.copy()
    for k, plane in enumerate(planes):
        length = np.linalg.norm(plane[:3])
        if not length > 0:
            raise ValueError(f"slide has no direction in plane {k}: {plane.tolist()}")
        normal = plane[:3] / length
        distance = P @ normal - (plane[3] / length - centre @ normal) / extent
        on = (np.abs(distance) <= _TOLERANCE)[F].all(axis=1)
        if not on.any():
            raise ValueError(f"slide has plane {k}, {plane.tolist()}, but no boundary triangle lies on it")
        normals[on] = normal
        named |= on
    return normals, named
