"""Warping of pictures by landmarks or along any planar map, with no folds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.energies import Energy
from quasiharmonic.inject import injective_map
from quasiharmonic.inverse import InverseMap
from quasiharmonic.mesh.topology import boundary_edges, named
from quasiharmonic.result import MapResult

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Vertices along the longer side of a picture.
_ALONG = 48


@dataclass(frozen=True, eq=False)
class Warped:
    """A warped picture and the map that warped it.

    Attributes
    ----------
    image : array
        Of the picture's shape and dtype.
    points : (n, 2) float64
        Vertices of a mesh of the picture, x to the right and y down, in pixels.
    F : (f, 3) int64
        Its triangles.
    moved : (n, 2) float64
        Where they go.
    result : MapResult
        With the certificate; the warp folds nowhere if it is bijective.
    """

    image: NDArray[Any]
    points: FloatArray
    F: IntArray
    moved: FloatArray
    result: MapResult


def warp_by_landmarks(
    image: ArrayLike,
    landmarks: ArrayLike,
    moved: ArrayLike,
    *,
    energy: str | Energy = "symmetric-dirichlet",
) -> Warped:
    """Warp a picture such that landmarks go where they are told and its border stays.

    Parameters
    ----------
    image : (height, width) or (height, width, channels) array
        Any real dtype.
    landmarks : (k, 2) array
        Points of the picture, x to the right and y down; the centre of the first pixel is (0, 0).
    moved : (k, 2) array
        Where they go.
    energy : str or Energy
        Distortion that is lowered once the map is free of folds; see `quasiharmonic.polish`.

    Returns
    -------
    Warped

    Raises
    ------
    ValueError
        When an array has the wrong shape, or a landmark is not inside the picture, before or after, or
        stands for two.
    RuntimeError
        When no map without folds was found.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import warp_by_landmarks
    >>> image = np.zeros((40, 60), dtype=np.uint8)
    >>> image[20, 30] = 255
    >>> warped = warp_by_landmarks(image, [[30, 20]], [[45, 10]])
    >>> np.unravel_index(warped.image.argmax(), image.shape)
    (np.int64(10), np.int64(45))
    """
    picture = _picture(image)
    height, width = picture.shape[:2]
    before, after = _landmarks(landmarks, "landmarks", width, height), _landmarks(moved, "moved", width, height)
    if before.shape != after.shape:
        raise ValueError(f"moved must have as many rows as landmarks, {len(before)}, not {len(after)}")
    points, F = _mesh(before, width, height)
    border = np.unique(boundary_edges(F, len(points)))
    fixed = np.concatenate([border, len(points) - len(before) + np.arange(len(before))])
    # Landmarks can pass each other: si-log on the picture's own triangles spreads what that costs.
    result = injective_map(points, F, fixed, np.concatenate([points[border], after]), strategy="quality", polish=energy)
    if not result.injective:
        raise RuntimeError(f"no map without folds was found. {result.status.value}")
    return Warped(warp_along(picture, points, F, result.uv), points, F, result.uv, result)


def warp_along(
    image: ArrayLike, points: ArrayLike, F: ArrayLike, moved: ArrayLike, *, shape: tuple[int, int] | None = None
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
    moved : (n, 2) array
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
        When an array has the wrong shape, or the map is not bijective: the message says why.
    """
    from scipy.ndimage import map_coordinates

    picture = _picture(image)
    height, width = picture.shape[:2] if shape is None else shape
    if height < 1 or width < 1:
        raise ValueError(f"shape must be positive, not {shape}")
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=2).reshape(-1, 2).astype(np.float64)
    inverse = InverseMap(points, F, moved)
    at = inverse.locate(pixels)
    source = inverse.surface(at)[at.found]
    channels = picture.reshape(*picture.shape[:2], -1)
    drawn = np.zeros((height * width, channels.shape[2]), dtype=picture.dtype)
    for channel in range(channels.shape[2]):
        values = map_coordinates(channels[..., channel].astype(np.float64), source[:, ::-1].T, order=1, mode="nearest")
        if picture.dtype.kind in "iub":
            values = np.rint(values)
        drawn[at.found, channel] = values.astype(picture.dtype)
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


def _landmarks(points: ArrayLike, name: str, width: int, height: int) -> FloatArray:
    """Landmarks, checked to be inside the picture and apart."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} must have shape (k, 2), not {array.shape}")
    outside = np.flatnonzero(~((array > 0) & (array < (width - 1, height - 1))).all(axis=1))
    if outside.size:
        raise ValueError(
            f"{name}: {named('point', 'points', outside)} not inside the picture, 0 < x < {width - 1}, "
            f"0 < y < {height - 1}"
        )
    if len(np.unique(array, axis=0)) < len(array):
        raise ValueError(f"{name}: two points are the same")
    return array


def _mesh(landmarks: FloatArray, width: int, height: int) -> tuple[FloatArray, IntArray]:
    """Triangulate a picture by a grid that makes room for landmarks, which come last."""
    from scipy.spatial import Delaunay, cKDTree

    spacing = max(width - 1, height - 1) / _ALONG
    x = np.linspace(0, width - 1, max(2, round((width - 1) / spacing) + 1))
    y = np.linspace(0, height - 1, max(2, round((height - 1) / spacing) + 1))
    grid = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    edge = (grid == 0).any(axis=1) | (grid[:, 0] == width - 1) | (grid[:, 1] == height - 1)
    near = np.zeros(len(grid), dtype=bool)
    if len(landmarks):
        near = cKDTree(landmarks).query(grid)[0] < 0.5 * spacing
    kept = grid[edge | ~near]
    points = np.concatenate([kept, landmarks])
    F = Delaunay(points).simplices.astype(np.int64)
    a, b, c = points[F].transpose(1, 0, 2)
    turned = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    F[turned] = F[turned, ::-1]
    return points, F
