"""Project a surface and assign a colour to each triangle, the same in every picture.

A triangle has the same colour on the surface and in the map. The position in the view of the surface gives the hue, and
the light there gives the brightness. So readers can match triangles of the map with those of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.targets.boundary.correspondence import viewer_axes
from quasiharmonic.util.arrays import FloatArray, pad_to_space

# Colours at the four corners of the view; all differ clearly from the red of inverted triangles.
_CORNERS = np.array([[(40, 96, 190), (16, 160, 140)], [(140, 110, 230), (255, 200, 60)]]) / 255
_LIGHT = np.array([-0.45, 0.60, 0.66])


@dataclass(frozen=True)
class View:
    """Projection of a surface onto the picture plane."""

    points: FloatArray  # (n, 2): vertices in the plane of the picture
    depth: FloatArray  # (n,): depth of the vertices, increasing towards the viewer
    inside: NDArray[np.bool_]  # (f,): triangles that show their inner side
    light: FloatArray  # (f,): cosine between normal and light direction per triangle: -1 from behind, 1 head-on
    color: FloatArray  # (f, 3): red, green and blue of every triangle's outer side, 0 to 1


def view(V: FloatArray, F: NDArray[np.int64]) -> View:
    """Project a surface: a planar one from above, an open one from the direction that shows most of it."""
    if not len(F):
        raise ValueError("the mesh has no triangles to draw")
    V = pad_to_space(scale_for_drawing(V))
    normals = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    sizes = np.linalg.norm(normals, axis=1)
    frame = _frame(normals.sum(axis=0), sizes.sum())
    seen = V @ frame.T
    facing = (normals / np.maximum(sizes, np.finfo(float).tiny)[:, None]) @ frame.T

    middle = seen[F, :2].mean(axis=1)
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    across, up = ((middle - low) / np.maximum(high - low, np.finfo(float).tiny)).T[:, :, None]
    hue = (1 - up) * ((1 - across) * _CORNERS[0, 0] + across * _CORNERS[0, 1]) + up * (
        (1 - across) * _CORNERS[1, 0] + across * _CORNERS[1, 1]
    )
    light = facing @ (_LIGHT / np.linalg.norm(_LIGHT))
    if np.ptp(light) < 1e-9:  # flat: nothing to shade
        light = np.full_like(light, 0.7)
    return View(
        points=np.ascontiguousarray(seen[:, :2]),
        depth=seen[:, 2],
        inside=facing[:, 2] < 0,
        light=light,
        color=lit(hue, light),
    )


def scale_for_drawing(points: FloatArray, beside: FloatArray | None = None) -> FloatArray:
    """Return points scaled by a power of two, so that squares of lengths neither overflow nor underflow.

    Points of moderate size are returned unchanged. If ``beside`` is given, its size determines the factor.
    """
    exponent = int(np.frexp(np.abs(points if beside is None else beside).max(initial=0.0))[1])
    return np.ldexp(points, -exponent) if abs(exponent) > 300 else points


def edge_style(color: FloatArray, height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return colours of the edges, lighter than the triangles, and their widths, given heights in points.

    Edges of very thin triangles have the triangle's colour and only close the gaps that antialiasing leaves.
    """
    lightness = np.clip((height - 1.3) / 10, 0, 0.45)[:, None]
    return color + (1 - color) * lightness, np.clip(0.09 * height, 0.25, 0.8)


def min_heights(corners: FloatArray) -> FloatArray:
    """Return the least height of each triangle, (f,) float64 for corners (f, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.asarray(area / np.maximum(longest, np.finfo(float).tiny))


def _frame(area: FloatArray, total: float) -> FloatArray:
    """Return the view frame (3, 3), given the vector area of a surface and the sum of its triangle areas.

    The vector area of an open surface points to where most of the surface is visible. The vector area of an almost
    closed surface points away from its hole, and such models usually stand on the hole.
    """
    openness = np.linalg.norm(area) / total if total > 0 else 0.0
    if openness > 0.999:
        return viewer_axes(area)
    if openness > 0.2:
        frame = viewer_axes(area)
    else:
        axis, up, towards = int(np.argmax(np.abs(area))), np.zeros(3), np.zeros(3)
        if openness < 0.01 or abs(area[axis]) < 0.85 * np.linalg.norm(area):
            axis, up[1] = 1, 1.0
        else:
            up[axis] = np.sign(area[axis])
        towards[1 if axis == 2 else 2] = -1.0 if axis == 2 else 1.0
        frame = np.stack([np.cross(up, towards), up, towards])
    # A view slightly from the side and from above shows more relief than a front view.
    yaw, pitch = np.radians((-20, 12))
    from_side = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    from_above = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    return np.asarray(from_above @ from_side @ frame)


def lit(hue: FloatArray, light: FloatArray) -> FloatArray:
    """Darken colours (k, 3) turned away from the light and whiten those that face it; ``light`` (k,) is −1 to 1."""
    strength = ((1 + light) / 2)[:, None]  # never black, because a map also shows unlit triangles
    shade = 0.15 + 0.95 * np.minimum(strength / 0.8, 1)
    gleam = 0.42 * np.maximum(strength - 0.8, 0) / 0.2
    shaded = hue * shade
    return np.asarray(np.clip(shaded + (1 - shaded) * gleam, 0, 1))
