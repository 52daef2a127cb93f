"""Pack islands into the unit square, rotated to their minimum boxes, with a common scale and a margin between them.

`quasiharmonic.apps.atlas.skyline` packs the islands' bounding boxes in several orders. A bisection finds the largest
scale at which one order fits. Islands are never mirrored. An exact check ensures that rounding inverts no triangle.
"""

from __future__ import annotations

from collections.abc import Sequence, Sized
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.skyline import Laid, laid
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    kind_of,
    map_array,
    named,
    real_array,
    triangle_array,
)

# Relative gap between the scale found and the smallest scale that does not fit.
_PRECISION = 0.002
# Space around each box for rounding, in addition to the margin.
_SLACK = 1e-12
# Boxes whose areas differ by at most this fraction count as equal; the one with the smallest rotation is taken.
_AS_SMALL = 1e-9
# Minimum share of the square's side that the largest island must keep.
_LEAST = 1e-6
# Positions of hull points computed per block.
_BLOCK = 1 << 20


def packed(
    uv: Sequence[ArrayLike], F: Sequence[ArrayLike], areas: ArrayLike, *, margin: float = 1 / 256
) -> list[FloatArray]:
    """Pack the islands of a map into the unit square without overlap, as large as possible and at one texel density.

    Parameters
    ----------
    uv : sequence of (m, 2) array
        Positions of each island's vertices.
    F : sequence of (k, 3) array of int
        Triangles of each island, in the island's numbering.
    areas : (i,) array
        Areas of the islands on the surface, in any unit. Packed areas are proportional to these. Islands without area
        on the surface or in the plane get the average scale.
    margin : float
        Minimum space between two islands' boxes, as a fraction of the square's side: 4/1024 is four texels of 1,024.
        The space to the square's sides is half of it, so that adjacent copies of the square keep the margin too.

    Returns
    -------
    list of (m, 2) float64
        New positions. The boxes around islands are within the square, and the margin separates them along an axis.
        Islands are rotated to their minimum box by at most 45°, and by another 90° if this fits better, and never
        mirrored. The result is deterministic.

    Raises
    ------
    ValueError
        If arrays are malformed or the sequences differ in length; if the islands do not fit with this margin; if
        an island has triangles so thin that rounding to positions in the square would invert them.
    """
    islands, triangles, surface = _checked(uv, F, areas, margin)
    if not islands:
        return []
    start = np.cumsum([0, *map(len, islands)])
    every = np.concatenate([rows + first for rows, first in zip(triangles, start, strict=False)])
    owner = np.repeat(np.arange(len(islands)), [len(rows) for rows in triangles])
    # Scale by a power of two to about unit size, so that squares do not overflow.
    largest = np.abs(np.concatenate(islands)).max()
    islands = [np.ldexp(points, -int(np.frexp(largest)[1])) for points in islands]
    before = inverted_triangles(every, np.concatenate(islands))

    turned = [_turned(points, _least_box(points)) for points in islands]
    for i in np.unique(owner[np.setdiff1d(inverted_triangles(every, np.concatenate(turned)), before)]).tolist():
        turned[i] = islands[i]
    turned = [points - points.min(axis=0) for points in turned]
    scale = _densities(turned, triangles, surface)
    sizes = scale[:, None] * np.array([points.max(axis=0) for points in turned])
    whole, places = _largest_scale(sizes, margin)
    found = [_placed(points, whole * scale[i], places[i], margin / 2 + _SLACK) for i, points in enumerate(turned)]
    lost = np.setdiff1d(inverted_triangles(every, np.concatenate(found)), before)
    if lost.size:
        i = int(owner[lost[0]])
        own = lost[owner[lost] == i] - int(np.searchsorted(owner, i))
        raise ValueError(
            f"island {i}: its {named('triangle', 'triangles', own)} would be inverted by rounding in the unit square, "
            "too thin for that: polish the map first, or do not pack it"
        )
    return found


def _checked(
    uv: Sequence[ArrayLike], F: Sequence[ArrayLike], areas: ArrayLike, margin: float
) -> tuple[list[FloatArray], list[IntArray], FloatArray]:
    """Check the arguments and convert them to arrays; the ValueError names the wrong ones."""
    surface = real_array("areas", areas)
    for name, arrays in (("uv", uv), ("F", F)):
        if not isinstance(arrays, Sized) or isinstance(arrays, str | bytes):
            raise ValueError(f"{name} must be a list of arrays, one for each island, not {kind_of(arrays)}")
    if surface.ndim != 1 or not len(uv) == len(F) == len(surface):
        raise ValueError(
            f"uv has {len(uv)} islands, F has {len(F)}, and areas has shape {surface.shape}: give one of each for "
            "each island"
        )
    wrong = np.flatnonzero(~((surface >= 0) & np.isfinite(surface)))
    if wrong.size:
        raise ValueError(f"areas must be finite and not negative: check {named('island', 'islands', wrong)}")
    if not 0 <= margin < 1:
        raise ValueError(f"margin must be a fraction of the square's side, at least 0 and less than 1, not {margin}")
    islands = [map_array(f"uv[{i}]", points) for i, points in enumerate(uv)]
    return islands, [triangle_array(rows, len(points)) for rows, points in zip(F, islands, strict=True)], surface


def _least_box(points: FloatArray) -> complex:
    """The direction of the minimum box around points, as a complex number of length 1, at most 45° off the x-axis.

    One side of this box lies along a side of the convex hull (Freeman and Shapira 1975).
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        # There are too few points, or all are collinear.
        return 1.0 + 0.0j
    corners = np.ascontiguousarray(hull).view(np.complex128).ravel()
    side = np.roll(corners, -1) - corners
    along = np.concatenate([[1.0], side[side != 0] / np.abs(side[side != 0])])
    along *= 1j ** -np.round(np.angle(along) / (np.pi / 2))
    area = np.concatenate([_box_areas(corners, some) for some in np.array_split(along, 1 + along.size**2 // _BLOCK)])
    small = np.flatnonzero(area <= (1 + _AS_SMALL) * area.min())
    return complex(along[small[np.argmin(np.abs(along[small].imag))]])


def _box_areas(corners: ComplexArray, along: ComplexArray) -> FloatArray:
    """Areas of the bounding boxes of points with sides along given directions."""
    seen = corners[None, :] * along.conj()[:, None]
    return np.asarray(np.ptp(seen.real, axis=1) * np.ptp(seen.imag, axis=1))


def _turned(points: FloatArray, along: complex) -> FloatArray:
    """Rotate points so that a direction becomes the x-axis; the same array if it already is."""
    c, s = along.real, along.imag
    return points if s == 0 else points @ np.array([[c, -s], [s, c]])


def _densities(islands: list[FloatArray], F: list[IntArray], surface: FloatArray) -> FloatArray:
    """The scale of each island that makes packed areas proportional to areas on the surface."""
    plane = np.array([_area(points, rows) for points, rows in zip(islands, F, strict=True)])
    surface = surface / (surface.max() or 1.0)
    known = (plane > 0) & (surface > 0)
    mean = surface[known].sum() / plane[known].sum() if known.any() else 1.0
    return np.sqrt(np.divide(surface, plane, out=np.full(len(plane), mean), where=known))


def _area(uv: FloatArray, F: IntArray) -> float:
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    return float(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)


def _largest_scale(sizes: FloatArray, margin: float) -> tuple[float, list[Laid]]:
    """The largest scale, within the precision, at which boxes (k, 2) fit, and their positions."""
    room = margin + 2 * _SLACK
    # The best order depends on the boxes.
    longest, shortest = sizes.max(axis=1), sizes.min(axis=1)
    orders = [np.argsort(-by, kind="stable") for by in (longest, longest * shortest, longest + shortest, shortest)]

    def at(scale: float) -> list[Laid] | None:
        boxes = [(scale * w + room, scale * h + room) for w, h in sizes.tolist()]
        for order in orders:
            found = laid([boxes[i] for i in order])
            if found is not None:
                return [found[k] for k in np.argsort(order)]
        return None

    large = longest.max() or 1.0
    low, high, best = 0.0, 1 / large, at(0.0)
    scale = min((1 - room) / large, 1 / sqrt(max((longest * shortest).sum(), _LEAST * large**2)))
    # If margins leave almost no space, the search stops and reports that the islands do not fit.
    while best is not None and high - low > _PRECISION * high and high * large > _LEAST:
        found = at(scale)
        if found is None:
            high = scale
        else:
            low, best = scale, found
        scale = (low + high) / 2 if low > 0 else 0.8 * high
    if best is None or (low == 0 and longest.max() > 0):
        raise ValueError(
            f"{len(sizes)} islands do not fit with a margin of {margin:g} of the square's side around each: lower the "
            "margin"
        )
    return low, best


def _placed(points: FloatArray, scale: float, place: Laid, inset: float) -> FloatArray:
    """Place an island whose box has its corner at the origin: rotate by 90° if needed, scale and shift it."""
    if place.turned:
        points = np.stack([points[:, 1].max() - points[:, 1], points[:, 0]], axis=1)
    return np.asarray(scale * points + (place.x + inset, place.y + inset))
