"""Where seams are wanted on a cleaned mesh: costs, edges that must or must not be seams, given maps, and symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, KEPT_COST, UNDIVIDED_COST, Hinges, find_hinges
from quasiharmonic.apps.unwrapping.layout import find_differing_sides
from quasiharmonic.apps.unwrapping.pieces import CREASE, find_coarse_tori, find_pieces
from quasiharmonic.apps.unwrapping.symmetry import Mirror, Symmetry, find_mirror
from quasiharmonic.geometry.mesh.reference import area_vectors
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import (
    are_sides,
    edge_keys,
    find_pairs,
    label_components,
    pair_keys,
)
from quasiharmonic.io.seamed_mesh import find_folds
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_range,
    edge_names,
    index_array,
    mark,
    number_array,
)
from quasiharmonic.util.options import UnwrapOptions

# Smaller factors on the cost of seams count as this one.
_LEAST_COST = 1e-6
# Angles between normals, in radians, that differ by at most this value count as equal, as files round positions.
_SAME_ANGLE = 1e-4
# Factor on the cost of seams between two labels.
_COST_BETWEEN_LABELS = 1e-3
# Factor on the cost of seams on places that face down, below this slope, and in concave edges beyond this angle.
_COST_BELOW, _SLOPE = 0.9, -0.5
_COST_CONCAVE, _CONCAVE = 0.9, np.pi / 6


class Rules(NamedTuple):
    """Where seams are wanted on a cleaned mesh.

    Attributes
    ----------
    cost : (f, 3) float64
        Factor on the cost of a seam at each side; see `find_charts`.
    uv : (f, 3, 2) float64 or None
        Texture coordinates whose seams are kept.
    uv_cuts : (k, 2) int64 or None
        Their seams, and the demanded ones.
    mirror : Mirror or None
        Mirror images, if the model is symmetric.
    symmetry : Symmetry
    wanted : WantedSeams
    hinges : Hinges
    """

    cost: FloatArray
    uv: FloatArray | None
    uv_cuts: IntArray | None
    mirror: Mirror | None
    symmetry: Symmetry
    wanted: WantedSeams
    hinges: Hinges


def find_rules(
    points: FloatArray,
    cleaned: CleanedMesh,
    F: IntArray,
    costs: FloatArray | None,
    corner_uv: FloatArray | None,
    options: UnwrapOptions,
) -> Rules:
    """Return where seams are wanted.

    Parameters
    ----------
    points : (n', 3) float64
        Positions of the cleaned mesh.
    cleaned : CleanedMesh
    F : (f, 3) int64
        Triangles of the model.
    costs : (f, 3) float64 or None
        Costs of their sides.
    corner_uv : (f, 3, 2) float64 or None
        Texture coordinates of their corners.
    options : UnwrapOptions

    Raises
    ------
    ValueError
        If lists of edges or labels are wrong.
    """
    wanted = _read_wanted_seams(options.seams, options.no_seams, F, cleaned.representatives)
    demanded, kept = cleaned.mark_edges(wanted.seams), cleaned.mark_edges(wanted.no_seams)
    labels = (
        None
        if options.labels is None
        else number_array("labels", options.labels, len(F), "triangle")[cleaned.triangles]
    )
    cost = np.ones(cleaned.F.shape) if costs is None else _turn_sides(costs, cleaned)
    cost = np.maximum(cost, _LEAST_COST)
    hinges = find_hinges(points, cleaned.F)
    if labels is not None:
        apart = labels[hinges.first] != labels[hinges.second]
        cost[hinges.mark_sides(apart, len(cleaned.F))] *= _COST_BETWEEN_LABELS
    mirror, symmetry = None, Symmetry(None, 0.0, False, "")
    uv = uv_cuts = None
    if corner_uv is not None:
        uv = cleaned.take_corners(corner_uv)
        uv_cuts = _find_uv_cuts(uv, cleaned)
    else:
        plain = costs is None and labels is None and wanted.empty
        if options.symmetry is not None and (plain or options.symmetry != "auto"):
            mirror, symmetry = find_mirror(points, cleaned.F, options.symmetry)
        if not options.divide_for_packing:
            torus = find_coarse_tori(points, cleaned.F, hinges, options.max_stretch)
            whole = hinges.flat & ~_find_smooth_rings(cleaned.F, hinges) & ~torus[hinges.first]
            cost[hinges.mark_sides(whole, len(cleaned.F))] *= UNDIVIDED_COST
        demanded |= _mark_hard_edges(options.hard_edges, hinges, cleaned, F) & ~kept
    if options.up is not None:
        _prefer_hidden(cost, points, cleaned.F, hinges, options.up, symmetry)
    if mirror is not None:
        demanded, kept = (_mirror_sides(sides, hinges, mirror, cleaned.F) for sides in (demanded, kept))
    cost[kept] = KEPT_COST
    if len(wanted.seams) or not isinstance(options.hard_edges, Real | None):
        demanded = _extend_seams(points, cleaned.F, hinges, demanded, np.where(kept, np.inf, cost))
    cost[demanded] = DEMANDED_COST
    if uv_cuts is not None:
        sides = np.stack([cleaned.F[demanded], cleaned.F[:, (1, 2, 0)][demanded]], axis=1)
        uv_cuts = np.concatenate([uv_cuts, sides])
    return Rules(cost, uv, uv_cuts, mirror, symmetry, wanted, hinges)


def _find_smooth_rings(F: IntArray, hinges: Hinges) -> BoolArray:
    """Mask (e,) of the hinges in flat faces that are not disks, without a crease around them.

    A ring of triangles that happen to be in one plane, such as the top of a torus, must not prevent cuts across it.
    """
    split, face = fans(F, pairs=(hinges.one[hinges.flat], hinges.other[hinges.flat]))
    of = np.empty(int(split.max(initial=-1)) + 1, dtype=np.int64)
    of[split] = face[:, None]
    at = face[hinges.first]
    # Vertices, less edges, plus triangles: 1 for a disk.
    euler = (
        np.bincount(of) - 2 * np.bincount(face) + np.bincount(at[hinges.flat], minlength=int(face.max(initial=-1)) + 1)
    )
    creased = np.abs(hinges.angle) >= CREASE
    sharp = mark(len(euler), at[creased], face[hinges.second[creased]])
    return hinges.flat & ((euler < 1) & ~sharp)[at]


def _prefer_hidden(
    cost: FloatArray, points: FloatArray, F: IntArray, hinges: Hinges, up: str, symmetry: Symmetry
) -> None:
    """Lower the costs (f, 3) of seams where the surface faces down, and in concave edges."""
    cost[hinges.mark_sides(hinges.angle < -_CONCAVE, len(F))] *= _COST_CONCAVE
    if symmetry.applied and symmetry.axis == up[-1]:
        # Seams below are mirrored to the upper side.
        return
    normal = area_vectors(points, F)
    length = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
    height = (-1 if up[0] == "-" else 1) * normal[:, "xyz".index(up[-1])] / length
    below = (height[hinges.first] + height[hinges.second]) / 2 < _SLOPE
    cost[hinges.mark_sides(below, len(F))] *= _COST_BELOW


def _mark_hard_edges(given: Any, hinges: Hinges, cleaned: CleanedMesh, F: IntArray) -> BoolArray:
    """Return a mask (f', 3) of the sides at hard edges, given by an angle in degrees or listed."""
    if given is None:
        return np.zeros(cleaned.F.shape, dtype=np.bool_)
    if isinstance(given, Real):
        return hinges.mark_sides(np.abs(hinges.angle) > np.deg2rad(float(given)) + _SAME_ANGLE, len(cleaned.F))
    return cleaned.mark_edges(_read_edges("hard_edges", given, F, cleaned.representatives))


def _mirror_sides(sides: BoolArray, hinges: Hinges, mirror: Mirror, F: IntArray) -> BoolArray:
    """Return some sides (f, 3) of hinges and their mirror images."""
    chosen = hinges.touch(sides)
    return hinges.mark_sides(chosen | chosen[mirror.of_hinges(hinges, F)], len(F))


def _turn_sides(costs: FloatArray, cleaned: CleanedMesh) -> FloatArray:
    """Return the costs of the sides of the cleaned triangles."""
    turned = costs[cleaned.triangles]
    # Reversing a triangle exchanges its first and last side.
    turned[cleaned.flipped] = turned[cleaned.flipped][:, ::-1]
    return turned


def _find_uv_cuts(corner_uv: FloatArray, cleaned: CleanedMesh) -> IntArray:
    """Return the edges (k, 2) of the cleaned mesh at which texture coordinates (f', 3, 2) differ or fold."""
    # Corners without coordinates count as one position.
    position = np.nan_to_num(corner_uv, nan=np.finfo(np.float64).max) + 0.0
    rows = np.unique(position.reshape(-1, 2), axis=0, return_inverse=True)[1]
    side = find_differing_sides(cleaned.F, rows.reshape(-1, 3), len(cleaned.V))
    one, other = find_pairs(cleaned.F)
    side = np.union1d(side, one[find_folds(one, other, corner_uv)])
    return np.stack([cleaned.F.ravel()[side], cleaned.F[:, (1, 2, 0)].ravel()[side]], axis=1)


@dataclass(frozen=True, eq=False)
class WantedSeams:
    """Edges (k, 2) of a model that must be seams, and edges that must not; by vertices after merging."""

    seams: IntArray
    no_seams: IntArray

    @property
    def empty(self) -> bool:
        """Whether there are no such edges."""
        return not (len(self.seams) or len(self.no_seams))

    def check(self, cleaned: CleanedMesh, found: IntArray) -> None:
        """Raise a ValueError unless the seams (s, 2) that were found are as wanted."""
        if self.empty:
            return
        n = len(cleaned.representatives)
        present = pair_keys(cleaned.representatives[found], n)
        corners = cleaned.representatives[cleaned.corners]
        keys, times = np.unique(edge_keys(corners, corners[:, (1, 2, 0)], n), return_counts=True)
        unwanted = pair_keys(self.no_seams, n)
        wrong = self.no_seams[np.isin(unwanted, present) & np.isin(unwanted, keys)]
        if len(wrong):
            raise ValueError(
                f"{edge_names(wrong)} of no_seams became seams: no charts without them were found, omit some"
            )
        wanted = pair_keys(self.seams, n)
        wrong = self.seams[np.isin(wanted, keys[times > 1]) & ~np.isin(wanted, present)]
        if len(wrong):
            raise ValueError(f"{edge_names(wrong)} of seams cannot be opened: add edges up to another seam")


def _read_wanted_seams(
    seams: ArrayLike | None, no_seams: ArrayLike | None, F: IntArray, joint: IntArray
) -> WantedSeams:
    """Check both lists of edges, given the model's triangles (f, 3) and the representative (n,) of each vertex."""
    must, must_not = _read_edges("seams", seams, F, joint), _read_edges("no_seams", no_seams, F, joint)
    both = must[np.isin(pair_keys(must, len(joint)), pair_keys(must_not, len(joint)))]
    if len(both):
        raise ValueError(f"{edge_names(both)}: both in seams and in no_seams: remove them from one of the lists")
    return WantedSeams(must, must_not)


def _read_edges(name: str, given: ArrayLike | None, F: IntArray, joint: IntArray) -> IntArray:
    """Return edges (k, 2) by representatives, each once, after checking them; see `_read_wanted_seams`."""
    n = len(joint)
    edges = index_array(name, [] if given is None else given)
    if not edges.size:
        edges = edges.reshape(0, 2)
    if edges.ndim != 2 or edges.shape[1] != 2:
        raise ValueError(f"{name} must have shape (k, 2), two vertices each, not {edges.shape}")
    check_range(name, edges, n)
    merged = np.sort(joint[edges], axis=1)
    absent = ~are_sides(merged, joint[F], n) | (merged[:, 0] == merged[:, 1])
    if absent.any():
        raise ValueError(f"{name}: {edge_names(edges[absent])}: not an edge of the mesh")
    return np.unique(merged, axis=0)


def _extend_seams(V: FloatArray, F: IntArray, hinges: Hinges, demanded: BoolArray, cost: FloatArray) -> BoolArray:
    """Extend demanded seams until they open the surface.

    A seam that ends inside a flat face or a developable piece is extended to its border or to another seam. A single
    edge elsewhere is extended by one edge.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    hinges : Hinges
    demanded : (f, 3) bool
        Sides that must be seams.
    cost : (f, 3) float64
        Factor on the cost of a seam at each side; infinite where none may be.

    Returns
    -------
    (f, 3) bool
        The demanded sides, and more.
    """
    chosen = hinges.touch(demanded)
    ends = hinges.ends(F)
    weight = hinges.price(cost)
    weight[hinges.flat] *= UNDIVIDED_COST
    piece = find_pieces(V, F, hinges, np.where(np.isfinite(cost), cost, 1.0)).label
    face = fans(F, ~hinges.mark_sides(hinges.flat, len(F)))[1]
    region = np.where(piece >= 0, piece, piece.max(initial=-1) + 1 + face)
    outside = np.ones(F.size, dtype=bool)
    outside[hinges.one] = outside[hinges.other] = False
    rim = mark(len(V), F.ravel()[outside], F[:, (1, 2, 0)].ravel()[outside])
    border = rim | mark(len(V), ends[region[hinges.first] != region[hinges.second]].ravel())
    degree = np.bincount(ends[chosen].ravel(), minlength=len(V))
    for tip in np.flatnonzero((degree == 1) & ~border).tolist():
        # A path to this tip may have been found already.
        if np.count_nonzero(ends[chosen] == tip) == 1:
            chosen[_reach(tip, ends, weight, chosen, border)] = True
    for edge in _list_single_edges(ends, chosen, rim):
        near = np.flatnonzero(np.isin(ends, ends[edge]).any(axis=1) & ~chosen & np.isfinite(weight))
        if near.size:
            chosen[near[np.argmin(weight[near])]] = True
    return demanded | hinges.mark_sides(chosen, len(F))


def _reach(tip: int, ends: IntArray, weight: FloatArray, chosen: BoolArray, border: BoolArray) -> IntArray:
    """Return the edges of the cheapest path from a tip of the chosen edges to a border vertex or to other chosen edges.

    The path does not touch the seam that it extends. Empty if there is none.
    """
    n = len(border)
    label = label_components(ends[chosen, 0], ends[chosen, 1], n)
    own = label == label[tip]
    own[tip] = False
    open_edge = np.flatnonzero(~chosen & np.isfinite(weight) & ~own[ends].any(axis=1))
    tail, head = ends[open_edge].T
    graph = csr_array((weight[open_edge], (tail, head)), shape=(n, n))
    distance, before = dijkstra(graph, directed=False, indices=tip, return_predecessors=True)
    goal = (border | mark(n, ends[chosen].ravel())) & ~own
    goal[tip] = False
    distance = np.where(goal, distance, np.inf)
    here = int(np.argmin(distance))
    if not np.isfinite(distance[here]):
        return open_edge[:0]
    steps = []
    while here != tip:
        steps.append((here, int(before[here])))
        here = int(before[here])
    return open_edge[np.isin(pair_keys(ends[open_edge], n), pair_keys(np.array(steps), n))]


def _list_single_edges(ends: IntArray, chosen: BoolArray, rim: BoolArray) -> list[int]:
    """Return the chosen edges that touch neither another one nor the boundary."""
    times = np.bincount(ends[chosen].ravel(), minlength=len(rim)) + rim
    return list(np.flatnonzero(chosen & (times[ends] == 1).all(axis=1)).tolist())
