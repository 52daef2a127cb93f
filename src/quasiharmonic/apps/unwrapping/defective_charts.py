"""The exact verdict on the charts of a model with defects, as its file stores them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict, certify
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh, clean
from quasiharmonic.geometry.mesh.topology import edge_keys, find_twins, label_components
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, names_of


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
        return {
            "reversed_triangles": self.reversed.tolist(),
            "repeated_triangles": self.repeated.tolist(),
            "degenerate_triangles": self.degenerate.tolist(),
        }

    def summary(self) -> str:
        """Return one line for each kind."""
        kinds = (
            (self.reversed, "verified with the winding of the neighbours, which is the opposite one"),
            (self.repeated, "left out, because an earlier triangle has the same vertices"),
            (self.degenerate, "left out, because there is no area on the model"),
        )
        return "\n".join(f"{names_of('triangle', 'triangles', found)}: {what}" for found, what in kinds if found.size)


def certify_defective(V: FloatArray, F: IntArray, corner_uv: FloatArray) -> tuple[AtlasVerdict, SetApart] | None:
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

    Returns
    -------
    AtlasVerdict and SetApart, or None
        The indices are those of ``F``. None if all triangles are verified as they are, if no triangle has an area, or
        if a chart consists of excluded triangles alone and overlaps another.
    """
    try:
        cleaned = clean(V, F)
    except ValueError:
        return None
    spots = np.unique(V + 0.0, axis=0, return_inverse=True)[1].reshape(-1)[F]
    places, inverse = np.unique(corner_uv.reshape(-1, 2) + 0.0, axis=0, return_inverse=True)
    place = inverse.reshape(F.shape)
    both = spots * len(places) + place
    left = _find_copies(cleaned, both, place, len(places))
    rows = np.flatnonzero(~left)
    keys, first, corners = np.unique(both[rows], return_index=True, return_inverse=True)
    G = corners.reshape(-1, 3)
    preferred = np.zeros(len(F), dtype=np.int64)
    preferred[cleaned.triangles] = np.where(cleaned.flipped, -1, 1)
    turned = _orient(G, len(keys), preferred[rows])
    G[turned] = G[turned][:, (0, 2, 1)]
    points, uv = V[F[rows].ravel()[first]], places[keys % len(places)]
    verdict = certify(SeamedMesh(points, G, G, uv))
    # A texture is mirrored if `unwrap` treated an inside-out model as turned outward.
    inward = len(verdict.islands) == 1 and not verdict.injective and bool((cleaned.facing < 0).all())
    if inward:
        verdict = certify(SeamedMesh(points, G[:, ::-1], G[:, ::-1], uv))
    elif not (left.any() or turned.any()):
        return None
    own = cleaned.excluded[~left[cleaned.excluded]]
    islands = tuple(
        replace(one, triangles=rows[one.triangles], inverted=rows[one.inverted], mirrored=one.mirrored or inward)
        for one in verdict.islands
    )
    unsure = [k for k, one in enumerate(islands) if np.isin(one.triangles, own).all()] if own.size else []
    if np.isin(verdict.overlapping, unsure).any():
        return None
    repeated = cleaned.excluded[cleaned.repeated & left[cleaned.excluded]]
    apart = SetApart(rows[turned], repeated, np.setdiff1d(np.flatnonzero(left), repeated))
    return replace(verdict, islands=islands), apart


def _find_copies(cleaned: CleanedMesh, keys: IntArray, place: IntArray, count: int) -> BoolArray:
    """Return which triangles are excluded by `clean`, or thin, and have the texture coordinates of another triangle.

    Parameters
    ----------
    cleaned : CleanedMesh
    keys : (f, 3) int64
        Number of the position and the coordinates at each corner. A repeated triangle must agree in both.
    place : (f, 3) int64
        Number of the coordinates, below ``count``. A triangle without area takes those of another triangle. Its
        corners may also lie at an edge or a corner of others.
    """
    copies = np.zeros(len(place), dtype=np.bool_)
    order = np.concatenate([cleaned.triangles, cleaned.excluded])
    of_excluded = slice(len(cleaned.triangles), None)
    same, near = ((find_twins(table[order]) != np.arange(len(order)))[of_excluded] for table in (keys, place))
    copies[cleaned.excluded] = np.where(cleaned.repeated, same, near)
    ahead = place[:, (1, 2, 0)]
    collapsed = (place == ahead).any(axis=1)
    others = ~collapsed & ~copies
    known = np.union1d(edge_keys(place[others], ahead[others], count), edge_keys(place[others], place[others], count))
    flat = np.concatenate([cleaned.excluded[~cleaned.repeated], cleaned.triangles[cleaned.widened]])
    flat = flat[collapsed[flat]]
    copies[flat] |= np.isin(edge_keys(place[flat], ahead[flat], count), known).all(axis=1)
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
    turned: BoolArray = (odd ^ (votes < 0)[chart]) & (label[::2] != label[1::2])
    return turned
