"""The exact verdict on charts in a texture: each chart is bijective, and no two charts share a point.

`UnwrapCertificate` is the verdict on the result of `unwrap`. `certify_defective` verifies the charts of a model with
defects as its file stores them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict, certify
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh, clean, turn_corners
from quasiharmonic.apps.unwrapping.layout import ChartLayout
from quasiharmonic.geometry.curves.arcs import nearest_on_segments
from quasiharmonic.geometry.exact import certificate
from quasiharmonic.geometry.exact.box_pairs import box_pairs
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.exact.loops import LoopEdges, Obstacle
from quasiharmonic.geometry.mesh.topology import edge_keys, find_twins, group_by_label, label_components
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, as_offsets, count_of, mark, names_of
from quasiharmonic.util.outcome import Verdict, as_plain

# Largest distance between the boxes of stacked charts, in sides of the texture. Congruent charts may differ by a share
# of 1e-4 of their radius.
_SAME_PLACE = 1e-4


@dataclass(frozen=True, eq=False, repr=False)
class UnwrapCertificate(Verdict):
    """The exact verdict on the stored texture coordinates of `unwrap`.

    The orientation of every triangle is that of the cleaned mesh. Degenerate and repeated triangles of the input are
    not part of it.

    Attributes
    ----------
    bijective_charts : (c,) bool
        Whether each chart covers no point of the plane twice, with every triangle strictly positive.
    inverted, degenerate : (k,) int64
        Triangles of the input whose images are clockwise, or have zero area. Rounding can cause this in triangles that
        are extremely thin.
    overlapping : (p, 2) int64
        Pairs of charts that share points.
    clearance : float
        Smallest distance between two charts, in texels, in double precision; infinite if it exceeds the padding by
        more than half.

    See Also
    --------
    unwrap : Makes it.
    quasiharmonic.atlas.certify : The verdict on other texture coordinates.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> certificate = unwrap(*starfish(3, 4)).certificate
    >>> certificate.bijective, bool(certificate.bijective_charts.all()), certificate.clearance >= 4
    (True, True, True)
    """

    bijective_charts: BoolArray
    inverted: IntArray
    degenerate: IntArray
    overlapping: IntArray
    clearance: float

    @property
    def injective(self) -> bool:
        """Whether every triangle is strictly positive."""
        return not (self.inverted.size or self.degenerate.size)

    @property
    def valid(self) -> bool:
        """Whether every triangle is strictly positive; equal to `injective`."""
        return self.injective

    @property
    def disjoint(self) -> bool:
        """Whether no two charts share a point."""
        return not len(self.overlapping)

    @property
    def bijective(self) -> bool:
        """Whether every chart is bijective and no two charts share a point."""
        return bool(self.bijective_charts.all()) and self.disjoint

    def summary(self) -> str:
        """Describe the verdict in one or two sentences."""
        count = len(self.bijective_charts)
        said = [f"{int(self.bijective_charts.sum())} of {count_of('chart', 'charts', count)} bijective"]
        said.append("no overlaps" if self.disjoint else f"{count_of('pair', 'pairs', len(self.overlapping))} overlap")
        for found, what in ((self.inverted, "inverted"), (self.degenerate, "degenerate")):
            if found.size:
                said.append(f"{names_of('triangle', 'triangles', found)} {what}")
        return ", ".join(said)

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON."""
        return {
            **super().to_dict(),
            **as_plain(self, "injective", "disjoint"),
            "not_bijective_charts": np.flatnonzero(~self.bijective_charts).tolist(),
            **as_plain(self, "inverted", "degenerate", "overlapping"),
            "clearance": self.clearance if np.isfinite(self.clearance) else None,
        }


def certify_charts(
    layout: ChartLayout, triangles: IntArray, *, size: tuple[int, int], padding: float, stacked: bool
) -> UnwrapCertificate:
    """Certify charts exactly.

    Parameters
    ----------
    layout : ChartLayout
    triangles : (k,) int64
        Number of each triangle of the layout in the input.
    size : two int
        Width and height of the texture in texels.
    padding : float
        Required distance between charts in texels.
    stacked : bool
        Whether charts at the same place are intended. They are certified in layers, with one chart of each place, and
        stay where they are: a shift could round kept coordinates.
    """
    chart, chart_of_vertex = layout.chart, np.zeros(len(layout.uv), dtype=np.int64)
    chart_of_vertex[layout.F] = chart[:, None]
    layers = [np.arange(len(chart))]
    if stacked:
        layers = group_by_label(_rank_in_stack(layout.uv, chart_of_vertex)[chart])
    inverted, degenerate, faulty, overlapping = list[int](), list[int](), set[int](), list[tuple[int, int]]()
    clearance = np.inf
    for rows in layers:
        used, vertex = np.unique(layout.F[rows], return_inverse=True)
        F, uv, charts = vertex.reshape(-1, 3), layout.uv[used], chart_of_vertex[used]
        whole = certificate.certify(F, uv)
        inverted += triangles[rows[whole.inverted]].tolist()
        degenerate += triangles[rows[np.concatenate([whole.degenerate, whole.nonfinite])]].tolist()
        faulty.update(chart[rows[np.concatenate([whole.inverted, whole.degenerate, whole.nonfinite])]].tolist())
        if any(reason.kind is not Obstacle.NOT_INJECTIVE for reason in whole.reasons):
            wrong, pairs = _find_faults(F, uv, charts, whole)
            faulty |= wrong
            overlapping += pairs
        clearance = min(clearance, measure_clearance(whole.loops, uv * size, charts, 1.5 * padding))
    return UnwrapCertificate(
        bijective_charts=~mark(int(chart.max(initial=-1)) + 1, np.array(sorted(faulty), dtype=np.int64)),
        inverted=np.array(sorted(inverted), dtype=np.int64),
        degenerate=np.array(sorted(degenerate), dtype=np.int64),
        overlapping=np.array(sorted(overlapping), dtype=np.int64).reshape(-1, 2),
        clearance=clearance,
    )


def _rank_in_stack(uv: FloatArray, chart: IntArray) -> IntArray:
    """Return for each chart the number of charts before it at the same place, up to rounding."""
    order = np.argsort(chart, kind="stable")
    starts = np.flatnonzero(np.diff(chart[order], prepend=-1))
    boxes = np.hstack(
        [np.minimum.reduceat(uv[order], as_offsets(starts)), np.maximum.reduceat(uv[order], as_offsets(starts))]
    )
    pairs = cKDTree(boxes).query_pairs(_SAME_PLACE, output_type="ndarray").astype(np.int64)
    label = label_components(pairs[:, 0], pairs[:, 1], len(boxes))
    rank = np.zeros(len(boxes), dtype=np.int64)
    for group in group_by_label(label):
        rank[group] = np.arange(group.size)
    return rank


def _find_faults(
    F: IntArray, uv: FloatArray, chart_of_vertex: IntArray, whole: Certificate
) -> tuple[set[int], list[tuple[int, int]]]:
    """Return the charts that are not bijective, and the pairs of others that overlap, given the verdict on all."""
    label = chart_of_vertex[F[:, 0]]
    parts = {int(label[rows[0]]): F[rows] for rows in group_by_label(label)}

    def is_bijective(*charts: int) -> bool:
        used, vertex = np.unique(np.concatenate([parts[chart] for chart in charts]), return_inverse=True)
        return bool(certificate.certify(vertex.reshape(-1, 3), uv[used]).bijective)

    faulty = {chart for chart in parts if not is_bijective(chart)}
    candidates: set[tuple[int, int]] = set()
    for reason in whole.reasons:
        around = sorted({int(chart_of_vertex[whole.loops[loop][0]]) for loop in reason.loops} - faulty)
        candidates.update((one, other) for k, one in enumerate(around) for other in around[k + 1 :])
    return faulty, [pair for pair in sorted(candidates) if not is_bijective(*pair)]


def measure_clearance(loops: tuple[IntArray, ...], uv: FloatArray, chart_of_vertex: IntArray, reach: float) -> float:
    """Return the smallest distance between boundaries of different charts; infinity if it exceeds ``reach``."""
    if len(loops) < 2:
        return np.inf
    curves = LoopEdges.of(list(loops), uv)
    order = curves.order_by_place()
    p, q, owner = curves.p[order], curves.q[order], chart_of_vertex[curves.ends[order, 0]]
    least = np.inf
    for i, j in box_pairs(np.minimum(p, q) - reach / 2, np.maximum(p, q) + reach / 2):
        apart = owner[i] != owner[j]
        i, j = i[apart], j[apart]
        for start in range(0, i.size, 1 << 16):
            one, other = i[start : start + (1 << 16)], j[start : start + (1 << 16)]
            for a, b, ends in ((one, other, p), (one, other, q), (other, one, p), (other, one, q)):
                least = min(least, float(nearest_on_segments(ends[a], p[b], q[b])[1].min()))
    return least if least <= reach else np.inf


@dataclass(frozen=True, eq=False)
class SetApart:
    """Triangles of a model with defects that the verdict on its charts reverses or leaves out, as `unwrap` does.

    A triangle is left out only if its corners have the texture coordinates of another triangle.
    """

    reversed: IntArray
    repeated: IntArray
    degenerate: IntArray

    def to_dict(self) -> dict[str, list[int]]:
        """Return the triangles for JSON."""
        return {f"{kind}_triangles": found.tolist() for kind, found in vars(self).items()}

    def summary(self) -> str:
        """Return one line for each kind."""
        kinds = (
            (self.reversed, "verified with the winding of the neighbours, which is the opposite one"),
            (self.repeated, "left out, because an earlier triangle has the same vertices"),
            (self.degenerate, "left out, because there is no area on the model"),
        )
        return "\n".join(f"{names_of('triangle', 'triangles', found)}: {what}" for found, what in kinds if found.size)


def certify_defective(
    V: FloatArray, F: IntArray, corner_uv: FloatArray, numbers: IntArray
) -> tuple[AtlasVerdict, SetApart] | None:
    """Certify the charts of a model with defects.

    In a file of single precision, positions may coincide that differ in the model. So triangles without area, and
    triangles with the positions of an earlier one, are verified like the others if they have coordinates of their own.

    Parameters
    ----------
    V : (n, 3) float64
        Positions in the file.
    F : (f, 3) int64
        Triangles.
    corner_uv : (f, 3, 2) float64
        Texture coordinates of every corner.
    numbers : (f,) int64
        Ascending numbers of the triangles in the verdict.

    Returns
    -------
    AtlasVerdict and SetApart, or None
        None if all triangles are verified as they are, if no triangle has an area, or
        if a chart consists of excluded triangles alone and overlaps another.
    """
    try:
        cleaned = clean(V, F)
    except ValueError:
        return None
    texture_key = _number_rows(corner_uv.reshape(-1, 2)).reshape(F.shape)
    pairs = _number_rows(V)[F] * (int(texture_key.max()) + 1) + texture_key
    corner_key = np.unique(pairs, return_inverse=True)[1].reshape(F.shape)
    excluded_copies = _find_copies(cleaned, corner_key, texture_key)
    rows = np.flatnonzero(~excluded_copies)
    preferred = np.zeros(len(F), dtype=np.int64)
    preferred[cleaned.triangles] = np.where(cleaned.flipped, -1, 1)
    mesh, turned = _orient_mesh(V[F[rows]], corner_uv[rows], corner_key[rows], preferred[rows])
    changed, inside_out = bool(excluded_copies.any() or turned.any()), bool((cleaned.facing < 0).all())
    if not (changed or inside_out):
        return None
    verdict = certify(mesh)
    # A texture is mirrored if `unwrap` treated an inside-out model as turned outward.
    inward = inside_out and len(verdict.islands) == 1 and not verdict.injective
    if inward:
        verdict = certify(SeamedMesh(mesh.V, mesh.F[:, ::-1], mesh.F[:, ::-1], mesh.uv))
    elif not changed:
        return None
    excluded = mark(len(F), cleaned.excluded)
    unsure = [k for k, one in enumerate(verdict.islands) if excluded[rows[one.triangles]].all()]
    if np.isin(verdict.overlapping, unsure).any():
        return None
    repeated = cleaned.excluded[cleaned.repeated & excluded_copies[cleaned.excluded]]
    left_out = np.setdiff1d(np.flatnonzero(excluded_copies), repeated)
    apart = SetApart(*(numbers[found] for found in (rows[turned], repeated, left_out)))
    shown = numbers[rows]
    islands = tuple(
        replace(one, triangles=shown[one.triangles], inverted=shown[one.inverted], mirrored=one.mirrored or inward)
        for one in verdict.islands
    )
    return replace(verdict, islands=islands), apart


def _number_rows(rows: FloatArray) -> IntArray:
    """Return a number (n,) for each row, the same for equal rows; −0 equals 0."""
    return np.unique(rows + 0.0, axis=0, return_inverse=True)[1].reshape(-1)


def _orient_mesh(
    points: FloatArray, corner_uv: FloatArray, corner_key: IntArray, preferred: IntArray
) -> tuple[SeamedMesh, BoolArray]:
    """Return triangles as a mesh with consistently oriented charts, and which of them are reversed; see `_orient`.

    Corners, with positions (k, 3, 3) and texture coordinates (k, 3, 2), become one vertex if their keys (k, 3) agree.
    """
    _, first, inverse = np.unique(corner_key, return_index=True, return_inverse=True)
    vertex = inverse.reshape(-1, 3)
    turned = _orient(vertex, first.size, preferred)
    vertex = turn_corners(vertex, turned)
    return SeamedMesh(points.reshape(-1, 3)[first], vertex, vertex, corner_uv.reshape(-1, 2)[first]), turned


def _find_copies(cleaned: CleanedMesh, corner_key: IntArray, texture_key: IntArray) -> BoolArray:
    """Return which triangles are excluded by `clean`, or thin, and have the texture coordinates of another triangle.

    Parameters
    ----------
    cleaned : CleanedMesh
    corner_key, texture_key : (f, 3) int64
        Number of the position and the texture coordinates at each corner, and of the latter alone.
    """
    order = np.concatenate([cleaned.triangles, cleaned.excluded])
    of_excluded = slice(len(cleaned.triangles), None)
    agrees, covers = (
        (find_twins(keys[order]) != np.arange(len(order)))[of_excluded] for keys in (corner_key, texture_key)
    )
    # A repeated triangle is a copy if an earlier one has the same positions and coordinates at its corners. A triangle
    # without area is one if an earlier one has these coordinates, because its own corners may be anywhere.
    copies = np.zeros(len(texture_key), dtype=np.bool_)
    copies[cleaned.excluded] = np.where(cleaned.repeated, agrees, covers)
    # A triangle without height whose image is a segment or a point is one if each of its sides lies on an edge or at a
    # corner of triangles with an area in the texture. A corner counts as an edge from itself to itself.
    n, ahead = int(texture_key.max()) + 1, texture_key[:, (1, 2, 0)]
    sides, collapsed = edge_keys(texture_key, ahead, n), (texture_key == ahead).any(axis=1)
    proper = ~collapsed & ~copies
    edges_and_corners = np.union1d(sides[proper], edge_keys(texture_key[proper], texture_key[proper], n))
    flat = np.concatenate([cleaned.excluded[~cleaned.repeated], cleaned.triangles[cleaned.widened]])
    flat = flat[collapsed[flat]]
    copies[flat] |= np.isin(sides[flat], edges_and_corners).all(axis=1)
    return copies


def _orient(F: IntArray, n: int, preferred: IntArray) -> BoolArray:
    """Return which triangles to reverse so that each chart is consistently oriented.

    Charts consist of triangles (f, 3) that are joined at edges of exactly two. Charts that cannot be oriented stay.
    ``preferred`` (f,) is 1 for a triangle that had better keep its orientation, -1 for one to reverse, 0 otherwise.
    """
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    key = edge_keys(tail, head, n)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    first = first[np.diff(first, append=key.size) == 2]
    one, other = order[first], order[first + 1]
    parallel = tail[one] == tail[other]
    # Node 2 t is triangle t as it is, and node 2 t + 1 is its reverse.
    one, other = 2 * (one // 3), 2 * (other // 3) + parallel
    label = label_components(np.concatenate([one, one + 1]), np.concatenate([other, other ^ 1]), 2 * len(F))
    chart, odd = label[::2] // 2, label[::2] % 2 == 1
    votes = np.bincount(chart, np.where(odd, -preferred, preferred), len(F))
    return np.asarray((odd ^ (votes < 0)[chart]) & (label[::2] != label[1::2]))
