"""Maps with seams: the islands into which they cut a surface.

A map that is cut along seams gives a vertex several places, so its triangles refer to places by indices of their
own. What counts here is how the triangles are joined in the plane: two are, along an edge, if they share it on the
surface and put both of its ends at the same places, by whatever index. A vertex of an island is a fan of triangles
joined in that way; an island is a component, and always a surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.fans import fans, numbered, renumbered
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_range,
    counted,
    index_array,
    map_array,
    named,
    named_edges,
    triangle_rows,
    vertex_array,
)


@dataclass(frozen=True, eq=False)
class Island:
    """A part of a map between its seams, numbered on its own.

    Attributes
    ----------
    F : (k, 3) int64
        Its triangles, by its own vertices.
    triangles : (k,) int64
        Which triangles of the mesh they are, ascending.
    vertices : (m,) int64
        Which vertex of the mesh each of its own is, ascending. A seam may run to both sides of a vertex, which is
        then there repeatedly.
    V : (m, 2) or (m, 3) float64
        Where its vertices are on the surface.
    uv : (m, 2) float64
        Where they are in the plane; NaN where that is not known.
    """

    F: IntArray
    triangles: IntArray
    vertices: IntArray
    V: FloatArray
    uv: FloatArray


def which_island(triangles: IntArray) -> str:
    """Name an island in a message by the mesh's triangles (k,), ascending, that it has."""
    return f"island at triangle {triangles[0]} ({counted('triangle', 'triangles', len(triangles))})"


class SeamedMesh:
    """A surface and a map of it that may have seams.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Positions.
    F : (f, 3) array of int
        Triangles.
    FT : (f, 3) array of int, optional
        For every corner the row of ``uv`` it is at; a triangle with a corner at -1 has no place. By default ``F``.
    uv : (m, 2) array, optional
        Places in the plane, NaN where there is none; left out of a surface that is cut but not yet mapped.

    Raises
    ------
    ValueError
        When the shapes do not fit, or there is no such vertex or row; the message names them.

    Attributes
    ----------
    V, F, FT, uv : arrays
        As given, as float64 and int64; ``uv`` None if left out. Not writeable.

    Examples
    --------
    A sheet cut along the line through its middle:

    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> cut = SeamedMesh(V, F).cut([[1, 4], [4, 7]])
    >>> len(cut.islands), len(cut.V), cut.seams.tolist()
    (2, 9, [[1, 4], [4, 7]])
    """

    def __init__(self, V: ArrayLike, F: ArrayLike, FT: ArrayLike | None = None, uv: ArrayLike | None = None) -> None:
        self.V, self.F = vertex_array(V), triangle_rows(F)
        check_range("F", self.F, len(self.V))
        self.uv = None if uv is None else map_array("uv", uv, finite=False)
        self.FT = self.F if FT is None else triangle_rows(FT, "FT")
        if len(self.FT) != len(self.F):
            raise ValueError(f"FT must have as many rows as F, {len(self.F)}, not {len(self.FT)}")
        rows = int(self.FT.max(initial=-1)) + 1 if self.uv is None else len(self.uv)
        check_range("FT", self.FT, rows, "row", "rows", least=-1)
        for array in (self.V, self.F, self.FT, self.uv):
            if array is not None:
                array.flags.writeable = False

    @cached_property
    def _welded(self) -> IntArray:
        """For every corner of a triangle that has a place, vertex and place in one number of 0, 1, …; (g, 3) int64."""
        if self.uv is None:
            place: IntArray = np.arange(int(self.FT.max(initial=-1)) + 1)
        else:
            # Equal numbers are one place, those that are none included.
            with np.errstate(invalid="ignore"):  # a signalling NaN
                pairs = np.ascontiguousarray(self.uv + 0.0).view(np.complex128).ravel()
            place = np.unique(pairs, return_inverse=True)[1].ravel()
        corners = self.F[self.mapped] * max(len(place), 1) + place[self.FT[self.mapped]]
        return np.unique(corners, return_inverse=True)[1].reshape(-1, 3)

    @cached_property
    def mapped(self) -> IntArray:
        """Triangles that have a place, ascending; (g,) int64."""
        return np.flatnonzero((self.FT >= 0).all(axis=1))

    @cached_property
    def seamless(self) -> bool:
        """Whether every triangle and no vertex has more than one place."""
        if len(self.mapped) < len(self.F):
            return False
        return bool(self._welded.max(initial=-1) + 1 == np.count_nonzero(np.bincount(self.F.ravel())))

    @cached_property
    def islands(self) -> tuple[Island, ...]:
        """The parts into which the seams cut the surface, by their first triangle.

        Edges at which three or more triangles meet, or two that are wound differently, are seams.
        """
        places = np.full((int(self.FT.max(initial=-1)) + 1, 2), np.nan) if self.uv is None else self.uv
        split, island = fans(self._welded)
        by_island = np.argsort(island, kind="stable")
        found = []
        for rows in np.split(by_island, np.flatnonzero(np.diff(island[by_island])) + 1) if by_island.size else []:
            triangles = self.mapped[rows]
            of_mesh, at = self.F[triangles].ravel(), self.FT[triangles].ravel()
            own, first = renumbered(split[rows], self.F[triangles])
            found.append(Island(own, triangles, of_mesh[first], self.V[of_mesh[first]], places[at[first]]))
        return tuple(found)

    @property
    def seams(self) -> IntArray:
        """Edges (k, 2) along which triangles meet on the surface, and not in the plane; by vertices, ascending."""
        count, owner = self._owner()
        tail, head = self.F, self.F[:, (1, 2, 0)]
        here, there = owner, owner[:, (1, 2, 0)]
        upwards = tail < head
        # An edge whose ends are at other places for one of its triangles than for another.
        places = np.where(upwards, here, there) * (count + 1) + np.where(upwards, there, here)
        key = edge_keys(tail, head, len(self.V)).ravel()
        order = np.argsort(key, kind="stable")
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        sides = places.ravel()[order]
        apart = np.minimum.reduceat(sides, first) < np.maximum.reduceat(sides, first) if first.size else first > 0
        at = order[first[apart]]
        ends = np.stack([tail.ravel()[at], head.ravel()[at]], axis=1)
        return np.unique(np.sort(ends, axis=1), axis=0)

    def opened(self) -> SeamedMesh:
        """Return the mesh with a vertex for each of a vertex's places: the same map without seams.

        Returns
        -------
        SeamedMesh
            Its vertices are this one's own, then a further one for each further place of one; its triangles these, in
            their order. Where there are no seams, nothing is changed. Places of vertices that no triangle uses are NaN.

        Raises
        ------
        ValueError
            When a triangle has no place; names the first ones.
        """
        bare = np.flatnonzero((self.FT < 0).any(axis=1))
        if bare.size:
            raise ValueError(
                f"{named('triangle', 'triangles', bare)} without texture coordinates, which other triangles have"
            )
        if self.seamless:
            FT, origin = self.F, np.arange(len(self.V))
        else:
            FT, origin = self._numbered()
        uv = None
        if self.uv is not None:
            uv = np.full((len(origin), 2), np.nan)
            uv[FT] = self.uv[self.FT]
        return SeamedMesh(self.V[origin], FT, FT, uv)

    def cut(self, edges: ArrayLike) -> SeamedMesh:
        """Cut along further edges; what comes out has no places yet.

        Parameters
        ----------
        edges : (k, 2) array of int
            Vertices at both ends of each.

        Returns
        -------
        SeamedMesh
            Of the same ``V`` and ``F``, without ``uv``. Its rows are numbered as the vertices are, then one for each
            further place of one.

        Raises
        ------
        ValueError
            When one is no edge of the mesh; names the first ones.
        """
        pairs = index_array("edges", edges).reshape(-1, 2)
        check_range("edges", pairs, len(self.V))
        sides = edge_keys(self.F, self.F[:, (1, 2, 0)], len(self.V))
        wanted = edge_keys(pairs[:, 0], pairs[:, 1], len(self.V))
        absent = ~np.isin(wanted, sides)
        if absent.any():
            raise ValueError(f"{named_edges(pairs[absent])}: not an edge of the mesh, so it cannot be cut")
        FT, _ = self._numbered(np.isin(sides, wanted))
        return SeamedMesh(self.V, self.F, FT)

    def with_places(self, places: Sequence[FloatArray]) -> SeamedMesh:
        """Return the mesh with its islands in other places.

        Parameters
        ----------
        places : sequence of (m_i, 2) float64
            For each of `islands`, where its vertices are.

        Returns
        -------
        SeamedMesh
            Rows of ``uv`` stay what they are, unless a vertex moved from a row that others use and do not leave: then
            it has a new one at the end. Where there was no ``uv``, there is a row for each place.
        """
        if self.uv is not None:
            return self._moved(self.uv, places)
        FT = np.full_like(self.FT, -1)
        rows = np.unique(self.FT[self.mapped])
        FT[self.mapped] = np.searchsorted(rows, self.FT[self.mapped])
        uv = np.full((len(rows), 2), np.nan)
        for island, now in zip(self.islands, places, strict=True):
            uv[FT[island.triangles]] = now[island.F]
        return SeamedMesh(self.V, self.F, FT, uv)

    def _owner(self) -> tuple[int, IntArray]:
        """A number for each vertex of each island, how many there are, and for every corner which it is.

        Corners of triangles without a place have the number beyond the last.
        """
        start = np.cumsum([0, *(len(island.vertices) for island in self.islands)])
        owner = np.full(self.F.shape, start[-1])
        for offset, island in zip(start, self.islands, strict=False):
            owner[island.triangles] = island.F + offset
        return int(start[-1]), owner

    def _numbered(self, cut: BoolArray | None = None) -> tuple[IntArray, IntArray]:
        """A vertex for each fan of triangles around one: the old numbers for the first, further ones at the end.

        Returns
        -------
        FT : (f, 3) int64
        origin : (n + c,) int64
            The old vertex that each is.
        """
        F = self.F[self.mapped]
        FT = np.full(self.F.shape, -1)
        FT[self.mapped], origin = numbered(
            F, fans(self._welded, None if cut is None else cut[self.mapped])[0], len(self.V)
        )
        return FT, origin

    def _moved(self, uv: FloatArray, places: Sequence[FloatArray]) -> SeamedMesh:
        """Bring the islands' places into the rows of the map, new rows where others use the same."""
        _, owner = self._owner()
        nowhere = np.full((1, 2), np.nan)
        before = np.concatenate([*(island.uv for island in self.islands), nowhere])
        now = np.concatenate([*places, nowhere])
        given = self.FT >= 0
        # Row and vertex in one number, ascending.
        row, vertex = np.divmod(np.unique(self.FT[given] * len(now) + owner[given]), len(now))
        moved = (now[vertex] != before[vertex]).any(axis=1) & np.isfinite(now[vertex]).all(axis=1)
        # A row goes along where all that use it go to the same place.
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
