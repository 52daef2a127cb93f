"""Boundary vertices that slide along flat parts of the boundary of a tetrahedral mesh.

A vertex keeps the boundary in shape if it moves only along directions that lie in the planes of all boundary triangles
around it: two directions on a plane, one on an edge between planes, none at a corner or on a curved surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, check_finite, invert_indices, real_array

# Largest distance of a vertex from a plane, relative to the extent of the mesh.
_TOLERANCE = 1e-6
# Least cosine between a triangle on a named plane and this plane.
_PARALLEL = 0.9


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


def project(projections: FloatArray | None, x: FloatArray) -> FloatArray:
    """Project directions (k, 3) to those in which the vertices move; None restricts nothing."""
    return x if projections is None else np.asarray(np.einsum("iab,ib->ia", projections, x))


def find_sliding(F: IntArray, X: FloatArray, moved: IntArray, slide: bool | ArrayLike) -> Sliding:
    """Return the vertices of boundary triangles F (f, 3) that can slide, without those that are ``moved``.

    ``slide`` is True for all flat parts of the boundary, or the planes (m, 4) of those parts: ``(a, b, c, d)`` has the
    points with ``a x + b y + c z = d``. A vertex between a named and another part is fixed. A part counts as flat if
    rounding to single precision, or a millionth of the extent, explains its distance from a plane.
    ValueError if a plane has no direction or contains no boundary triangle.
    """
    everywhere = isinstance(slide, bool | np.bool_)
    if everywhere and not slide:
        return NO_SLIDING
    used = np.unique(F)
    centre = X[used].mean(axis=0)
    extent = np.abs(X[used] - centre).max()
    P = (X - centre) / extent
    a, b, c = P[F].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    longest = np.sqrt(np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    area = np.linalg.norm(normals, axis=1)
    # Triangles without area restrict nothing.
    normals = np.divide(normals, area[:, None], out=np.zeros_like(normals), where=area[:, None] > 0)
    height = np.divide(area, longest, out=np.zeros_like(area), where=longest > 0)
    rounding = _resolution(X[used]) / extent
    if not everywhere:
        normals, named = _snap_to_planes(slide, F, P, normals, (centre, extent, rounding))
        used = np.setdiff1d(used, F[~named])
    vertices = np.setdiff1d(used, moved)
    number = invert_indices(len(X), vertices)
    # A unit step along a direction leaves the plane of a triangle by at most this, relative to its height.
    leaning = normals * height[:, None]
    squares = np.zeros((vertices.size, 3, 3))
    for corner in number[F].T:
        inside = corner >= 0
        np.add.at(squares, corner[inside], leaning[inside, :, None] * leaning[inside, None, :])
    values, directions = np.linalg.eigh(squares)
    # Directions across which no triangle leans.
    directions *= (values < (_TOLERANCE + rounding) ** 2)[:, None, :]
    free = directions.any(axis=(1, 2)) & (values[:, -1] > 0)
    directions = directions[free]
    return Sliding(vertices[free], directions @ directions.transpose(0, 2, 1))


def _resolution(X: FloatArray) -> float:
    """The distance by which coordinates may be rounded: that of single precision if all of them have it."""
    with np.errstate(over="ignore", under="ignore"):
        single = bool((X.astype(np.float32) == X).all())
    return 4 * float(np.abs(X).max()) * float(np.finfo(np.float32 if single else np.float64).eps)


def _snap_to_planes(
    slide: ArrayLike, F: IntArray, P: FloatArray, normals: FloatArray, frame: tuple[FloatArray, float, float]
) -> tuple[FloatArray, BoolArray]:
    """Return the normals with those of planes where triangles lie on one, and which triangles do.

    ``P`` (n, 3) are positions relative to the centre and the extent of the mesh; ``frame`` has both, and the rounding.
    """
    planes = real_array("slide", slide)
    if planes.ndim != 2 or planes.shape[1] != 4:
        raise ValueError(f"slide must be a bool or planes of shape (m, 4), not of shape {planes.shape}")
    check_finite("slide", "plane", "planes", planes)
    centre, extent, rounding = frame
    named = np.zeros(len(F), dtype=np.bool_)
    normals = normals.copy()
    for k, plane in enumerate(planes):
        size = np.abs(plane[:3]).max()
        if not size > 0:
            raise ValueError(f"slide has no direction in plane {k}: {plane.tolist()}")
        length = np.linalg.norm(plane[:3] / size)
        normal = plane[:3] / size / length
        height = P @ normal
        distance = height - (plane[3] / size / length - centre @ normal) / extent
        # Of a thin body only one side lies on the plane.
        near = np.abs(distance) <= _TOLERANCE * np.ptp(height[F]) + rounding
        parallel = (np.abs(normals @ normal) > _PARALLEL) | ~normals.any(axis=1)
        on = near[F].all(axis=1) & parallel
        if not on.any():
            raise ValueError(f"slide has plane {k}, {plane.tolist()}, but no boundary triangle lies on it")
        normals[on] = normal
        named |= on
    return normals, named
