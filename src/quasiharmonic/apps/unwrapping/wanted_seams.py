"""Seams that the user wants, and edges that must not become seams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.apps.unwrapping.hinges import UNDIVIDED_COST, Hinges
from quasiharmonic.apps.unwrapping.pieces import find_pieces
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import are_sides, edge_keys, label_components, mark_sides, pair_keys
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, check_range, edge_names, index_array, mark


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


def read_wanted_seams(seams: ArrayLike | None, no_seams: ArrayLike | None, F: IntArray, joint: IntArray) -> WantedSeams:
    """Check both lists of edges, given the model's triangles (f, 3) and the representative (n,) of each vertex."""
    must, must_not = read_edges("seams", seams, F, joint), read_edges("no_seams", no_seams, F, joint)
    both = must[np.isin(pair_keys(must, len(joint)), pair_keys(must_not, len(joint)))]
    if len(both):
        raise ValueError(f"{edge_names(both)}: both in seams and in no_seams: remove them from one of the lists")
    return WantedSeams(must, must_not)


def read_edges(name: str, given: ArrayLike | None, F: IntArray, joint: IntArray) -> IntArray:
    """Return edges (k, 2) by representatives, each once, after checking them; see `read_wanted_seams`."""
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


def mark_edges(cleaned: CleanedMesh, edges: IntArray) -> BoolArray:
    """Return a mask (f', 3) of the sides of the cleaned mesh at edges (k, 2), given by representatives."""
    return mark_sides(cleaned.representatives[cleaned.corners], edges, len(cleaned.representatives))


def extend_seams(V: FloatArray, F: IntArray, hinges: Hinges, demanded: BoolArray, cost: FloatArray) -> BoolArray:
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
    alone: list[int] = np.flatnonzero(chosen & (times[ends] == 1).all(axis=1)).tolist()
    return alone
