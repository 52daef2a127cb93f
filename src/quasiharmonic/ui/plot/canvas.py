"""Drawing primitives of all figures: figures without global state, triangles painted in order, captions.

`view` projects a surface and assigns a colour to each triangle, the same in every picture and in the map. The position
in the view of the surface gives the hue, and the light there gives the brightness. So readers can match triangles of
the map with those of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.errors import check_path
from quasiharmonic.targets.boundary.correspondence import viewer_axes
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_range,
    index_array,
    pad_to_space,
    triangle_rows,
    vertex_array,
)
from quasiharmonic.util.hints import explain_missing

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours at the four corners of the view; all differ clearly from the red of inverted triangles.
_CORNERS = np.array([[(40, 96, 190), (16, 160, 140)], [(140, 110, 230), (255, 200, 60)]]) / 255
_LIGHT = np.array([-0.45, 0.60, 0.66])
#: Suffixes of pictures: one raster format and two vector formats.
PICTURES = (".png", ".svg", ".pdf")
# Above this number of triangles vector formats get pixels too, because shapes would take megabytes.
_MAX_SHAPES = 10_000
#: Settings of matplotlib with which a figure is saved in its own size, whatever the user's settings are.
AS_DRAWN: dict[Any, Any] = {"savefig.dpi": "figure", "savefig.bbox": "standard"}
Color: TypeAlias = tuple[float, float, float]
RED: Color = (0.89, 0.07, 0.17)
INK: Color = (0.06, 0.12, 0.29)
BORDER = 1.2  # width in points
_INSIDE = np.array((0.80, 0.82, 0.86))


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
        color=shade(hue, light),
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

    ``openness`` is 1 for flat surfaces, which are shown from the front, and 0 for closed ones. Where the hole says
    nothing, because it is tiny or faces no axis, the y-axis is up.
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


def shade(hue: FloatArray, light: FloatArray) -> FloatArray:
    """Darken colours (k, 3) turned away from the light and whiten those that face it; ``light`` (k,) is −1 to 1."""
    strength = ((1 + light) / 2)[:, None]  # never black, because a map also shows unlit triangles
    brightness = 0.15 + 0.95 * np.minimum(strength / 0.8, 1)
    gleam = 0.42 * np.maximum(strength - 0.8, 0) / 0.2
    shaded = hue * brightness
    return np.asarray(np.clip(shaded + (1 - shaded) * gleam, 0, 1))


def new_figure(inches: tuple[float, float]) -> Figure:
    """Return a white figure of 100 pixels per inch that is not registered with pyplot; notebooks display it."""
    with explain_missing("pictures need matplotlib", "'matplotlib>=3.8'"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        from quasiharmonic.ui.plot.notebook_figures import NotebookFigure

    figure = NotebookFigure(figsize=inches, dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def save_picture(path: str | PathLike[str], figure: Figure) -> None:
    """Write a figure in the format of the path's suffix; the file is replaced only when it is complete.

    ValueError if the suffix is not one of `PICTURES`; OutputError if the file cannot be written.
    """
    from matplotlib import rc_context

    from quasiharmonic.io.atomic import write_whole

    suffix = check_ending(path)
    # Equal figures give equal files: no date and no random identifiers.
    metadata: dict[str, dict[str, Any]] = {".png": {}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with rc_context(AS_DRAWN | {"svg.hashsalt": "quasiharmonic"}):
        write_whole(path, lambda file: figure.savefig(file, format=suffix[1:], metadata=metadata[suffix]))


def check_ending(path: str | PathLike[str]) -> str:
    """Return the suffix of a picture's path in lower case; raise ValueError if it is not one of `PICTURES`."""
    check_path("path", path)
    suffix = Path(path).suffix.lower()
    if suffix not in PICTURES:
        raise ValueError(f"{path}: pictures are written as {', '.join(PICTURES)}")
    return suffix


def panels(figure: Figure, count: int) -> list[Axes]:
    """Return ``count`` axes side by side, with space for a caption above each."""
    width = 1 / count
    return [figure.add_axes((i * width + 0.005, 0.02, width - 0.01, 0.88)) for i in range(count)]


def caption(ax: Axes, text: str, color: Color = INK) -> None:
    """Write a caption above a panel, at the same height for all panels."""
    left, right = ax.get_position(original=True).intervalx
    ax.figure.text((left + right) / 2, 0.93, text, ha="center", size=12.5, color=color)


def verdict(ax: Axes, name: str, inverted: int) -> None:
    """Write the name of a map and the number of its inverted triangles above a panel."""
    text = f"{name}: {inverted:,} inverted" if inverted else f"{name}: no triangle inverted"
    caption(ax, text, RED if inverted else INK)


def fit(ax: Axes, points: FloatArray) -> float:
    """Fit the view to the points and hide the frame; return the number of printer's points per unit."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * (float((high - low).max()) or 1.0)
    low, high = low - margin, high + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal")
    ax.set_axis_off()
    box = ax.get_window_extent()
    pixels = min(box.width / (high - low)[0], box.height / (high - low)[1])
    return float(pixels) * 72 / ax.figure.dpi


def paint_surface(ax: Axes, seen: View, F: IntArray, color: FloatArray) -> None:
    """Paint a projected surface, its outer side in the given colours (f, 3), its inner side greyed."""
    color = np.where(seen.inside[:, None], _INSIDE * (0.5 + 0.5 * color), color)
    scale = fit(ax, seen.points)
    edges, width = edge_style(color, scale * min_heights(seen.points[F]))
    # Nearer triangles are painted later. Each boundary edge is painted just after its triangle.
    border = boundary_edges(F, len(seen.points))[:, [0, 1, 1]]
    ink = np.broadcast_to(INK, (len(border), 3))
    corners = np.concatenate([F, border])
    near = np.concatenate([seen.depth[F].mean(axis=1), seen.depth[border].max(axis=1)])
    order = np.argsort(near, kind="stable")
    fill(
        ax,
        seen.points[corners[order]],
        np.concatenate([color, ink])[order],
        np.concatenate([edges, ink])[order],
        np.concatenate([width, np.full(len(border), BORDER)])[order],
    )


def paint_map(
    ax: Axes,
    F: IntArray,
    uv: FloatArray,
    color: FloatArray,
    inverted: IntArray,
    fixed: ArrayLike | None = None,
    window: FloatArray | None = None,
) -> None:
    """Paint a map in the given colours (f, 3), inverted triangles in red on top.

    The view contains the whole map, or the points of ``window`` if given.
    """
    window = uv if window is None else window
    uv = scale_for_drawing(uv, window)
    scale = fit(ax, scale_for_drawing(window))
    color = color.copy()
    color[inverted] = RED
    height = scale * min_heights(uv[F])
    edges, width = edge_style(color, height)
    # Inverted triangles are painted last, on top of the triangles they overlap.
    order = np.concatenate([np.delete(np.arange(len(F)), inverted), inverted])
    fill(ax, uv[F[order]], color[order], edges[order], width[order])
    tiny = inverted[height[inverted] < 0.7]
    ax.plot(*uv[F[tiny]].mean(axis=1).T, ".", markersize=3, markeredgewidth=0, color=RED, zorder=3)
    border = boundary_edges(F, len(uv))
    draw_edges(ax, uv, border)
    if fixed is not None:
        held = index_array("fixed", fixed)
        check_range("fixed", held, len(uv))
        draw_pins(ax, uv[np.setdiff1d(held, border)])


def draw_edges(
    ax: Axes, points: FloatArray, edges: IntArray, color: Color = INK, width: float = BORDER, zorder: float = 4
) -> None:
    """Draw edges (k, 2), by default as those of a boundary; edges with an end at NaN are left out."""
    from matplotlib.collections import LineCollection

    ends = _polygons(points[edges])
    lines = LineCollection(ends, colors=[color], linewidths=width, capstyle="round", zorder=zorder)
    ax.add_collection(lines, autolim=False)


def draw_pins(ax: Axes, points: FloatArray) -> None:
    """Mark fixed interior vertices."""
    ax.plot(*points.T, "o", markersize=5, color="white", mec=INK, mew=1.4, zorder=5)


def name_axes(ax: Axes, x: str, y: str) -> None:
    """Label the axes of a chart, which has no frame at the top and at the right."""
    ax.set_xlabel(x, color=INK)
    ax.set_ylabel(y, color=INK)
    ax.spines[["top", "right"]].set_visible(False)


def png_bytes(figure: Figure, **options: Any) -> bytes:
    """Return a figure as the bytes of a PNG file; ``options`` are those of matplotlib's ``savefig``."""
    file = BytesIO()
    figure.savefig(file, format="png", **options)
    return file.getvalue()


def find_not_positive(F: IntArray, uv: FloatArray) -> IntArray:
    """Return the indices of triangles whose signed area, in floating point, is not positive."""
    uv = scale_for_drawing(uv)
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    return np.flatnonzero(~(a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0]))


def as_mesh(V: ArrayLike, F: ArrayLike) -> tuple[FloatArray, IntArray]:
    """Return vertices and triangles as arrays, after checking finiteness and the range of indices.

    A mesh without triangles is allowed.
    """
    rest, triangles = vertex_array(V), triangle_rows(F)
    check_range("F", triangles, len(rest))
    return rest, triangles


def fill(ax: Axes, corners: FloatArray, color: FloatArray, edges: ArrayLike, width: ArrayLike) -> None:
    """Paint polygons in the given order; corners (f, m, 2), colours (f, 3), colours and widths of their edges."""
    from matplotlib.collections import PolyCollection

    triangles = PolyCollection(
        _polygons(corners), facecolors=color, edgecolors=edges, linewidths=width, joinstyle="round", zorder=1
    )
    triangles.set_rasterized(len(corners) > _MAX_SHAPES)
    ax.add_collection(triangles, autolim=False)


def _polygons(corners: FloatArray) -> Sequence[ArrayLike]:
    """Cast corners to the type that matplotlib's annotations require; passing the array itself is fastest."""
    return cast("Sequence[ArrayLike]", corners)
