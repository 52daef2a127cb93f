"""What a mesh is: its components, boundaries and genus, and every class of defect that methods for surfaces reject."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.loops import join_items
from quasiharmonic.geometry.mesh.reference import flat_triangles
from quasiharmonic.geometry.mesh.splitting import fans, find_representatives
from quasiharmonic.geometry.mesh.topology import Edges, are_collapsed, edges, find_twins, manifold_edges, trace_loops
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.io.objects import MeshLike, mesh_triangles
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_integer,
    check_range,
    check_weld,
    count_of,
    first_equal,
    mark,
    repeat_each,
    scale_to_unit,
    triangle_array,
    triangle_rows,
    vertex_array,
)
from quasiharmonic.util.outcome import as_plain

# Vertices are close if their distance is at most this multiple of the diagonal of the bounding box.
_CLOSE = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class MeshReport:
    """Topology and defects of a mesh, made by `inspect_mesh`.

    Two triangles are joined at an edge that exactly they share, with opposite directions. Components, boundary loops
    and genus are those of the surface that joined triangles form. At defects, that surface is cut.

    Attributes
    ----------
    vertices, triangles : int
    components : int
        Connected parts of the surface.
    closed : int
        Components without boundary.
    loops : int
        Boundary loops.
    genus : int
        Number of handles, summed over the components.
    inward : int
        Closed components whose triangles face inwards (negative volume).
    defects : dict of str to array
        For each class of defects the indices of its elements, ascending: triangles and vertices (k,) int64, edges
        (k, 2) int64. Empty arrays for classes that do not occur.
    coincident : (k,) int64
        Vertices at the position of an earlier vertex. They are not a defect: files often store seams this way.
    close : (k,) int64
        If most components have one or two triangles, the vertices that are close to another one; otherwise empty. See
        `find_close_vertices`.
    welded : (k,) int64
        Vertices that are welded to an earlier vertex. Then topology and defects are those of the welded mesh.

    See Also
    --------
    inspect_mesh : Makes it.

    Examples
    --------
    >>> from quasiharmonic import inspect_mesh
    >>> from quasiharmonic.surfaces import annulus
    >>> V, F = annulus(8)
    >>> F[5] = F[5, ::-1]
    >>> report = inspect_mesh(V, F)
    >>> report.clean, [name for name, elements in report.defects.items() if len(elements)]
    (False, ['edges with mixed winding'])
    """

    vertices: int
    triangles: int
    components: int
    closed: int
    loops: int
    genus: int
    inward: int
    defects: dict[str, IntArray]
    coincident: IntArray
    close: IntArray
    welded: IntArray

    def __repr__(self) -> str:
        return f"<MeshReport: {self.summary().partition(chr(10))[0]}>"

    @property
    def clean(self) -> bool:
        """Whether the mesh has no defect."""
        return not any(found.size for found in self.defects.values())

    def summary(self) -> str:
        """Return the topology in one sentence, and a table of the defects with the first elements of each class."""
        lines = [
            f"{count_of('vertex', 'vertices', self.vertices)}, {count_of('triangle', 'triangles', self.triangles)}, "
            f"{count_of('component', 'components', self.components)} ({self.closed} closed), "
            f"{count_of('boundary loop', 'boundary loops', self.loops)}, genus {self.genus}"
        ]
        if self.inward:
            inward = count_of("closed component", "closed components", self.inward)
            lines.append(f"{inward} with triangles facing inwards")
        for found, where in ((self.welded, "welded to"), (self.coincident, "at the position of")):
            if found.size:
                vertices = count_of("vertex", "vertices", found.size)
                lines.append(f"{vertices} {where} an earlier vertex, first {_name_first(found)}")
        if self.close.size:
            lines.append(describe_soup(self.close))
        return "\n".join([*lines, *(tabulate_elements("defect", self.defects) or ["no defects"])])

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return {
            **as_plain(self, "vertices", "triangles", "components"),
            "closed_components": self.closed,
            "boundary_loops": self.loops,
            "genus": self.genus,
            "inward_components": self.inward,
            "welded_vertices": self.welded.tolist(),
            "coincident_vertices": self.coincident.tolist(),
            "close_vertices": self.close.tolist(),
            "defects": {name: found.tolist() for name, found in self.defects.items()},
        }


def tabulate_elements(title: str, classes: dict[str, IntArray]) -> list[str]:
    """Return the lines of a table with the number and the first elements of each class; none if all are empty."""
    rows = [(name, found) for name, found in classes.items() if found.size]
    if not rows:
        return []
    width = max(len(title), *(len(name) for name, _ in rows))
    table = [f"{name:<{width}} {len(found):>9,}  {_name_first(found)}" for name, found in rows]
    return [f"{title:<{width}} {'count':>9}  first", *table]


def boundary_loops(F: ArrayLike | MeshLike, n: int | None = None) -> list[IntArray]:
    """Return the vertices of each boundary loop, in order with the surface to the left.

    Parameters
    ----------
    F : (f, 3) array of int, or a mesh
        Triangles, consistently oriented.
    n : int, optional
        Number of vertices. Default: the largest index plus one.

    Returns
    -------
    list of (k,) int64
        Each loop starts at its smallest vertex. It runs counterclockwise around the outside of a planar mesh and
        clockwise around its holes. Loops are sorted by their first vertex.

    Raises
    ------
    ValueError
        If the array has the wrong shape, an index is out of range, or the boundary does not form loops, because
        surfaces touch at a vertex, an edge is in three triangles or orientations differ; names the elements.

    See Also
    --------
    inspect_mesh : Number of loops, and defects of the mesh.
    Problem : Takes target positions of these vertices.

    Examples
    --------
    >>> from quasiharmonic import boundary_loops
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> [loop.tolist() for loop in boundary_loops(F)]
    [[0, 1, 2, 5, 8, 7, 6, 3]]
    """
    triangles = triangle_rows(mesh_triangles(F))
    if n is None:
        n = int(triangles.max(initial=-1)) + 1
    check_integer("n", n, minimum=0)
    check_range("F", triangles, n)
    try:
        return trace_loops(edges(triangles, n).boundary)
    except ValueError:
        # Edges that are not of a surface explain it better.
        manifold_edges(triangles, n)
        raise


@accepts_mesh
def inspect_mesh(V: ArrayLike, F: ArrayLike, *, weld: bool | float = False) -> MeshReport:
    """Return the topology and the defects of any triangles; only malformed arrays raise an error.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Positions.
    F : (f, 3) array of int
        Triangles.
    weld : bool or float
        Weld vertices at equal positions first, or within a distance relative to the diagonal of the bounding box; see
        `clean`. The numbering stays that of the input.

    Returns
    -------
    MeshReport

    Raises
    ------
    ValueError
        If an array has the wrong shape, a position is not finite, an index is out of range, or there are no triangles.
        Also if ``weld`` is negative or not finite.

    See Also
    --------
    clean : Returns the surfaces without the defects.
    boundary_loops : The vertices of each loop.
    certify : Checks a map.

    Examples
    --------
    >>> from quasiharmonic.surfaces import annulus
    >>> report = inspect_mesh(*annulus(8))
    >>> report.clean, report.components, report.loops, report.genus
    (True, 1, 2, 0)
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    check_weld(weld)
    joint = find_representatives(V, F, weld)
    kept = joint == np.arange(len(V))
    welded, F = np.flatnonzero(~kept), joint[F]
    collapsed = are_collapsed(F)
    surface = F[~collapsed]
    split, part = fans(surface)
    defects = _defects(V, F, collapsed, split, kept)
    rim = edges(split, surface.size).boundary
    loops = trace_loops(rim)
    closed = np.ones(int(part.max(initial=-1)) + 1, dtype=bool)
    of_vertex = np.zeros(surface.size, dtype=np.int64)
    of_vertex[split] = part[:, None]
    closed[of_vertex[rim[:, 0]]] = False
    vertices, sides = int(split.max(initial=-1)) + 1, (3 * len(split) + len(rim)) // 2
    genus = (2 * closed.size - len(loops) - (vertices - sides + len(split))) // 2
    inward = closed & (_volumes(V, surface, part, closed.size) < 0)
    return MeshReport(
        vertices=len(V),
        triangles=len(F),
        components=closed.size,
        closed=int(np.count_nonzero(closed)),
        loops=len(loops),
        genus=genus,
        inward=int(np.count_nonzero(inward)),
        defects=defects,
        coincident=np.setdiff1d(np.flatnonzero(first_equal(V) < np.arange(len(V))), welded),
        close=np.flatnonzero(kept)[find_close_vertices(V[kept], np.bincount(part))],
        welded=welded,
    )


def find_close_vertices(V: FloatArray, triangles: IntArray) -> IntArray:
    """Return the vertices of a soup of triangles that are close to another vertex, ascending; none for other meshes.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
    triangles : (c,) int64
        Number of triangles of each component. The mesh is a soup if most components have one or two.
    """
    if len(V) < 2 or np.count_nonzero(triangles <= 2) <= max(len(triangles) / 2, 1):
        return np.empty(0, dtype=np.int64)
    from scipy.spatial import KDTree

    points = scale_to_unit(V)
    # A tree takes quadratic time for many points at the same position, so each position is in it once.
    order = np.lexsort(points.T)
    first = np.flatnonzero(np.concatenate([[True], (np.diff(points[order], axis=0) != 0).any(axis=1)]))
    places, times = points[order[first]], np.diff(first, append=len(order))
    distance, _ = KDTree(places).query(places, k=2)
    near = (times > 1) | (distance[:, 1] <= _CLOSE * np.linalg.norm(np.ptp(points, axis=0)))
    return np.sort(order[repeat_each(near, times)])


def describe_soup(close: IntArray) -> str:
    """Return a sentence on close vertices of a soup of triangles, with a remedy."""
    return (
        f"Most components have one or two triangles, and {count_of('vertex is', 'vertices are', len(close))} within "
        f"{_CLOSE:g} of the mesh's size from another vertex. Weld these vertices with weld={_CLOSE:g}."
    )


def _defects(V: FloatArray, F: IntArray, collapsed: BoolArray, split: IntArray, kept: BoolArray) -> dict[str, IntArray]:
    """Return the elements of every class of defects.

    ``split`` are the fans of the triangles that are not collapsed, ``kept`` (n,) the vertices that are not welded.
    """
    repeated = np.flatnonzero((find_twins(F) < np.arange(len(F))) & ~collapsed)
    flat = flat_triangles(V, F)
    found = edges(F, len(V))
    used = mark(len(V), F)
    return {
        "triangles that use a vertex twice": np.flatnonzero(collapsed),
        "triangles repeated": repeated,
        "triangles without area": flat[~collapsed[flat]],
        "edges of three or more triangles": found.nonmanifold,
        "edges with mixed winding": found.inconsistent[found.inconsistent[:, 0] != found.inconsistent[:, 1]],
        "vertices where surfaces touch": _find_touching(F[~collapsed], split, len(V), found),
        "vertices without triangle": np.flatnonzero(kept & ~used),
    }


def _find_touching(F: IntArray, split: IntArray, n: int, found: Edges) -> IntArray:
    """Return vertices with several fans of triangles that no defective edge explains, ascending."""
    vertex_of_fan = np.empty(int(split.max(initial=-1)) + 1, dtype=np.int64)
    vertex_of_fan[split] = F
    several = np.bincount(vertex_of_fan, minlength=n) > 1
    several[found.nonmanifold] = False
    several[found.inconsistent] = False
    return np.flatnonzero(several)


def _volumes(V: FloatArray, F: IntArray, part: IntArray, count: int) -> FloatArray:
    """Return six times the signed volume of each component, in an arbitrary unit; zeros for a planar mesh."""
    if V.shape[1] == 2:
        return np.zeros(count)
    # In this unit, sums do not overflow.
    points = scale_to_unit(V)
    points = points - points.mean(axis=0)
    points = points / max(float(np.abs(points).max()), np.finfo(float).tiny)
    a, b, c = (points[F[:, k]] for k in range(3))
    return np.bincount(part, (a * np.cross(b, c)).sum(axis=1), minlength=count).astype(np.float64)


def _name_first(found: IntArray) -> str:
    """Name the first elements."""
    # One more than the text lists.
    first = found[:6].tolist()
    return join_items([tuple(one) if isinstance(one, list) else one for one in first])
