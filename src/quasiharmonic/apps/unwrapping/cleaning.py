"""Cleaning: the surfaces of any model, with maps between their elements and those of the model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.apps.unwrapping.degenerate_triangles import exclude, widen
from quasiharmonic.apps.unwrapping.sheets import join_sheets
from quasiharmonic.geometry.mesh.splitting import find_representatives
from quasiharmonic.geometry.mesh.topology import (
    are_collapsed,
    boundary_edges,
    components,
    edge_keys,
    mark_sides,
    pair_keys,
)
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem.inspection import MeshReport, find_close_vertices, inspect_mesh, tabulate_elements
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    Scalar,
    check_bool,
    check_weld,
    count_of,
    invert_indices,
    mark,
    number_array,
    triangle_array,
    vertex_array,
)

# Volume of a closed component, relative to the sum of its absolute parts, below which it is due to rounding.
_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False, repr=False)
class CleanedMesh:
    """The surfaces of a model, made by `clean`.

    Every edge has at most two triangles, which traverse it in opposite directions. The triangles around every vertex
    form one fan. No triangle is degenerate or repeated.

    Attributes
    ----------
    V : (n', 2) or (n', 3) float64
        Positions, each that of a vertex of the model, unless it was moved.
    F : (f', 3) int64
        Triangles, in the order of the model. A triangle whose orientation is reversed has its last two corners
        exchanged.
    vertices : (n',) int64
        One vertex of the model for each vertex, ascending. ``V`` has the position of its representative.
    triangles : (f',) int64
        The triangle of the model for each row of ``F``, ascending.
    corners : (f', 3) int64
        The model's vertex at each corner of ``F``. It differs from ``vertices[F]`` where vertices were merged.
    flipped : (f',) bool
        Whether the orientation is reversed.
    widened : (f',) bool
        Whether the triangle has no height in the model, or less than 1e-7 of its longest side, or less than 2.4e-7 of
        the root of the model's area if that is below 1e-3 of its longest side. A vertex of it was moved, so that the
        triangle can have a shape in the plane and in a texture.
    moved : (n',) bool
        Whether the vertex was moved, by at most the largest of 1e-3 of the shortest edge there, 4e-7 of the longest
        side of a thin triangle, and 7.6e-6 of the root of the model's area.
    component : (f',) int64
        Component of each triangle. Components are numbered by their first vertices.
    facing : (c,) int64
        For each component 1 if it is closed and its triangles face outwards, -1 if they face inwards, 0 if this is
        unknown. It is unknown for components with boundary and for those without volume.
    excluded : (k,) int64
        Triangles of the model that were left out, ascending.
    repeated : (k,) bool
        Whether the excluded triangle has the positions of an earlier one. The others are degenerate.
    collapsed : (k,) int64
        Degenerate triangles that were excluded because welding merged corners at different positions, ascending.
    substitutes : (k,) int64
        For each excluded triangle the row of ``F`` whose texture coordinates it takes.
    substitute_corners : (k, 3) int64
        For each of its corners the corner of that row, 0 … 2.
    seams : (s, 2) int64
        Edges of the model, by its vertices, that several triangles share and at which the surface has a boundary.
    report : MeshReport
        Topology and defects of the model.
    close : (k,) int64
        Vertices of the model, after merging, that are close to another one if most components have one or two
        triangles; see `MeshReport`.
    representatives : (n,) int64
        For each vertex of the model the one with which it was merged, which has the lowest index; otherwise itself.

    See Also
    --------
    clean : Makes it.
    MeshReport : The defects of the model.

    Examples
    --------
    >>> from quasiharmonic import clean
    >>> V = [[0, 0], [1, 0], [1, 1], [0, 1]]
    >>> cleaned = clean(V, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    >>> cleaned.triangles.tolist(), cleaned.excluded.tolist(), cleaned.repeated.tolist()
    ([0, 1], [2], [True])
    """

    V: FloatArray
    F: IntArray
    vertices: IntArray
    triangles: IntArray
    corners: IntArray
    flipped: BoolArray
    widened: BoolArray
    moved: BoolArray
    component: IntArray
    facing: IntArray
    excluded: IntArray
    repeated: BoolArray
    collapsed: IntArray
    substitutes: IntArray
    substitute_corners: IntArray
    seams: IntArray
    report: MeshReport
    close: IntArray
    representatives: IntArray

    def __repr__(self) -> str:
        return f"<CleanedMesh: {self._size()}, {count_of('triangle', 'triangles', self.excluded.size)} excluded>"

    def _size(self) -> str:
        inward = int(np.count_nonzero(self.facing < 0))
        return (
            f"{count_of('vertex', 'vertices', len(self.V))}, {count_of('triangle', 'triangles', len(self.F))}, "
            f"{count_of('component', 'components', self.facing.size)}{f' ({inward} facing inwards)' if inward else ''}"
        )

    @property
    def changes(self) -> dict[str, IntArray]:
        """For each class of changes the indices of its elements in the model, ascending."""
        return {
            "degenerate triangles excluded": self.excluded[~self.repeated],
            "triangles collapsed by welding": self.collapsed,
            "repeated triangles excluded": self.excluded[self.repeated],
            "thin triangles widened": self.triangles[self.widened],
            "triangles reversed": self.triangles[self.flipped],
            "vertices split": np.unique(self.vertices[1:][np.diff(self.vertices) == 0]),
            "vertices merged": np.setdiff1d(self.corners, self.vertices),
            "edges cut": self.seams,
        }

    def summary(self) -> str:
        """Return the report on the model and, unless nothing changes, a table of the changes."""
        table = self.tabulate_changes()
        # The report counts vertices at the same position, which are merged.
        lines = [replace(self.report, close=self.close).summary()]
        return "\n".join([*lines, f"cleaned: {self._size()}", table] if table else lines)

    def tabulate_changes(self) -> str:
        """Return a table of the changes with the first elements of each class; empty if nothing changes."""
        return "\n".join(tabulate_elements("change", self.changes))

    def take_corners(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return values at the corners of the cleaned triangles, given those of all triangles of the model."""
        return turn_corners(values[self.triangles], self.flipped)

    def mark_edges(self, edges: IntArray) -> BoolArray:
        """Return a mask (f', 3) of the sides at edges (k, 2) of the model, by any of the vertices that were merged."""
        joint = self.representatives
        return mark_sides(joint[self.corners], joint[edges], len(joint))

    def restore_corners(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return values at the corners of all triangles of the model, such as indices of texture coordinates.

        Parameters
        ----------
        values : (f', 3) or (f', 3, …) array
            Values at the corners of ``F``.

        Returns
        -------
        (f, 3) or (f, 3, …) array
            Values in the order of the model's triangles and corners. Excluded triangles take those of their
            substitutes.
        """
        values = np.asarray(values)
        if values.shape[:2] != self.F.shape:
            raise ValueError(f"values must have shape {self.F.shape} or more dimensions, not {values.shape}")
        restored = np.empty((self.report.triangles, *values.shape[1:]), dtype=values.dtype)
        restored[self.triangles] = turn_corners(values, self.flipped)
        restored[self.excluded] = values[self.substitutes[:, None], self.substitute_corners]
        return restored


@accepts_mesh
def clean(
    V: ArrayLike,
    F: ArrayLike,
    outward: bool = False,
    *,
    weld: bool | float = True,
    meshes: ArrayLike | None = None,
) -> CleanedMesh:
    """Return the surfaces that any triangles form; every defect is cut open, oriented or listed.

    Degenerate and repeated triangles are excluded. Each gets a substitute, so that no triangle of the model lacks
    texture coordinates. A triangle with three positions on a line stays if it connects others: one of its vertices is
    moved slightly. At an edge of three or more triangles, pairs stay joined: those that share vertices in the
    model first, then those whose orientations agree, then those that meet at the flattest angle. Other triangles are
    separated there. Triangles are reversed so that each component is consistently oriented; the larger part by area
    keeps its orientation. A surface that cannot be oriented, such as a Möbius band, is cut. Vertices where surfaces
    touch are split. Vertices without triangle are dropped.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Positions.
    F : (f, 3) array of int
        Triangles.
    outward : bool
        Reverse closed components whose triangles face inwards.
    weld : bool or float
        Join triangles whose vertices have exactly the same positions, as at the seams of a glTF file. A number is a
        distance relative to the diagonal of the bounding box; 0 means equal positions. Each vertex is merged with the
        vertex of the lowest index within this distance that is not merged itself, and takes its position. Triangles
        whose corners are merged are degenerate.
    meshes : (n,) array of int, optional
        Mesh of each vertex. Vertices of different meshes are not welded.

    Returns
    -------
    CleanedMesh

    Raises
    ------
    ValueError
        If an array has the wrong shape, a position is not finite, an index is out of range, there are no triangles, or
        all triangles are degenerate. Also if ``weld`` is negative or not finite.

    See Also
    --------
    inspect_mesh : Lists the defects.
    unwrap : Cleans the model itself.

    Examples
    --------
    >>> from quasiharmonic.surfaces import annulus
    >>> V, F = annulus(8)
    >>> F[5] = F[5, ::-1]
    >>> cleaned = clean(V, F)
    >>> cleaned.triangles[cleaned.flipped].tolist(), cleaned.report.clean
    ([5], False)
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    check_bool("outward", outward)
    check_weld(weld)
    report = inspect_mesh(V, F)
    exponent = math.frexp(float(np.abs(V).max()))[1]
    joint = find_representatives(
        V, F, weld, None if meshes is None else number_array("meshes", meshes, len(V), "vertex")
    )
    # In this unit, products neither overflow nor underflow.
    points = np.pad(np.ldexp(V, -exponent), [(0, 0), (0, 3 - V.shape[1])])
    points, moved, thin, degenerate, twice_area = widen(points, joint[F], V.shape[1])
    # Triangles with corners at equal positions are degenerate without welding, too.
    collapsed = np.flatnonzero(are_collapsed(joint[F]))
    at = V[F[collapsed]]
    collapsed = collapsed[(at != at[:, (1, 2, 0)]).any(axis=2).all(axis=1)]
    if degenerate.all():
        merged = f"; welding at distance {weld:g} merges corners of {collapsed.size}, choose a smaller distance"
        every = f"all {len(F)} triangles are degenerate: each" if len(F) > 1 else "the only triangle is degenerate: it"
        raise ValueError(f"{every} uses a vertex twice or has no area" + merged * bool(collapsed.size))
    exclusion = exclude(points, joint[F], degenerate)
    rows = exclusion.triangles
    sheets = join_sheets(points, joint[F[rows]], F[rows], twice_area[rows], thin[rows])
    corners = F[rows]
    number, vertices = _number(sheets.fan, corners)
    positions, moved = V[joint[vertices]], moved[joint[vertices]]
    positions[moved] = np.ldexp(points[joint[vertices[moved]], : V.shape[1]], exponent)
    component, facing = _orientations(points[joint[vertices]], turn_corners(number, sheets.turned))
    flipped = sheets.turned
    if outward:
        flipped = flipped ^ (facing < 0)[component]
        facing = np.abs(facing)
    matched = exclusion.substitute_corners
    distinct = np.flatnonzero(mark(len(V), joint[corners]))
    return CleanedMesh(
        V=positions,
        F=turn_corners(number, flipped),
        vertices=vertices,
        triangles=rows,
        corners=turn_corners(corners, flipped),
        flipped=flipped,
        widened=thin[rows],
        moved=moved,
        component=component,
        facing=facing,
        excluded=exclusion.excluded,
        repeated=exclusion.repeated,
        collapsed=collapsed,
        substitutes=exclusion.substitutes,
        # Reversing a triangle exchanges its corners 1 and 2.
        substitute_corners=np.where(flipped[exclusion.substitutes, None], -matched % 3, matched),
        seams=_find_edges(joint[corners], corners, sheets.seams),
        report=report,
        close=distinct[find_close_vertices(V[distinct], np.bincount(component))],
        representatives=joint,
    )


def _number(fan: IntArray, corners: IntArray) -> tuple[IntArray, IntArray]:
    """Number fans in the order of their vertices; return the triangles by fans, and the vertex of each fan."""
    label = fan.ravel()
    first = np.flatnonzero(label == np.arange(label.size))
    owner = corners.ravel()[first]
    order = np.argsort(owner, kind="stable")
    return invert_indices(label.size, first[order])[fan], owner[order]


def _find_edges(joint: IntArray, corners: IntArray, pairs: IntArray) -> IntArray:
    """Return edges (k, 2) of triangles ``joint`` (f, 3) by the vertices ``corners`` (f, 3) at one of their sides."""
    if not len(pairs):
        return pairs
    n = int(joint.max()) + 1
    keys, side = np.unique(edge_keys(joint, joint[:, (1, 2, 0)], n), return_index=True)
    side = side[np.searchsorted(keys, pair_keys(pairs, n))]
    ends = np.stack([corners.ravel()[side], corners[:, (1, 2, 0)].ravel()[side]], axis=1)
    return np.unique(np.sort(ends, axis=1), axis=0)


def turn_corners(values: NDArray[Scalar], turned: BoolArray) -> NDArray[Scalar]:
    """Return triangles, or values (k, 3, ...) at their corners, with some triangles reversed."""
    values = values.copy()
    values[turned] = values[turned][:, (0, 2, 1)]
    return values


def _orientations(points: FloatArray, F: IntArray) -> tuple[IntArray, IntArray]:
    """Return the component of each triangle, and whether each component faces outwards (1), inwards (-1) or neither."""
    label = components(F, len(points))
    first = np.flatnonzero(label == np.arange(label.size))
    of_vertex = np.searchsorted(first, label)
    component = of_vertex[F[:, 0]]
    origin = points[first][component]
    a, b, c = (points[F[:, k]] - origin for k in range(3))
    parts = (a * np.cross(b, c)).sum(axis=1)
    volume, most = np.bincount(component, parts), np.bincount(component, np.abs(parts))
    facing = np.where(np.abs(volume) > _ROUNDING * most, np.sign(volume), 0.0).astype(np.int64)
    facing[of_vertex[boundary_edges(F, len(points))[:, 0]]] = 0
    return component, facing
