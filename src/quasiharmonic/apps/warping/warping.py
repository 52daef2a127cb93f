"""Warping of pictures by landmarks, with their border or along any planar map, with no folds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.apps.inverse.inverse import InverseMap
from quasiharmonic.apps.warping.landmarks import CurvePair, carried, landmarks_of, on_border, picture_mesh
from quasiharmonic.energies.bending import Pull, bend_map
from quasiharmonic.energies.energies import Energy
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.problem import Domain
from quasiharmonic.problem.result import MapResult
from quasiharmonic.solver.refine.mapping import injective_map
from quasiharmonic.util.arrays import FloatArray, IntArray, map_array, not_negative, whole_number

# Pixels drawn at a time: what is in work stays in the cache.
_PIXELS = 1 << 15
# Triangles with more pixels than this on average are filled one by one.
LARGE = 100


@dataclass(frozen=True, eq=False)
class WarpResult:
    """A warped picture and the map that warped it.

    Attributes
    ----------
    image : array
        Of the picture's shape and dtype.
    points : (n, 2) float64
        Vertices of a mesh of the picture, x to the right and y down, in pixels.
    F : (f, 3) int64
        Its triangles.
    positions : (n, 2) float64
        Where they go.
    result : MapResult
        With the certificate; the warp folds nowhere if it is bijective.
    """

    image: NDArray[Any]
    points: FloatArray
    F: IntArray
    positions: FloatArray
    result: MapResult


def warp_by_landmarks(
    image: ArrayLike,
    landmarks: ArrayLike,
    target: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    curves: Sequence[CurvePair] = (),
    smoothness: float | None = None,
    resolution: int = 48,
    energy: str | Energy = "symmetric-dirichlet",
) -> WarpResult:
    """Warp a picture such that landmarks go where they are told and nothing folds.

    The border stays, unless landmarks are on it: then it goes along, straight between one and the next. Corners count
    as landmarks that stay, if they are not given. So any number of landmarks will do, also one or none.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) array
        Any real dtype.
    landmarks : (k, 2) array
        Points of the picture, x to the right and y down; the centre of the first pixel is (0, 0), and of the last
        (width − 1, height − 1).
    target : (k, 2) array
        Where they go. The picture keeps its size: what goes beyond is cut off, what nothing comes to is 0.
    weights : (k,) array, optional
        How much landmarks inside the picture count: each is missed where that costs less than getting there. To miss
        one of weight 1 by a pixel costs as much as a unit of energy on a pixel. Those of infinite weight arrive
        exactly, as all do by default.
    curves : sequence of pairs of (a, 2) and (b, 2) arrays, optional
        Polylines inside the picture and those that they go to, equal parts of the length to equal parts, at points no
        further apart than the cells of the mesh: between these corners are cut.
    smoothness : float, optional
        A length in pixels: as far around landmarks the warp is smooth as a thin plate is
        (`quasiharmonic.energies.bending`), and stretches no more, however fine the mesh is. An eighth of the picture's
        longer side by default. With 0 a landmark is a cusp, the sharper the finer the mesh.
    resolution : int
        Cells of the mesh along the longer side.
    energy : str or Energy
        Distortion that is lowered once the map is free of folds; see `quasiharmonic.polish`.

    Returns
    -------
    WarpResult

    Raises
    ------
    ValueError
        When an array has the wrong shape, a landmark is outside of the picture, before or after, or stands for two,
        a number is out of its range, or the moved border meets itself.
    RuntimeError
        When no map without folds was found.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import warp_by_landmarks
    >>> image = np.zeros((40, 60), dtype=np.uint8)
    >>> image[20, 30] = 255
    >>> warped = warp_by_landmarks(image, [[30, 20]], [[45, 10]])
    >>> [int(at) for at in np.unravel_index(warped.image.argmax(), image.shape)]
    [10, 45]
    """
    picture = _picture(image)
    height, width = picture.shape[:2]
    size = np.array((width - 1, height - 1))
    whole_number("resolution", resolution, least=2)
    length = 0.125 * float(size.max()) if smoothness is None else smoothness
    not_negative("smoothness", length)
    given = landmarks_of(landmarks, target, weights, curves, float(size.max()) / resolution, size)
    if not length and not given.hard.all():
        raise ValueError("weights need a positive smoothness: without it, a point moves nothing else")
    before, after, edge = given.before, given.after, on_border(given.before, size)
    points, F = picture_mesh(before, width, height, resolution)
    own = len(points) - len(before) + np.arange(len(before))
    border = np.setdiff1d(boundary_edges(F, len(points)), own)
    held = given.hard
    target = np.concatenate([points[border] + carried(points[border], before[edge], after[edge], size), after[held]])
    fixed = np.concatenate([border, own[held]])
    # Landmarks can pass each other: on the picture's own triangles what that costs is spread from the start.
    result = injective_map(points, F, fixed, target, reference="corrected", polish=None if length else energy)
    if result.certificate.crossings.size:
        raise ValueError("target: the border, moved by the landmarks on it, crosses itself")
    if not result.injective:
        raise RuntimeError(
            "no warp without folds was found: landmarks may move too far past each other or past the border. "
            f"Move them less, or give more landmarks between them. ({result.status.value})"
        )
    if length:
        pull = Pull(own[~held], after[~held], given.weights[~held])
        result = bend_map(Domain(points, F, fixed), result, energy=energy, length=length, pull=pull)
    return WarpResult(warp_along(picture, points, F, result.uv), points, F, result.uv, result)


def warp_along(
    image: ArrayLike, points: ArrayLike, F: ArrayLike, positions: ArrayLike, *, shape: tuple[int, int] | None = None
) -> NDArray[Any]:
    """Draw a picture where a planar map takes it.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) array
        Any real dtype.
    points : (n, 2) array
        A mesh over the picture or a part of it, in pixels.
    F : (f, 3) array of int
        Its triangles.
    positions : (n, 2) array
        Where the mesh goes, bijectively.
    shape : (int, int), optional
        Height and width of the result; the picture's by default.

    Returns
    -------
    array
        Of the picture's dtype. Each pixel is taken from where it comes from, between pixels linearly; those
        outside the moved mesh are 0.

    Raises
    ------
    ValueError
        When an array has the wrong shape, a point is not finite, or the map is not bijective: the message says
        which and why.
    """
    from scipy.ndimage import map_coordinates

    picture = _picture(image)
    height, width = picture.shape[:2] if shape is None else shape
    if height < 1 or width < 1:
        raise ValueError(f"shape must be positive, not {shape}")
    rest = map_array("points", points)
    map_array("positions", positions, len(rest))
    inverse = InverseMap(rest, F, positions)
    source = _sources(inverse, height, width)
    channels = picture.reshape(*picture.shape[:2], -1)
    layers = [np.ascontiguousarray(channels[..., k], dtype=_drawable(picture.dtype)) for k in range(channels.shape[2])]
    drawn = np.zeros((height * width, len(layers)), dtype=picture.dtype)
    for start in range(0, height * width, _PIXELS):
        here = source[start : start + _PIXELS]
        found = np.flatnonzero(np.isfinite(here[:, 0]))
        places = np.ascontiguousarray(here[found, ::-1].T)
        for channel, layer in enumerate(layers):
            values = map_coordinates(layer, places, output=np.float64, order=1, mode="nearest")
            if picture.dtype.kind in "iub":
                values = np.rint(values)
            drawn[start + found, channel] = values.astype(picture.dtype)
    return drawn.reshape(height, width, *picture.shape[2:])


def _picture(image: ArrayLike) -> NDArray[Any]:
    picture = np.asarray(image)
    if picture.ndim not in (2, 3) or min(picture.shape) < 1 or min(picture.shape[:2]) < 2:
        raise ValueError(
            f"image must have shape (height, width) or (height, width, channels), at least 2 × 2, not {picture.shape}"
        )
    if picture.dtype.kind not in "iubf":
        raise ValueError(f"image must hold real numbers, not {picture.dtype}")
    return picture


def _sources(inverse: InverseMap, height: int, width: int) -> FloatArray:
    """Where each pixel comes from, row by row, NaN where from nowhere; (height · width, 2)."""
    filled = np.full((height, width, 2), np.nan)
    if height * width > LARGE * len(inverse.F):
        _fill(inverse, filled)
    source = filled.reshape(-1, 2)
    # What is left lies on edges, so close to one that rounding could tell either side, or outside: decided exactly.
    left = np.flatnonzero(np.isnan(source[:, 0]))
    for start in range(0, left.size, _PIXELS):
        here = left[start : start + _PIXELS]
        y, x = np.divmod(here, width)
        source[here] = inverse.surface(inverse.locate(np.stack([x, y], axis=1)))
    return source


def _fill(inverse: InverseMap, source: FloatArray) -> None:
    """Enter where pixels come from that lie inside triangles beyond any doubt; on each the map is affine."""
    height, width = source.shape[:2]
    corners, origins = inverse.uv[inverse.F], inverse.V[inverse.F]
    first = np.clip(np.ceil(corners.min(axis=1)), 0, (width, height)).astype(np.int64)
    last = np.clip(np.floor(corners.max(axis=1)), -1, (width - 1, height - 1)).astype(np.int64)
    sides = corners[:, 1:] - corners[:, :1]
    area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    # Of a barycentric coordinate, by twice as much as rounding can do.
    extent = np.abs(sides).max(axis=1) * 2
    doubt = 2.0**-48 * extent[:, 0] * extent[:, 1] / area
    for t in np.flatnonzero((first <= last).all(axis=1) & (doubt < 2.0**-30)).tolist():
        (x0, y0), (x1, y1) = first[t].tolist(), last[t].tolist()
        dx = np.arange(x0, x1 + 1) - corners[t, 0, 0]
        dy = (np.arange(y0, y1 + 1) - corners[t, 0, 1])[:, None]
        (ax, ay), (bx, by) = (sides[t] / area[t]).tolist()
        second, third = dx * by - dy * bx, dy * ax - dx * ay
        inside = (second > doubt[t]) & (third > doubt[t]) & (second + third < 1 - 2 * doubt[t])
        along, across = origins[t, 1:] - origins[t, 0]
        place = source[y0 : y1 + 1, x0 : x1 + 1]
        place[inside] = origins[t, 0] + second[inside][:, None] * along + third[inside][:, None] * across


def _drawable(kind: np.dtype[Any]) -> np.dtype[Any]:
    """A type that SciPy draws from, without loss."""
    return kind if kind.kind in "iu" or kind in (np.float32, np.float64) else np.dtype(np.float64)
