"""Planes of symmetry of a model, normal to an axis, and the mirror image of each of its elements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from quasiharmonic.apps.unwrapping.hinges import Hinges
from quasiharmonic.geometry.mesh.topology import pair_keys
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# A vertex has a mirror image if a vertex is this close to it, relative to the diagonal of the model's box.
_TOLERANCE = 1e-6
_AXES = "xyz"
# A smaller share of mirror images is due to chance.
_WORTH_REPORTING = 0.9
# Of about so many vertices, all over a model, this share may lack an image; otherwise the others are not examined.
_SAMPLES, _MOST_WITHOUT = 500, 0.5


class Symmetry(NamedTuple):
    """What `unwrap` did about the symmetry of a model.

    Attributes
    ----------
    axis : str or None
        Axis normal to the plane with most mirror images; None if no plane was sought, or ``"auto"`` found none with
        many.
    share : float
        Share of the vertices that have a mirror image, to 1e-6 of the diagonal of the model's box.
    applied : bool
        Whether seams and charts are mirrored.
    reason : str
        Why not; empty if they are, and for ``"auto"`` if less than 90 % of the vertices have a mirror image.
    """

    axis: str | None
    share: float
    applied: bool
    reason: str


@dataclass(frozen=True, eq=False)
class Mirror:
    """The mirror image of every element of a surface.

    Attributes
    ----------
    vertex : (n,) int64
        Vertices on the plane are their own images.
    triangle : (f,) int64
    positive : (f,) bool
        Triangles on one side of the plane. Triangles that cross it are on neither side.
    """

    vertex: IntArray
    triangle: IntArray
    positive: BoolArray

    def select(self, rows: IntArray) -> Mirror | None:
        """Return the images of some triangles, ascending, by their place among them; None if an image is missing."""
        image = self.triangle[rows]
        place = np.searchsorted(rows, image)
        if not np.array_equal(rows[np.minimum(place, len(rows) - 1)], image):
            return None
        return Mirror(self.vertex, place, self.positive[rows])

    def of_hinges(self, hinges: Hinges, F: IntArray) -> IntArray:
        """Return the image (e,) of each hinge."""
        ends, n = hinges.ends(F), len(self.vertex)
        key, image = pair_keys(ends, n), pair_keys(self.vertex[ends], n)
        order = np.argsort(key)
        return np.asarray(order[np.searchsorted(key[order], image)])


def find_mirror(V: FloatArray, F: IntArray, axis: str) -> tuple[Mirror | None, Symmetry]:
    """Find a plane of symmetry through the middle of a model.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    axis : str
        ``"x"``, ``"y"``, ``"z"``, or ``"auto"`` for the first one with an exact plane.

    Returns
    -------
    Mirror or None
        None unless every vertex and every triangle has a mirror image.
    Symmetry
        The plane with most images; ``applied`` tells whether it has all of them.
    """
    best = Symmetry(None, 0.0, False, "")
    tree = KDTree(V)
    low, high = V.min(axis=0), V.max(axis=0)
    reach = _TOLERANCE * float(np.linalg.norm(high - low))
    for k, name in enumerate(_AXES):
        if axis not in ("auto", name):
            continue
        mirrored = V.copy()
        mirrored[:, k] = low[k] + high[k] - V[:, k]
        if axis == "auto":
            some, _ = tree.query(mirrored[:: max(len(V) // _SAMPLES, 1)], distance_upper_bound=reach)
            if np.isinf(some).mean() > _MOST_WITHOUT:
                continue
        distance, image = tree.query(mirrored, distance_upper_bound=reach)
        there = np.isfinite(distance)
        share = float(np.count_nonzero(there)) / len(V)
        mirror = _pair(F, image.astype(np.int64), V[:, k] - (low[k] + high[k]) / 2) if there.all() else None
        if mirror is not None:
            return mirror, Symmetry(name, 1.0, True, "")
        if best.axis is None or share > best.share:
            missing = "not every triangle has a mirror image" if there.all() else "not every vertex has a mirror image"
            best = Symmetry(name, share, False, missing)
    if axis == "auto" and best.share < _WORTH_REPORTING:
        best = best._replace(reason="")
    return None, best


def _pair(F: IntArray, image: IntArray, height: FloatArray) -> Mirror | None:
    """Return the mirror of triangles given the images (n,) of the vertices; None if a triangle has no image."""
    if not np.array_equal(image[image], np.arange(len(image))):
        return None
    rows, images = np.sort(F, axis=1), np.sort(image[F], axis=1)
    order, others = np.lexsort(rows.T), np.lexsort(images.T)
    if not np.array_equal(rows[order], images[others]):
        return None
    triangle = np.empty(len(F), dtype=np.int64)
    triangle[others] = order
    at = np.where(image == np.arange(len(image)), 0.0, height)[F]
    positive: BoolArray = np.logical_and((at >= 0).all(axis=1), (at > 0).any(axis=1))
    return Mirror(image, triangle, positive)


def check_symmetry(found: Symmetry, mirror: Mirror | None, chart: IntArray) -> Symmetry:
    """Return what was done, given the chart (f,) of each triangle in the end."""
    if mirror is None:
        return found
    pairs = np.unique(np.stack([chart, chart[mirror.triangle]], axis=1), axis=0)
    if len(pairs) == int(chart.max(initial=-1)) + 1:
        return found
    reason = "triangles of curved parts cross the plane, or mirrored seams would be much longer"
    return found._replace(applied=False, reason=reason)


def describe_symmetry(found: Symmetry) -> list[str]:
    """Return a line on the symmetry of a model, if an axis was chosen, or most vertices have mirror images."""
    if found.applied:
        return [f"symmetric in {found.axis}: seams and charts are mirrored"]
    if not found.reason:
        return []
    return [
        f"{100 * found.share:.4g} % of the vertices have a mirror image in {found.axis}: not mirrored, {found.reason}"
    ]
