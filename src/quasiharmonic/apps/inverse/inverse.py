"""From the plane back to the surface.

A map φ of a surface into the plane that is bijective onto its image has an inverse. `InverseMap` finds, for points
of the plane, the triangle that each lies in and its barycentric coordinates there, and with them positions,
normals or any values given on the surface; and the other way round.

Which triangle contains a point, if any, is decided exactly for the coordinates as stored: no point of the closed
image is declared outside, and none outside is declared in it. Points that rounding has put beside the boundary are
outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.geometry.exact.point_location import PointLocator
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.adapters.accepts_mesh import init_accepts_mesh
from quasiharmonic.io.adapters.objects import MeshLike
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    ReadOnly,
    check_choice,
    check_range,
    index_array,
    real_array,
    true_or_false,
    vertex_array,
)

# Points handled at a time: what is in work stays in the cache. And pairs of a point and an edge.
_POINTS, _PAIRS = 1 << 14, 1 << 20

#: What values on a surface can be given for.
Per = Literal["vertex", "corner", "triangle"]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on a triangulated surface.

    Attributes
    ----------
    triangle : (...) int64
        The triangle that each point lies in; -1 where there is no point.
    barycentric : (..., 3) float64
        Its barycentric coordinates: weights of the triangle's corners that add up to 1. NaN where there is none.
    """

    triangle: IntArray
    barycentric: FloatArray

    @property
    def found(self) -> NDArray[np.bool_]:
        """Where there is a point; (...) bool."""
        return self.triangle >= 0


class InverseMap(ReadOnly):
    """The inverse of a bijective map of a surface into the plane.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        The surface.
    F : (f, 3) array of int
        Triangles.
    uv : (n, 2) array
        Its map: every triangle strictly positive, no place covered twice.
    overlapping : bool
        Accept a map that covers places twice, or a mesh whose boundary is not simple loops, as long as every
        triangle is positive. Of the several points that then lie at one place, the one in the triangle of the
        smallest index is meant.

    Raises
    ------
    ValueError
        When an array has the wrong shape or dtype, or the map is not bijective (or, with ``overlapping``, not
        injective); the message names the elements.

    Attributes
    ----------
    V, F, uv : arrays
        As given, as float64 and int64.
    certificate : Certificate
        The exact verdict on the map.

    Notes
    -----
    Building takes time in proportion to the number of triangles, a query nearly the same time for each point
    however many triangles there are and however much their sizes differ. On an edge or at a vertex, which belong to
    several triangles, the one of the smallest index is found, and the weights of the other corners are zero
    exactly.

    How exact positions are is a matter of the map. Doubles tell places of the plane apart down to u·max|uv|, with
    u = 2⁻⁵³, and where the map shrinks lengths to σ₂ (`quasiharmonic.Distortion.sigma2`) that much in the plane is
    1/σ₂ times as much on the surface. So a point that goes to the plane and back returns to within about
    10·u·max|uv|/σ₂ of where it was: 10⁻¹⁵ of the surface's size where nothing is shrunk, 10⁻⁹ and worse where a map
    into a letter squeezes triangles a millionfold. No arithmetic mends that after the place has been rounded; keep
    the `SurfacePoints` where points of the surface are wanted exactly.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic.surfaces import grid
    >>> uv, F = grid(4, 4)
    >>> V = np.column_stack([uv, uv[:, 0] * uv[:, 1]])
    >>> inverse = InverseMap(V, F, uv)
    >>> at = inverse.locate([[0.5, 0.25], [1.0, 0.6], [1.1, 0.6]])
    >>> at.found
    array([ True,  True, False])
    >>> inverse.surface(at)
    array([[0.5  , 0.25 , 0.125],
           [1.   , 0.6  , 0.6  ],
           [  nan,   nan,   nan]])
    """

    @overload
    def __init__(self, V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, overlapping: bool = False) -> None: ...
    @overload
    def __init__(self, V: MeshLike, uv: ArrayLike, *, overlapping: bool = False) -> None: ...
    @init_accepts_mesh
    def __init__(self, V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, overlapping: bool = False) -> None:
        true_or_false("overlapping", overlapping)
        certificate = certify(F, uv)
        _check(certificate, overlapping)
        self.certificate: Certificate = certificate
        self.V = vertex_array(V, finite=False)
        self.F, self.uv = certificate.F, certificate.uv
        if len(self.V) != len(self.uv):
            raise ValueError(f"V must have as many rows as uv, {len(self.uv)}, not {len(self.V)}")
        self._seal()
        self._locator = PointLocator(self.uv[self.F])

    def _read_only(self) -> tuple[FloatArray, IntArray, FloatArray]:
        return self.V, self.F, self.uv

    def locate(self, points: ArrayLike) -> SurfacePoints:
        """The points of the surface that lie at places of the plane.

        Parameters
        ----------
        points : (..., 2) array
            Places; any real dtype, taken as float64.

        Returns
        -------
        SurfacePoints
            Triangle -1 outside of the map's image, and for places that are not finite.

        Raises
        ------
        ValueError
            When the last axis is not of length 2.
        """
        places = np.array(points, dtype=np.float64)
        if places.ndim < 1 or places.shape[-1] != 2:
            raise ValueError(f"points must have shape (..., 2), not {places.shape}")
        rows = places.reshape(-1, 2)
        triangle = self._locator.find(rows)
        barycentric = np.full((len(rows), 3), np.nan)
        found = np.flatnonzero(triangle >= 0)
        barycentric[found] = self._locator.barycentric(rows[found], triangle[found])
        shape = places.shape[:-1]
        return SurfacePoints(triangle.reshape(shape), barycentric.reshape(*shape, 3))

    def nearest(self, points: ArrayLike, at: SurfacePoints | None = None) -> SurfacePoints:
        """The points of the surface that lie nearest to places of the plane.

        Parameters
        ----------
        points : (..., 2) array
            Places, in the map's image or not.
        at : SurfacePoints, optional
            What `locate` says of them, if it has been asked.

        Returns
        -------
        SurfacePoints
            Those of `locate` where it finds one, and else the nearest point of the image's boundary, up to rounding;
            triangle -1 only for places that are not finite.

        Raises
        ------
        ValueError
            When the last axis is not of length 2.
        """
        at = self.locate(points) if at is None else at
        places = np.asarray(points, dtype=np.float64)
        lost = np.flatnonzero(~at.found.ravel() & np.isfinite(places).all(axis=-1).ravel())
        if not lost.size:
            return at
        edges = boundary_edges(self.F, len(self.uv))
        # Squares of lengths must not leave the numbers' range.
        size = np.abs(self.uv[edges]).max()
        row, share = _nearest_on(places.reshape(-1, 2)[lost] / size, *(self.uv[edges] / size).swapaxes(0, 1))
        triangle, barycentric = at.triangle.copy().ravel(), at.barycentric.copy().reshape(-1, 3)
        which, corner = self._edge_triangles(edges)
        triangle[lost] = which[row]
        barycentric[lost] = 0
        barycentric[lost, corner[row]] = 1 - share
        barycentric[lost, (corner[row] + 1) % 3] = share
        return SurfacePoints(triangle.reshape(at.triangle.shape), barycentric.reshape(at.barycentric.shape))

    def _edge_triangles(self, edges: IntArray) -> tuple[IntArray, IntArray]:
        """The triangle of each boundary edge, and the corner that the edge leaves."""
        n = len(self.uv)
        keys = (self.F * n + self.F[:, (1, 2, 0)]).ravel()
        order = np.argsort(keys)
        found = order[np.searchsorted(keys[order], edges[:, 0] * n + edges[:, 1])]
        return found // 3, found % 3

    def vertices(self) -> SurfacePoints:
        """The vertices of the surface, as points of it; none for a vertex of no triangle."""
        triangle = np.full(len(self.V), -1, dtype=np.int64)
        barycentric = np.full((len(self.V), 3), np.nan)
        vertex, first = np.unique(self.F, return_index=True)
        triangle[vertex], corner = np.divmod(first, 3)
        barycentric[vertex] = np.eye(3)[corner]
        return SurfacePoints(triangle, barycentric)

    def plane(self, at: SurfacePoints) -> FloatArray:
        """Where points of the surface lie in the plane: the map itself.

        Rounding does not take a point beyond its triangle's box, so it stays on a side along an axis.

        Parameters
        ----------
        at : SurfacePoints
            Of any shape.

        Returns
        -------
        (..., 2) float64
            NaN where there is no triangle.

        Raises
        ------
        ValueError
            When ``at`` names a triangle that is not there.
        """
        places = self.values(at, self.uv)
        corners = self.uv[self.F[np.asarray(at.triangle)]]
        return np.clip(places, corners.min(axis=-2), corners.max(axis=-2))

    def surface(self, at: SurfacePoints) -> FloatArray:
        """Positions of points of the surface.

        Parameters
        ----------
        at : SurfacePoints
            Of any shape.

        Returns
        -------
        (..., 3) float64
            In space, in the units of ``V``; (..., 2) where ``V`` is planar. NaN where there is no triangle.

        Raises
        ------
        ValueError
            When ``at`` names a triangle that is not there.
        """
        return self.values(at, self.V)

    def normals(self, at: SurfacePoints) -> FloatArray:
        """Unit normals of the triangles, on the side from which they are counterclockwise.

        For smooth normals, interpolate those of the vertices with `values`.

        Parameters
        ----------
        at : SurfacePoints
            Of any shape.

        Returns
        -------
        (..., 3) float64
            NaN where there is no triangle.

        Raises
        ------
        ValueError
            When the surface is planar.
        """
        return self.values(at, self._normals, per="triangle")

    def values(self, at: SurfacePoints, values: ArrayLike, *, per: Per = "vertex") -> FloatArray:
        """Values at points of the surface.

        Parameters
        ----------
        at : SurfacePoints
        values : (n, ...), (f, 3, ...) or (f, ...) array
            Values, of any shape, for every vertex, for the three corners of every triangle (so that they may jump
            at edges), or for every triangle.
        per : {"vertex", "corner", "triangle"}
            Which of those.

        Returns
        -------
        (..., ...) float64
            Interpolated linearly on each triangle, or the triangle's own; NaN where there is no point.

        Raises
        ------
        ValueError
            When a shape does not fit, or ``at`` names a triangle that is not there.
        """
        check_choice("per", per, get_args(Per))
        given = np.asarray(values, dtype=np.float64)
        expected = {"vertex": (len(self.V),), "corner": (len(self.F), 3), "triangle": (len(self.F),)}[per]
        if given.shape[: len(expected)] != expected:
            raise ValueError(f"values per {per} must have a shape that begins with {expected}, not {given.shape}")
        triangle = index_array("at.triangle", at.triangle)
        check_range("at", triangle, len(self.F), "triangle", "triangles", least=-1)
        barycentric = real_array("at.barycentric", at.barycentric)
        if barycentric.shape != (*triangle.shape, 3):
            raise ValueError(f"at.barycentric must have shape {(*triangle.shape, 3)}, not {barycentric.shape}")
        tail = given.shape[len(expected) :]
        found = np.flatnonzero(triangle.ravel() >= 0)
        t = triangle.ravel()[found]
        out = np.full((triangle.size, *tail), np.nan)
        if per == "triangle":
            out[found] = given[t]
        else:
            barycentric = barycentric.reshape(-1, 3)
            for start in range(0, t.size, _POINTS):
                which, here = found[start : start + _POINTS], t[start : start + _POINTS]
                weights = barycentric[which].reshape(-1, 3, *(1,) * len(tail))
                total = np.zeros((here.size, *tail))
                for i in range(3):
                    total += weights[:, i] * (given[self.F[here, i]] if per == "vertex" else given[here, i])
                out[which] = total
        return out.reshape(*triangle.shape, *tail)

    def sample_grid(
        self, columns: int, rows: int, *, box: tuple[float, float, float, float] | None = None
    ) -> tuple[FloatArray, FloatArray, SurfacePoints]:
        """Sample the surface on a regular grid of the plane.

        Parameters
        ----------
        columns, rows : int
            Points along u and v, at least 2 each.
        box : (4,) float, optional
            Least u and v, greatest u and v, the ends of the grid; by default those of the map's image.

        Returns
        -------
        u : (columns,) float64
        v : (rows,) float64
        at : SurfacePoints
            Of shape (columns, rows): ``at.triangle[i, j]`` is at ``(u[i], v[j])``.

        Raises
        ------
        ValueError
            When there are fewer than 2 points along an axis.
        """
        if columns < 2 or rows < 2:
            raise ValueError(f"a grid needs at least 2 points along each axis, not {columns} by {rows}")
        if box is None:
            corners = self.uv[self.F]
            box = (*corners.min(axis=(0, 1)).tolist(), *corners.max(axis=(0, 1)).tolist())
        u, v = np.linspace(box[0], box[2], columns), np.linspace(box[1], box[3], rows)
        return u, v, self.locate(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1))

    @cached_property
    def _normals(self) -> FloatArray:
        """Unit normal of every triangle; (f, 3)."""
        if self.V.shape[1] == 2:
            raise ValueError("a planar surface has no normals: V has shape (n, 2)")
        a, b, c = self.V[self.F].swapaxes(0, 1)
        normal = np.cross(b - a, c - a)
        with np.errstate(invalid="ignore"):
            return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _nearest_on(points: FloatArray, a: FloatArray, b: FloatArray) -> tuple[IntArray, FloatArray]:
    """Which of the segments from ``a`` to ``b`` (k, 2) is nearest to each point (m, 2), and how far along, 0 to 1."""
    row, share = np.empty(len(points), dtype=np.int64), np.empty(len(points))
    side = b - a
    length = np.einsum("ki,ki->k", side, side)
    size = max(1, _PAIRS // len(a))
    for start in range(0, len(points), size):
        here = points[start : start + size, None] - a
        along = np.clip(np.einsum("mki,ki->mk", here, side) / length, 0, 1)
        away = here - along[..., None] * side
        best = np.einsum("mki,mki->mk", away, away).argmin(axis=1)
        row[start : start + size] = best
        share[start : start + size] = along[np.arange(best.size), best]
    return row, share


def _check(certificate: Certificate, overlapping: bool) -> None:
    """Refuse a map that has no inverse."""
    if not certificate.injective:
        raise ValueError(f"this map has no inverse. {certificate.summary()}")
    if not (certificate.bijective or overlapping):
        raise ValueError(
            f"this map has no inverse. {certificate.summary()} "
            "With overlapping=True, each point is located in the triangle with the smallest index."
        )
