"""Injective warps of images by landmarks or by any planar map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.apps.inverse_map import InverseMap
from quasiharmonic.apps.landmarks import (
    CurvePair,
    interpolate_border,
    is_on_border,
    make_image_mesh,
    make_landmarks,
)
from quasiharmonic.energies.bending import Pull, bend_map
from quasiharmonic.energies.energies import Energy
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.problem import Domain
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.solver.mapping import injective_map
from quasiharmonic.util.arrays import FloatArray, IntArray, check_integer, check_non_negative, index_array, map_array
from quasiharmonic.util.outcome import OutcomeOf

# Pixels drawn per block, so that the arrays fit into the cache.
_PIXELS = 1 << 15
# If triangles have more pixels than this on average, they are filled one by one.
LARGE = 100


@dataclass(frozen=True, eq=False, repr=False)
class WarpResult(OutcomeOf):
    """A warped image and the map that warped it.

    Attributes
    ----------
    image : array
        The warped image, with the shape and dtype of the input.
    points : (n, 2) float64
        Vertices of a mesh of the image, x to the right and y down, in pixels.
    F : (f, 3) int64
        Triangles of the mesh.
    positions : (n, 2) float64
        Warped positions of the vertices.
    result : MapResult
        The map with its certificate. The warp is injective if its certificate is bijective.

    See Also
    --------
    warp_by_landmarks : Makes it.
    warp_along : Warps further images with its map.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import warp_along, warp_by_landmarks
    >>> image = np.random.default_rng(0).random((20, 30))
    >>> warped = warp_by_landmarks(image, [[15, 10]], [[18, 10]], resolution=12)
    >>> again = warp_along(image, warped.points, warped.F, warped.positions)
    >>> warped.success, bool((again == warped.image).all())
    (True, True)
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
    """Warp an image so that landmarks reach their target positions without inverted triangles.

    If no landmarks are on the border, it is fixed. Otherwise it moves with them and is interpolated linearly between
    neighbouring landmarks. Image corners are fixed unless they are given as landmarks. Any number of landmarks is
    allowed, also none.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) array
        Any real dtype.
    landmarks : (k, 2) array
        Points of the image, x to the right and y down. The centre of the first pixel is (0, 0), that of the last
        (width − 1, height − 1).
    target : (k, 2) array
        Target positions of the landmarks. The image keeps its size. Content that moves outside is cut off, and pixels
        without content are 0.
    weights : (k,) array, optional
        Weights of landmarks inside the image; infinite by default. Landmarks of infinite weight reach their target
        positions exactly. Others may miss them to reduce distortion. At weight 1, missing by one pixel costs one unit
        of energy on one pixel.
    curves : sequence of pairs of (a, 2) and (b, 2) arrays, optional
        Polylines inside the image and their target polylines, matched by equal fractions of their lengths. They are
        sampled with a spacing of at most one mesh cell, which cuts corners between samples. Points at equal positions
        up to rounding are one, and landmarks on a curve are exact.
    smoothness : float, optional
        Length in pixels; an eighth of the image's longer side by default. Up to this distance from a landmark the warp
        is smooth like a thin plate (`quasiharmonic.energies.bending`), and its stretch does not depend on the mesh
        size. With 0 each landmark is a cusp, which becomes sharper on finer meshes.
    resolution : int
        Number of mesh cells along the longer side. Triangles are divided where the warp needs it.
    energy : str or Energy
        Distortion to minimise once the map is injective; see `quasiharmonic.polish`.

    Returns
    -------
    WarpResult

    Raises
    ------
    ValueError
        If an array has the wrong shape, a landmark or its target position is outside the image, two landmarks are at
        the same position, a number is out of its range, or the moved border intersects itself.
    RuntimeError
        If no injective warp was found.
    KeyboardInterrupt
        If Ctrl-C ends the search before there is an injective warp. After that, the result is the best warp so far.

    See Also
    --------
    warp_along : Warps with a given map.
    nearest_invertible : Removes folds of a displacement field.

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
    pixels = _check_image(image)
    height, width = pixels.shape[:2]
    size = np.array((width - 1, height - 1))
    check_integer("resolution", resolution, minimum=2)
    length = 0.125 * float(size.max()) if smoothness is None else smoothness
    check_non_negative("smoothness", length)
    given = make_landmarks(landmarks, target, weights, curves, float(size.max()) / resolution, size)
    if not length and not given.hard.all():
        raise ValueError("weights have no effect without smoothness: give a positive smoothness, or omit weights")
    before, after, edge = given.before, given.after, is_on_border(given.before, size)
    points, F = make_image_mesh(before, width, height, resolution)
    own = len(points) - len(before) + np.arange(len(before))
    border = np.setdiff1d(boundary_edges(F, len(points)), own)
    hard = given.hard
    target = np.concatenate(
        [points[border] + interpolate_border(points[border], before[edge], after[edge], size), after[hard]]
    )
    fixed = np.concatenate([border, own[hard]])
    # Landmarks can pass each other. The corrected reference spreads the resulting distortion from the start. Triangles
    # between three points of a curve must be divided if these come to lie on a line.
    result = injective_map(
        points, F, fixed, target, reference="corrected", polish=None if length else energy, refine=True
    )
    if result.refined is not None:
        points, F = result.refined.V, result.refined.F
    interrupted = result.status is Status.INTERRUPTED
    if interrupted and not result.injective:
        raise KeyboardInterrupt
    if result.certificate.crossings.size:
        raise ValueError(
            "target: the border, moved by the landmarks on it, crosses itself: move them less, or keep their order"
        )
    if not result.injective:
        raise RuntimeError(
            "no warp without folds was found: landmarks may move too far past each other or past the border. "
            f"Move them less, or give more landmarks between them. ({result.status.value})"
        )
    if length and not interrupted:
        pull = Pull(own[~hard], after[~hard], given.weights[~hard])
        result = bend_map(Domain(points, F, fixed), result, energy=energy, length=length, pull=pull)
    return WarpResult(warp_along(pixels, points, F, result.uv), points, F, result.uv, result)


def warp_along(
    image: ArrayLike, points: ArrayLike, F: ArrayLike, positions: ArrayLike, *, shape: tuple[int, int] | None = None
) -> NDArray[Any]:
    """Draw an image under a planar map.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) array
        Any real dtype.
    points : (n, 2) array
        Vertices of a mesh over the image or a part of it, in pixels.
    F : (f, 3) array of int
        Triangles of the mesh.
    positions : (n, 2) array
        Positions of the vertices under the map, which must be bijective.
    shape : (int, int), optional
        Height and width of the result; the input's by default.

    Returns
    -------
    array
        Of the image's dtype. Each pixel is interpolated bilinearly at its source position. Pixels outside the mapped
        mesh are 0.

    Raises
    ------
    ValueError
        If an array has the wrong shape, a point is not finite, or the map is not bijective; the message gives the
        reason.

    See Also
    --------
    warp_by_landmarks : Finds the map, too.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import warp_along
    >>> image = np.arange(6.0).reshape(2, 3)
    >>> points, F = [[0, 0], [2, 0], [2, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]]
    >>> warp_along(image, points, F, np.add(points, [1, 0]), shape=(2, 4)).tolist()
    [[0.0, 0.0, 1.0, 2.0], [0.0, 3.0, 4.0, 5.0]]
    """
    from scipy.ndimage import map_coordinates

    pixels = _check_image(image)
    size = index_array("shape", pixels.shape[:2] if shape is None else shape)
    if size.shape != (2,) or size.min() < 1:
        raise ValueError(f"shape must be two positive integers, not {shape}")
    height, width = size.tolist()
    rest = map_array("points", points)
    map_array("positions", positions, len(rest))
    inverse = InverseMap(rest, F, positions)
    source = _find_sources(inverse, height, width)
    channels = pixels.reshape(*pixels.shape[:2], -1)
    # SciPy draws from these types without loss.
    drawable = pixels.dtype.kind in "iu" or pixels.dtype in (np.float32, np.float64)
    kind = pixels.dtype if drawable else np.float64
    layers = [np.ascontiguousarray(channels[..., k], dtype=kind) for k in range(channels.shape[2])]
    drawn = np.zeros((height * width, len(layers)), dtype=pixels.dtype)
    for start in range(0, height * width, _PIXELS):
        here = source[start : start + _PIXELS]
        found = np.flatnonzero(np.isfinite(here[:, 0]))
        coordinates = np.ascontiguousarray(here[found, ::-1].T)
        for channel, layer in enumerate(layers):
            values = map_coordinates(layer, coordinates, output=np.float64, order=1, mode="nearest")
            drawn[start + found, channel] = _round_to(pixels.dtype, values)
    return drawn.reshape(height, width, *pixels.shape[2:])


def _round_to(dtype: np.dtype[Any], values: FloatArray) -> NDArray[Any]:
    """Convert values (k,) of an image to its type; integers are rounded, and largest ones stay the largest."""
    if dtype.kind not in "iu":
        return (np.rint(values) if dtype.kind == "b" else values).astype(dtype)
    largest = np.iinfo(dtype).max
    # The largest integers of 64 bits are not doubles: they are rounded up to a power of two, which does not fit.
    is_largest = values >= float(largest)
    return np.where(is_largest, largest, np.rint(np.where(is_largest, 0, values)).astype(dtype))


def _check_image(image: ArrayLike) -> NDArray[Any]:
    pixels = np.asarray(image)
    if pixels.ndim not in (2, 3) or min(pixels.shape) < 1 or min(pixels.shape[:2]) < 2:
        raise ValueError(
            f"image must have shape (height, width) or (height, width, channels), at least 2 × 2, not {pixels.shape}"
        )
    if pixels.dtype.kind not in "iubf":
        raise ValueError(f"image must hold real numbers, not {pixels.dtype}")
    return pixels


def _find_sources(inverse: InverseMap, height: int, width: int) -> FloatArray:
    """The source position of each pixel, row by row, NaN for pixels without source; (height · width, 2)."""
    filled = np.full((height, width, 2), np.nan)
    if height * width > LARGE * len(inverse.F):
        _fill(inverse, filled)
    source = filled.reshape(-1, 2)
    # The remaining pixels are near edges, where rounding could change the result, or outside. Locate them exactly.
    left = np.flatnonzero(np.isnan(source[:, 0]))
    for start in range(0, left.size, _PIXELS):
        here = left[start : start + _PIXELS]
        y, x = np.divmod(here, width)
        source[here] = inverse.surface(inverse.locate(np.stack([x, y], axis=1)))
    return source


def _fill(inverse: InverseMap, source: FloatArray) -> None:
    """Fill in the source positions of pixels that are inside a triangle despite rounding; each map is affine there."""
    height, width = source.shape[:2]
    corners, origins = inverse.uv[inverse.F], inverse.V[inverse.F]
    first = np.clip(np.ceil(corners.min(axis=1)), 0, (width, height)).astype(np.int64)
    last = np.clip(np.floor(corners.max(axis=1)), -1, (width - 1, height - 1)).astype(np.int64)
    sides = corners[:, 1:] - corners[:, :1]
    area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    # Twice the bound on the rounding error of a barycentric coordinate.
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
