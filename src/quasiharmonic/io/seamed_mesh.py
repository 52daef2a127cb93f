"""Maps with seams, and the islands into which seams cut a surface.

A vertex on a seam has several positions in the plane, so triangles refer to positions by indices of their own. Two
triangles are joined along an edge if they share it on the surface and have the same positions at both of its ends,
whatever their indices. A vertex of an island is a fan of triangles joined in this way. An island is a connected
component and is always a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite
from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.mesh.splitting import fans, find_representatives, number_fans, renumber
from quasiharmonic.geometry.mesh.topology import edge_keys, find_pairs, group_by_label, pair_keys
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_offsets,
    check_range,
    check_weld,
    corner_rows,
    count_of,
    edge_names,
    index_array,
    list_others,
    map_array,
    to_complex,
    triangle_names,
    triangle_rows,
    vertex_array,
)

# The apexes of stacked triangles are at most this fraction of their shortest side apart.
_SAME = 1e-3


@dataclass(frozen=True, eq=False)
class Island:
    """A part of a map between its seams, with its own vertex numbers.

    Attributes
    ----------
    F : (k, 3) int64
        Triangles of the island, by the island's vertices.
    triangles : (k,) int64
        Their indices in the mesh, ascending.
    vertices : (m,) int64
        Index in the mesh of each vertex of the island, ascending. If a seam has the island on both sides of a vertex,
        the mesh vertex occurs several times.
    V : (m, 2) or (m, 3) float64
        Positions of the island's vertices on the surface.
    uv : (m, 2) float64
        Positions in the plane; NaN if unknown.

    See Also
    --------
    atlas.SeamedMesh : Lists its islands.

    Examples
    --------
    >>> from quasiharmonic.atlas import SeamedMesh
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> [island.triangles.tolist() for island in SeamedMesh(V, F, uv=V).cut([[1, 4], [4, 7]]).islands]
    [[0, 1, 4, 5], [2, 3, 6, 7]]
    """

    F: IntArray
    triangles: IntArray
    vertices: IntArray
    V: FloatArray
    uv: FloatArray


def find_folds(one: IntArray, other: IntArray, corner_uv: FloatArray) -> IntArray:
    """Find edges at which a triangle meets its mirror image, stacked on it.

    A part that is folded exactly onto itself, at a plane of symmetry, is a part and its mirror image.

    Parameters
    ----------
    one, other : (p,) int64
        The two sides of each edge, as returned by `find_pairs`.
    corner_uv : (f, 3, 2) float64
        Positions of the corners.

    Returns
    -------
    (k,) int64
        Ascending indices of the edges whose triangles have almost the same three positions, in opposite order.
    """
    z = to_complex(corner_uv.reshape(-1, 2))
    start, end, apex = (z[one - one % 3 + (one + step) % 3] for step in range(3))
    with np.errstate(invalid="ignore", over="ignore"):
        shortest = np.minimum(np.abs(end - start), np.minimum(np.abs(apex - start), np.abs(apex - end)))
        near = np.flatnonzero(np.abs(apex - z[other - other % 3 + (other + 2) % 3]) <= _SAME * shortest)
    first, second = (orientation_or_nonfinite(*corner_uv[side[near] // 3].swapaxes(0, 1))[0] for side in (one, other))
    folds: IntArray = near[first * second < 0]
    return folds


def which_island(triangles: IntArray) -> str:
    """Name an island in a message by its triangles (k,), ascending indices in the mesh."""
    return f"island at triangle {triangles[0]} ({count_of('triangle', 'triangles', len(triangles))})"


class SeamedMesh:
    """A surface and a map of it that may have seams.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Positions.
    F : (f, 3) array of int
        Triangles.
    FT : (f, 3) array of int, optional
        Row of ``uv`` of every corner. A triangle with a corner at -1 has no position. By default ``F``.
    uv : (m, 2) array, optional
        Positions in the plane, NaN if unknown. Leave it out for a surface that is cut but not yet mapped.

    Raises
    ------
    ValueError
        If the shapes do not fit, or a vertex or row does not exist; the message names them.

    See Also
    --------
    quasiharmonic.atlas.as_seamed_mesh : Accepts a file, or a mesh of another library.
    atlas.Island : A part between seams.
    atlas.certify : The verdict on its map.

    Attributes
    ----------
    V, F, FT, uv : arrays
        The arguments as float64 and int64; ``uv`` is None if left out. Read-only.

    Examples
    --------
    A sheet cut along its centre line:

    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> cut = SeamedMesh(V, F).cut([[1, 4], [4, 7]])
    >>> len(cut.islands), len(cut.V), cut.seams.tolist()
    (2, 9, [[1, 4], [4, 7]])
    """

    V: FloatArray
    F: IntArray
    FT: IntArray
    uv: FloatArray | None

    def __init__(self, V: ArrayLike, F: ArrayLike, FT: ArrayLike | None = None, uv: ArrayLike | None = None) -> None:
        self.V, self.F = vertex_array(V), triangle_rows(F)
        check_range("F", self.F, len(self.V))
        self.uv = None if uv is None else map_array("uv", uv, finite=False)
        rows = None if self.uv is None else len(self.uv)
        self.FT = corner_rows("FT", self.F if FT is None else FT, self.F, rows, copy=FT is not None)
        for array in (self.V, self.F, self.FT, self.uv):
            if array is not None:
                array.flags.writeable = False

    @cached_property
    def _welded(self) -> IntArray:
        """Number of the (vertex, position) pair at every corner of the mapped triangles, from 0; (g, 3) int64.

        At folds, corners of the two triangles have different numbers.
        """
        if self.uv is None:
            place: IntArray = np.arange(int(self.FT.max(initial=-1)) + 1)
        else:
            # Equal coordinates are one position. All NaN positions also count as one.
            with np.errstate(invalid="ignore"):  # a signalling NaN
                pairs = np.ascontiguousarray(self.uv + 0.0).view(np.complex128).ravel()
            place = np.unique(pairs, return_inverse=True)[1].ravel()
        corners = self.F[self.mapped] * max(len(place), 1) + place[self.FT[self.mapped]]
        welded = np.unique(corners, return_inverse=True)[1].reshape(-1, 3)
        if self.uv is None:
            return welded
        sign = triangle_signs(self.FT[self.mapped], self.uv)[0]
        if sign.min(initial=1) >= 0 or sign.max(initial=-1) <= 0:
            return welded
        one, other = find_pairs(welded)
        folds = find_folds(one, other, self.uv.take(self.FT[self.mapped], axis=0))
        if not folds.size:
            return welded
        joined = list_others(len(one), folds)
        return fans(welded, pairs=(one[joined], other[joined]))[0]

    @cached_property
    def mapped(self) -> IntArray:
        """Ascending indices of the triangles that have positions; (g,) int64."""
        return np.flatnonzero((self.FT >= 0).all(axis=1))

    @cached_property
    def seamless(self) -> bool:
        """Whether every triangle has positions and no vertex has more than one position."""
        if len(self.mapped) < len(self.F):
            return False
        return bool(self._welded.max(initial=-1) + 1 == np.count_nonzero(np.bincount(self.F.ravel())))

    @cached_property
    def islands(self) -> tuple[Island, ...]:
        """The parts into which the seams cut the surface, ordered by their first triangle.

        Edges of three or more triangles, or of two triangles with opposite orientation, count as seams. So do edges of
        a triangle and its mirror image that is stacked on it.
        """
        places = np.full((int(self.FT.max(initial=-1)) + 1, 2), np.nan) if self.uv is None else self.uv
        split, island = fans(self._welded)
        found = []
        for rows in group_by_label(island):
            triangles = self.mapped[rows]
            of_mesh, at = self.F[triangles].ravel(), self.FT[triangles].ravel()
            own, first = renumber(split[rows], self.F[triangles])
            found.append(Island(own, triangles, of_mesh[first], self.V[of_mesh[first]], places[at[first]]))
        return tuple(found)

    @property
    def seams(self) -> IntArray:
        """Seam edges (k, 2), by vertices, ascending: triangles meet here on the surface and not in the plane."""
        count, owner = self._owner()
        tail, head = self.F, self.F[:, (1, 2, 0)]
        here, there = owner, owner[:, (1, 2, 0)]
        upwards = tail < head
        # Find edges whose ends have different positions in two of their triangles.
        places = np.where(upwards, here, there) * (count + 1) + np.where(upwards, there, here)
        key = edge_keys(tail, head, len(self.V)).ravel()
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        sides = places.ravel()[order]
        apart = (
            np.minimum.reduceat(sides, as_offsets(first)) < np.maximum.reduceat(sides, as_offsets(first))
            if first.size
            else first > 0
        )
        at = order[first[apart]]
        ends = np.stack([tail.ravel()[at], head.ravel()[at]], axis=1)
        return np.unique(np.sort(ends, axis=1), axis=0)

    def opened(self) -> SeamedMesh:
        """Return the same map as a mesh without seams, with one vertex for each position of a vertex.

        Returns
        -------
        SeamedMesh
            The vertices of this mesh come first, then one copy for each further position. The triangles keep their
            order. A mesh without seams is unchanged. Positions of vertices that no triangle uses are NaN.

        Raises
        ------
        ValueError
            If a triangle has no position; the message names the first ones.
        """
        bare = np.flatnonzero((self.FT < 0).any(axis=1))
        if bare.size:
            raise ValueError(f"{triangle_names(bare)} without texture coordinates, which other triangles have")
        if self.seamless:
            FT, origin = self.F, np.arange(len(self.V))
        else:
            FT, origin = self._number_fans()
        uv = None
        if self.uv is not None:
            uv = np.full((len(origin), 2), np.nan)
            uv[FT] = self.uv[self.FT]
        return SeamedMesh(self.V[origin], FT, FT, uv)

    def weld(self, weld: bool | float) -> SeamedMesh:
        """Return the mesh with close vertices welded: its triangles refer to their representatives.

        Corners at different positions in the plane stay apart, so seams stay seams.

        Parameters
        ----------
        weld : bool or float
            Whether to weld vertices at equal positions, or a distance relative to the diagonal of the bounding box
            within which vertices are welded; see `clean`.

        Returns
        -------
        SeamedMesh
            Mesh with the same ``V``, ``uv`` and, if it has a map, ``FT``. The mesh itself if no vertices are welded.

        Raises
        ------
        ValueError
            If ``weld`` is negative or not finite, or the mesh is cut and has no map.
        """
        check_weld(weld)
        F = find_representatives(self.V, self.F, weld)[self.F]
        if np.array_equal(F, self.F):
            return self
        if self.uv is None and not np.array_equal(self.F, self.FT):
            raise ValueError("the mesh is cut and has no map, so its cuts are unknown after welding: weld it first")
        return SeamedMesh(self.V, F, F if self.uv is None else self.FT, self.uv)

    def cut(self, edges: ArrayLike) -> SeamedMesh:
        """Return the mesh with further edges cut, without positions.

        Parameters
        ----------
        edges : (k, 2) array of int
            The two vertices of each edge.

        Returns
        -------
        SeamedMesh
            Mesh with the same ``V`` and ``F``, without ``uv``. Rows have the numbers of the vertices; copies of cut
            vertices follow.

        Raises
        ------
        ValueError
            If the mesh does not have one of the edges; the message names the first ones.
        """
        pairs = index_array("edges", edges).reshape(-1, 2)
        check_range("edges", pairs, len(self.V))
        sides = edge_keys(self.F, self.F[:, (1, 2, 0)], len(self.V))
        wanted = pair_keys(pairs, len(self.V))
        absent = ~np.isin(wanted, sides)
        if absent.any():
            raise ValueError(f"{edge_names(pairs[absent])}: not an edge of the mesh, so it cannot be cut")
        FT, _ = self._number_fans(np.isin(sides, wanted))
        return SeamedMesh(self.V, self.F, FT)

    def with_places(self, places: Sequence[FloatArray]) -> SeamedMesh:
        """Return the mesh with new positions of its islands.

        Parameters
        ----------
        places : sequence of (m_i, 2) float64
            Positions of the vertices of each of `islands`.

        Returns
        -------
        SeamedMesh
            Rows of ``uv`` keep their numbers. If a vertex moves and other users of its row do not move to the same
            position, the vertex gets a new row at the end. Without ``uv``, the result has one row for each vertex of
            each island, in the order of the mesh's vertices; copies follow.
        """
        if len(places) != len(self.islands):
            raise ValueError(f"places must have one array for each of {len(self.islands)} islands, not {len(places)}")
        if self.uv is not None:
            return self._move(self.uv, places)
        FT, _ = self._number_fans()
        rows = np.unique(FT[self.mapped])
        FT[self.mapped] = np.searchsorted(rows, FT[self.mapped])
        uv = np.full((len(rows), 2), np.nan)
        for island, now in zip(self.islands, places, strict=True):
            uv[FT[island.triangles]] = now[island.F]
        return SeamedMesh(self.V, self.F, FT, uv)

    def _owner(self) -> tuple[int, IntArray]:
        """Return the number of island vertices, and the number of the island vertex at every corner.

        Corners of triangles without positions have the number after the last.
        """
        start = np.cumsum([0, *(len(island.vertices) for island in self.islands)])
        owner = np.full(self.F.shape, start[-1])
        for offset, island in zip(start, self.islands, strict=False):
            owner[island.triangles] = island.F + offset
        return int(start[-1]), owner

    def _number_fans(self, cut: BoolArray | None = None) -> tuple[IntArray, IntArray]:
        """Give each fan of triangles a vertex: the first fan around a vertex keeps its number, further fans follow.

        Returns
        -------
        FT : (f, 3) int64
        origin : (n + c,) int64
            The original vertex of each vertex.
        """
        F = self.F[self.mapped]
        FT = np.full(self.F.shape, -1)
        FT[self.mapped], origin = number_fans(
            F, fans(self._welded, None if cut is None else cut[self.mapped])[0], len(self.V)
        )
        return FT, origin

    def _move(self, uv: FloatArray, places: Sequence[FloatArray]) -> SeamedMesh:
        """Write new positions of the islands into the rows of the map; add rows where a shared row must split."""
        _, owner = self._owner()
        nowhere = np.full((1, 2), np.nan)
        before = np.concatenate([*(island.uv for island in self.islands), nowhere])
        now = np.concatenate([*places, nowhere])
        given = self.FT >= 0
        # Combine row and vertex into one number, ascending.
        row, vertex = np.divmod(np.unique(self.FT[given] * len(now) + owner[given]), len(now))
        moved = (now[vertex] != before[vertex]).any(axis=1) & np.isfinite(now[vertex]).all(axis=1)
        # A row moves in place if all vertices that use it move to the same position.
        first = np.searchsorted(row, row)
        apart = (now[vertex] != now[vertex[first]]).any(axis=1)
        together = ~np.isin(row, row[apart])
        uv, FT = uv.copy(), self.FT
        uv[row[moved & together]] = now[vertex[moved & together]]
        row, vertex = row[moved & ~together], vertex[moved & ~together]
        if row.size:
            wanted, corner = row * len(now) + vertex, FT * len(now) + owner
            at = np.minimum(np.searchsorted(wanted, corner), row.size - 1)
            FT = np.where(wanted[at] == corner, len(uv) + at, FT)
        return SeamedMesh(self.V, self.F, FT, np.concatenate([uv, now[vertex]]))
