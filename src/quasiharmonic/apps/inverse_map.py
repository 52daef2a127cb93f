"""The inverse of a map, from the plane to the surface.

A map of a surface into the plane that is bijective onto its image has an inverse. `InverseMap` finds the triangle that
contains a point of the plane, and the point's barycentric coordinates. From these it computes positions, normals or any
values given on the surface. It also maps points of the surface to the plane.

Whether a triangle contains a point is decided exactly for the stored coordinates. A point that rounding has moved out
of the image is outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.curves.arcs import nearest_segment
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.exact.point_location import PointLocator
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.accepts_mesh import init_accepts_mesh
from quasiharmonic.io.objects import MeshLike
from quasiharmonic.problem.certification import certify
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    ReadOnly,
    check_bool,
    check_choice,
    check_finite,
    check_integer,
    check_range,
    index_array,
    list_others,
    real_array,
    scale_to_unit,
    vertex_array,
)

#: The elements that values on a surface belong to.
Per = Literal["vertex", "corner", "triangle"]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on a triangulated surface.

    Attributes
    ----------
    triangle : (...) int64
        Triangle that contains each point; -1 if there is no point.
    barycentric : (..., 3) float64
        Barycentric coordinates: weights of the triangle's corners that sum to 1. NaN if there is no point.

    See Also
    --------
    InverseMap : Its method `locate` returns them.

    Examples
    --------
    >>> from quasiharmonic import InverseMap
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> at = InverseMap(V, F, V).locate([[0.75, 0.25], [2.0, 0.0]])
    >>> at.found.tolist(), int(at.triangle[1])
    ([True, False], -1)
    """

    triangle: IntArray
    barycentric: FloatArray

    @property
    def found(self) -> NDArray[np.bool_]:
        """Which points exist; (...) bool."""
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
        The map. Every triangle must be strictly positive, and the map bijective.
    overlapping : bool
        Accept maps that overlap themselves and meshes whose boundary is not made of simple loops, if every triangle
        is positive. If several triangles contain a point, `locate` returns the one with the smallest index.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype, or the map is not bijective (with ``overlapping``: not injective);
        the message names the elements.

    Attributes
    ----------
    V, F, uv : arrays
        As given, as float64 and int64.
    certificate : Certificate
        The exact certificate of the map.

    See Also
    --------
    SurfaceMap : The map between two surfaces.
    results.ChartInverse : The inverse of texture coordinates with seams.

    Notes
    -----
    Building takes time proportional to the number of triangles. The time of a query depends little on the number
    and the sizes of the triangles. For a point on an edge or at a vertex, the triangle of the smallest index is
    found, and the weights of the other corners are exactly zero.

    The accuracy of positions depends on the map. Doubles resolve the plane to u·max|uv|, with u = 2⁻⁵³. If the map
    shrinks lengths by σ₂ (`quasiharmonic.Distortion.sigma2`), this is 1/σ₂ times as much on the surface. So a point
    that is mapped to the plane and back returns to within about 10·u·max|uv|/σ₂ of its position. Relative to the
    surface's size this is 10⁻¹⁵ without shrinking, and 10⁻⁹ or more if triangles shrink by a factor of a million.
    To keep points of the surface exactly, keep their `SurfacePoints`.

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
        check_bool("overlapping", overlapping)
        certificate = certify(F, uv)
        _check(certificate, overlapping)
        self.certificate: Certificate = certificate
        self.V = vertex_array(V, finite=False)
        self.F, self.uv = certificate.F, certificate.uv
        if len(self.V) != len(self.uv):
            raise ValueError(f"V must have as many rows as uv, {len(self.uv)}, not {len(self.V)}")
        check_finite("V", "vertex", "vertices", self.V[np.unique(self.F)])
        self._seal()
        self._locator = PointLocator(self.uv[self.F])
        # The triangles of the locator, by rows of the map, and those of the surface: the same, except at seams.
        self._located, self._rows = self.F, self.F

    def _read_only(self) -> tuple[FloatArray | IntArray, ...]:
        return self.V, self.F, self.uv

    def locate(self, points: ArrayLike) -> SurfacePoints:
        """Find the points of the surface at positions in the plane.

        Parameters
        ----------
        points : (..., 2) array
            Positions; any real dtype, converted to float64. ValueError for another last axis.

        Returns
        -------
        SurfacePoints
            Triangle -1 for positions outside the image and for positions that are not finite.
        """
        positions = real_array("points", points)
        if positions.ndim < 1 or positions.shape[-1] != 2:
            raise ValueError(f"points must have shape (..., 2), not {positions.shape}")
        rows = positions.reshape(-1, 2)
        triangle = self._locator.find(rows)
        barycentric = np.full((len(rows), 3), np.nan)
        found = np.flatnonzero(triangle >= 0)
        barycentric[found] = self._locator.barycentric(rows[found], triangle[found])
        triangle[found], barycentric[found] = self._number(triangle[found], barycentric[found])
        shape = positions.shape[:-1]
        return SurfacePoints(triangle.reshape(shape), barycentric.reshape(*shape, 3))

    def nearest(self, points: ArrayLike, at: SurfacePoints | None = None) -> SurfacePoints:
        """Find the points of the surface nearest to positions in the plane.

        Parameters
        ----------
        points : (..., 2) array
            Positions, inside or outside the image; as for `locate`.
        at : SurfacePoints, optional
            The result of `locate` for them, if known.

        Returns
        -------
        SurfacePoints
            The points found by `locate`; for positions outside the image, the nearest point of its boundary, up to
            rounding. Triangle -1 only for positions that are not finite.
        """
        at = self.locate(points) if at is None else at
        positions = np.asarray(points, dtype=np.float64)
        lost = np.flatnonzero(~at.found.ravel() & np.isfinite(positions).all(axis=-1).ravel())
        if not lost.size:
            return at
        edges = boundary_edges(self._located, len(self.uv))
        # Scaled, so that squared lengths stay within the range of doubles.
        size = np.abs(self.uv[edges]).max()
        row, share = nearest_segment(positions.reshape(-1, 2)[lost] / size, *(self.uv[edges] / size).swapaxes(0, 1))
        triangle, barycentric = at.triangle.copy().ravel(), at.barycentric.copy().reshape(-1, 3)
        which, corner = self._edge_triangles(edges)
        weights = np.zeros((len(lost), 3))
        weights[np.arange(len(lost)), corner[row]] = 1 - share
        weights[np.arange(len(lost)), (corner[row] + 1) % 3] = share
        triangle[lost], barycentric[lost] = self._number(which[row], weights)
        return SurfacePoints(triangle.reshape(at.triangle.shape), barycentric.reshape(at.barycentric.shape))

    def _edge_triangles(self, edges: IntArray) -> tuple[IntArray, IntArray]:
        """The triangle of each boundary edge, and the corner at which the edge starts."""
        n = len(self.uv)
        keys = (self._located * n + self._located[:, (1, 2, 0)]).ravel()
        order = np.argsort(keys)
        found = order[np.searchsorted(keys[order], edges[:, 0] * n + edges[:, 1])]
        return found // 3, found % 3

    def _number(self, triangle: IntArray, barycentric: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return points in triangles of the locator as points of the surface."""
        return triangle, barycentric

    def vertices(self) -> SurfacePoints:
        """Return the vertices as points of the surface; triangle -1 for vertices without triangles."""
        triangle = np.full(len(self.V), -1, dtype=np.int64)
        barycentric = np.full((len(self.V), 3), np.nan)
        vertex, first = np.unique(self.F, return_index=True)
        triangle[vertex], corner = np.divmod(first, 3)
        barycentric[vertex] = np.eye(3)[corner]
        return SurfacePoints(triangle, barycentric)

    def plane(self, at: SurfacePoints) -> FloatArray:
        """Map points of the surface, of any shape, to the plane: (..., 2) float64, NaN if there is no triangle.

        The result is clipped to the bounding box of each triangle, so points on a side along an axis stay on it. Raises
        ValueError as `values`.
        """
        positions = self.values(at, self.uv[self._rows], per="corner")
        corners = self.uv[self._rows[np.asarray(at.triangle)]]
        return np.clip(positions, corners.min(axis=-2), corners.max(axis=-2))

    def surface(self, at: SurfacePoints) -> FloatArray:
        """Return the positions (..., 3) float64 of points of the surface, in the units of ``V``.

        The shape is (..., 2) if ``V`` is planar. Positions are NaN if there is no triangle. Raises ValueError as
        `values`.
        """
        return self.values(at, self.V)

    def normals(self, at: SurfacePoints) -> FloatArray:
        """Return the unit normals (..., 3) float64 of triangles, on the side on which they are counterclockwise.

        They are NaN if there is no triangle. Raises ValueError if the surface is planar. For smooth normals,
        interpolate vertex normals with `values`.
        """
        return self.values(at, self._normals, per="triangle")

    def values(self, at: SurfacePoints, values: ArrayLike, *, per: Per = "vertex", nearest: bool = False) -> FloatArray:
        """Interpolate values at points of the surface.

        Parameters
        ----------
        at : SurfacePoints
        values : (n, ...), (f, 3, ...) or (f, ...) array
            Values of any shape, for every vertex, every corner of every triangle, or every triangle. Values at corners
            may be discontinuous across edges.
        per : {"vertex", "corner", "triangle"}
            The elements that the values belong to.
        nearest : bool
            Instead of interpolating, take the value of the corner with the largest barycentric coordinate: for labels.

        Returns
        -------
        (..., ...) float64
            Interpolated linearly on each triangle, or the value of the nearest corner or of the triangle. NaN if there
            is no point.

        Raises
        ------
        ValueError
            If a shape does not match, or ``at`` refers to a triangle out of range.
        """
        # Points per block, so that the arrays fit into the cache.
        points_per_block = 1 << 14
        check_choice("per", per, get_args(Per))
        check_bool("nearest", nearest)
        given = real_array("values", values)
        expected = {"vertex": (len(self.V),), "corner": (len(self.F), 3), "triangle": (len(self.F),)}[per]
        if given.shape[: len(expected)] != expected:
            raise ValueError(f"values per {per} must have a shape that begins with {expected}, not {given.shape}")
        triangle = index_array("at.triangle", at.triangle)
        check_range("at", triangle, len(self.F), "triangle", "triangles", minimum=-1)
        barycentric = real_array("at.barycentric", at.barycentric)
        if barycentric.shape != (*triangle.shape, 3):
            raise ValueError(f"at.barycentric must have shape {(*triangle.shape, 3)}, not {barycentric.shape}")
        tail = given.shape[len(expected) :]
        found = np.flatnonzero(triangle.ravel() >= 0)
        t = triangle.ravel()[found]
        out = np.full((triangle.size, *tail), np.nan)
        if per == "triangle":
            out[found] = given[t]
            return out.reshape(*triangle.shape, *tail)
        barycentric = barycentric.reshape(-1, 3)
        if nearest:
            corner = barycentric[found].argmax(axis=1)
            out[found] = given[self.F[t, corner]] if per == "vertex" else given[t, corner]
        else:
            for start in range(0, t.size, points_per_block):
                which, here = found[start : start + points_per_block], t[start : start + points_per_block]
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
            Number of points along u and v, at least 2 each.
        box : (4,) float, optional
            Minimum u and v, then maximum u and v of the grid; the bounding box of the image by default.

        Returns
        -------
        u : (columns,) float64
        v : (rows,) float64
        at : SurfacePoints
            Of shape (columns, rows): ``at.triangle[i, j]`` is at ``(u[i], v[j])``.

        Raises
        ------
        ValueError
            If ``columns`` or ``rows`` is not an integer of at least 2, or ``box`` is invalid.
        """
        check_integer("columns", columns, minimum=2)
        check_integer("rows", rows, minimum=2)
        if box is None:
            corners = self.uv[self.F]
            box = (*corners.min(axis=(0, 1)).tolist(), *corners.max(axis=(0, 1)).tolist())
        ends = real_array("box", box)
        if ends.shape != (4,) or not np.isfinite(ends).all() or (ends[:2] > ends[2:]).any():
            raise ValueError(f"box must be finite: minimum u and v, then maximum u and v, not {box}")
        # The extent of a box may overflow, that of half the box does not.
        low, high = ends[:2] / 2, ends[2:] / 2
        u, v = 2 * np.linspace(low[0], high[0], columns), 2 * np.linspace(low[1], high[1], rows)
        return u, v, self.locate(np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1))

    @cached_property
    def _normals(self) -> FloatArray:
        """Unit normal of every triangle; (f, 3)."""
        if self.V.shape[1] == 2:
            raise ValueError("a planar surface has no normals: V has shape (n, 2)")
        a, b, c = scale_to_unit(self.V[self.F]).swapaxes(0, 1)
        normal = np.cross(b - a, c - a)
        with np.errstate(invalid="ignore"):
            return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _check(certificate: Certificate, overlapping: bool) -> None:
    """Raise ValueError if the map has no inverse."""
    if not certificate.injective:
        raise ValueError(f"this map has no inverse. {certificate.summary()} Repair it first (repair; qhm repair).")
    if not (certificate.bijective or overlapping):
        raise ValueError(
            f"this map has no inverse. {certificate.summary()} "
            "With overlapping=True, each point is located in the triangle with the smallest index."
        )


class ChartInverse(InverseMap):
    """The inverse of texture coordinates with seams, as `quasiharmonic.UnwrapResult.inverse` makes it.

    All methods are those of `InverseMap`. Points and values belong to the vertices and triangles of the model. Normals
    are on the side on which the triangles of the model are counterclockwise.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64
        The model.
    uv : (m, 2) float64
        Texture coordinates.
    FT : (f, 3) int64
        Row of ``uv`` of each corner. Triangles may be reversed in the plane.
    leave_out : (k,) int64
        Triangles without an inverse.

    Attributes
    ----------
    V, F, uv, FT : arrays
        As given.
    certificate : Certificate
        The exact certificate of the triangles that are not left out, turned to be counterclockwise.

    See Also
    --------
    InverseMap : The inverse of a map without seams.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> result = unwrap(*starfish(3, 4))
    >>> corner = result.uvs[result.indices[0]].mean(axis=0)
    >>> int(result.inverse().locate(corner).triangle)
    0
    """

    def __init__(self, V: FloatArray, F: IntArray, uv: FloatArray, FT: IntArray, *, leave_out: IntArray) -> None:
        self._triangles = list_others(len(F), leave_out)
        rows = FT[self._triangles]
        self._turned = orientation(*uv[rows].swapaxes(0, 1)) < 0
        rows[self._turned] = rows[self._turned][:, (0, 2, 1)]
        self.FT = FT.copy()
        # A position of the model for each row.
        vertex = np.zeros(len(uv), dtype=np.int64)
        vertex[FT] = F
        super().__init__(V[vertex], rows, uv, overlapping=True)
        self.V, self.F = V.copy(), F
        self._seal()
        self._located, self._rows = rows, self.FT

    def _read_only(self) -> tuple[FloatArray | IntArray, ...]:
        return *super()._read_only(), self.FT

    def _number(self, triangle: IntArray, barycentric: FloatArray) -> tuple[IntArray, FloatArray]:
        turned = self._turned[triangle]
        return self._triangles[triangle], np.where(turned[:, None], barycentric[:, (0, 2, 1)], barycentric)
