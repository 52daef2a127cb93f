"""How a surface is looked at, and the colour each of its triangles has in every picture of it.

A triangle keeps its colour from the surface to the map: hue by where it is seen on the surface,
brightness by how the light falls on it there. So a reader finds in the map what was on the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.targets.boundary.correspondence import upright
from quasiharmonic.util.arrays import FloatArray

# Colours at the left and right, bottom and top of the view, and far from the red of inversions.
_CORNERS = np.array([[(40, 96, 190), (16, 160, 140)], [(140, 110, 230), (255, 200, 60)]]) / 255
_LIGHT = np.array([-0.45, 0.60, 0.66])


@dataclass(frozen=True)
class View:
    """A surface as it is seen.

    Attributes
    ----------
    points : (n, 2) float64
        Vertices in the plane of the picture.
    depth : (n,) float64
        Of the vertices, growing towards the viewer.
    inside : (f,) bool
        Triangles that show their inner side.
    light : (f,) float64
        How the light falls on every triangle, -1 from behind to 1 straight.
    color : (f, 3) float64
        Red, green and blue of every triangle's outer side, 0 to 1.
    """

    points: FloatArray
    depth: FloatArray
    inside: NDArray[np.bool_]
    light: FloatArray
    color: FloatArray


def view(V: FloatArray, F: NDArray[np.int64]) -> View:
    """Look at a surface: a planar one from above, an open one from where it is most seen.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64

    Returns
    -------
    View

    Raises
    ------
    ValueError
        When there are no triangles.
    """
    if not len(F):
        raise ValueError("the mesh has no triangles to draw")
    V = drawable(V)
    if V.shape[1] == 2:
        V = np.column_stack([V, np.zeros(len(V))])
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


def drawable(points: FloatArray, beside: FloatArray | None = None) -> FloatArray:
    """Points in a unit in which squares of lengths neither overflow nor vanish: their own, if it will do.

    With others to be drawn beside it is what does for those.
    """
    exponent = int(np.frexp(np.abs(points if beside is None else beside).max(initial=0.0))[1])
    return np.ldexp(points, -exponent) if abs(exponent) > 300 else points


def edge_style(color: FloatArray, height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Colours of the edges, lighter than the triangles, and their widths, given heights in points.

    Those of triangles too thin to show them only close the gaps that antialiasing leaves.
    """
    lightness = np.clip((height - 1.3) / 10, 0, 0.45)[:, None]
    return color + (1 - color) * lightness, np.clip(0.09 * height, 0.25, 0.8)


def least_heights(corners: FloatArray) -> FloatArray:
    """Least height of each triangle, (f,) float64 for corners (f, 3, 2)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return np.asarray(area / np.maximum(longest, np.finfo(float).tiny))


def _frame(area: FloatArray, total: float) -> FloatArray:
    """Where to look from, given the vector area of a surface and the sum of its triangles' areas.

    The vector area of an open surface points where most of it can be seen from. That of an all but
    closed one points away from its hole, and such models mostly stand on theirs.
    """
    openness = np.linalg.norm(area) / total if total > 0 else 0.0
    if openness > 0.999:
        return upright(area)
    if openness > 0.2:
        frame = upright(area)
    else:
        axis, up, towards = int(np.argmax(np.abs(area))), np.zeros(3), np.zeros(3)
        if openness < 0.01 or abs(area[axis]) < 0.85 * np.linalg.norm(area):
            axis, up[1] = 1, 1.0
        else:
            up[axis] = np.sign(area[axis])
        towards[1 if axis == 2 else 2] = -1.0 if axis == 2 else 1.0
        frame = np.stack([np.cross(up, towards), up, towards])
    # A little from the side and from above shows more relief than straight from the front.
    yaw, pitch = np.radians((-20, 12))
    from_side = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    from_above = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    return np.asarray(from_above @ from_side @ frame)


def lit(hue: FloatArray, light: FloatArray) -> FloatArray:
    """Darken colours (k, 3) turned away from the light and whiten those that face it; light (k,) is −1 to 1."""
    strength = ((1 + light) / 2)[:, None]  # nothing is black: a map shows what no light fell on
    shade = 0.15 + 0.95 * np.minimum(strength / 0.8, 1)
    gleam = 0.42 * np.maximum(strength - 0.8, 0) / 0.2
    return np.asarray(np.clip(hue * shade + (1 - hue * shade) * gleam, 0, 1))
