"""Figures of maps: the surface, the map, and what was inverted before."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.mesh.topology import boundary_edges
from quasiharmonic.plot.shading import View, edge_style, least_heights, view

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_RED = (0.89, 0.07, 0.17)
_INK = (0.06, 0.12, 0.29)
_INSIDE = np.array((0.80, 0.82, 0.86))
_BORDER = 1.2  # width in points


def plot_surface(V: ArrayLike, F: ArrayLike, ax: Axes) -> None:
    """Draw a rest surface, shaded and coloured as `plot_map` colours its map.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float
    F : (f, 3) int
    ax : matplotlib Axes
        Ordinary two-dimensional ones; the surface is projected here.

    Raises
    ------
    ValueError
        When a vertex is not finite.
    """
    rest, F = _mesh(V, F)
    seen = view(rest, F)
    color = np.where(seen.inside[:, None], _INSIDE * (0.5 + 0.5 * seen.color), seen.color)
    scale = _fit(ax, seen.points)
    edges, width = edge_style(color, scale * least_heights(seen.points[F]))
    # What is nearer is painted later. The boundary takes part, each edge just after its triangle.
    border = boundary_edges(F, len(rest))[:, [0, 1, 1]]
    ink = np.broadcast_to(_INK, (len(border), 3))
    corners = np.concatenate([F, border])
    near = np.concatenate([seen.depth[F].mean(axis=1), seen.depth[border].max(axis=1)])
    order = np.argsort(near, kind="stable")
    _fill(
        ax,
        seen.points[corners[order]],
        np.concatenate([color, ink])[order],
        np.concatenate([edges, ink])[order],
        np.concatenate([width, np.full(len(border), _BORDER)])[order],
    )


def plot_map(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    flipped: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a map, its inverted triangles in red over all others.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float
        The rest surface, whose look colours the triangles.
    F : (f, 3) int
    uv : (n, 2) float
        The map.
    flipped : (k,) int or (f,) bool, optional
        The triangles to show as inverted, as a certificate lists them. By default those whose area
        in floating point is not positive.
    fixed : (k,) int, optional
        Vertices held in place; those not on the boundary are marked.
    ax : matplotlib Axes, optional
        Where to draw; the axes of a new `matplotlib.figure.Figure` by default.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ValueError
        When a vertex of the surface or the map is not finite.
    """
    rest, F = _mesh(V, F)
    if ax is None:
        ax = _figure((6, 6)).add_axes((0.02, 0.02, 0.96, 0.9))
    _draw_map(ax, view(rest, F), F, _finite(uv, "uv"), flipped, fixed)
    return ax


def plot_before_after(
    V: ArrayLike,
    F: ArrayLike,
    before: ArrayLike,
    after: ArrayLike,
    *,
    fixed: ArrayLike | None = None,
) -> Figure:
    """Draw two maps of one surface side by side, inverted triangles in red.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float
    F : (f, 3) int
    before, after : (n, 2) float
    fixed : (k,) int, optional
        As for `plot_map`.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        When a vertex of the surface or a map is not finite.
    """
    rest, F = _mesh(V, F)
    figure, seen = _figure((9, 4.8)), view(rest, F)
    for ax, uv, name in zip(_panels(figure, 2), (before, after), ("before", "after"), strict=True):
        _title(ax, name, _draw_map(ax, seen, F, _finite(uv, name), None, fixed))
    return figure


def save_map_figure(
    path: str | PathLike[str],
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    before: ArrayLike | None = None,
    *,
    flipped: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
) -> None:
    """Write a PNG of a rest surface, the first guess of its map, and the map; 1200 × 450 pixels.

    Parameters
    ----------
    path : path
        Replaced as a whole once the picture is complete.
    V : (n, 2) or (n, 3) float
    F : (f, 3) int
    uv : (n, 2) float
    before : (n, 2) float, optional
        The first guess; without it the picture has two panels and is 800 pixels wide.
    flipped, fixed
        As for `plot_map`, of ``uv``.

    Raises
    ------
    ValueError
        When a vertex of the surface or a map is not finite.
    quasiharmonic.io.errors.OutputError
        When the file cannot be written.
    """
    from quasiharmonic.io.atomic import write_whole

    rest, F = _mesh(V, F)
    seen = view(rest, F)
    panels = 2 if before is None else 3
    figure = _figure((4 * panels, 4.5))
    axes = _panels(figure, panels)
    plot_surface(rest, F, axes[0])
    _caption(axes[0], f"surface: {len(F):,} triangles", _INK)
    if before is not None:
        _title(axes[1], "first guess", _draw_map(axes[1], seen, F, _finite(before, "before"), None, fixed))
    _title(axes[-1], "map", _draw_map(axes[-1], seen, F, _finite(uv, "uv"), flipped, fixed))
    write_whole(path, lambda file: figure.savefig(file, format="png"))


def _draw_map(
    ax: Axes,
    seen: View,
    F: IntArray,
    uv: FloatArray,
    flipped: ArrayLike | None,
    fixed: ArrayLike | None,
) -> int:
    """Draw a map into axes and return the number of its inverted triangles."""
    from matplotlib.collections import LineCollection

    scale = _fit(ax, uv)
    bad = _flipped(F, uv, flipped)
    color = seen.color.copy()
    color[bad] = _RED
    height = scale * least_heights(uv[F])
    edges, width = edge_style(color, height)
    # The inverted ones come last, over whatever they overlap.
    order = np.concatenate([np.delete(np.arange(len(F)), bad), bad])
    _fill(ax, uv[F[order]], color[order], edges[order], width[order])
    tiny = bad[height[bad] < 0.7]
    ax.plot(*uv[F[tiny]].mean(axis=1).T, ".", markersize=3, markeredgewidth=0, color=_RED, zorder=3)
    border = boundary_edges(F, len(uv))
    ax.add_collection(
        LineCollection(_polygons(uv[border]), colors=[_INK], linewidths=_BORDER, capstyle="round", zorder=4),
        autolim=False,
    )
    if fixed is not None:
        pins = np.setdiff1d(np.asarray(fixed, dtype=np.int64), border)
        ax.plot(*uv[pins].T, "o", markersize=5, color="white", mec=_INK, mew=1.4, zorder=5)
    return int(bad.size)


def _fill(ax: Axes, corners: FloatArray, color: FloatArray, edges: FloatArray, width: FloatArray) -> None:
    """Paint triangles in their order; corners (f, 3, 2), colours (f, 3)."""
    from matplotlib.collections import PolyCollection

    polygons = PolyCollection(
        _polygons(corners), facecolors=color, edgecolors=edges, linewidths=width, joinstyle="round", zorder=1
    )
    ax.add_collection(polygons, autolim=False)


def _polygons(corners: FloatArray) -> Sequence[ArrayLike]:
    """Corners as matplotlib's annotations want them; it is fastest with the array as it is."""
    return cast("Sequence[ArrayLike]", corners)


def _fit(ax: Axes, points: FloatArray) -> float:
    """Fit the view to the points, without frame; return how many points of print a unit has."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * (float((high - low).max()) or 1.0)
    low, high = low - margin, high + margin
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal")
    ax.set_axis_off()
    box = ax.get_window_extent()
    pixels = min(box.width / (high - low)[0], box.height / (high - low)[1])
    return float(pixels) * 72 / ax.figure.dpi


def _flipped(F: IntArray, uv: FloatArray, flipped: ArrayLike | None) -> IntArray:
    """Indices of the triangles given as inverted, or found so."""
    if flipped is None:
        a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
        return np.flatnonzero(~(a[:, 0] * b[:, 1] > a[:, 1] * b[:, 0]))
    given = np.asarray(flipped)
    return np.flatnonzero(given) if given.dtype == bool else given.astype(np.int64)


def _title(ax: Axes, name: str, inverted: int) -> None:
    """Write above a panel what it shows, at the same height in all."""
    text = f"{name}: {inverted:,} inverted" if inverted else f"{name}: no triangle inverted"
    _caption(ax, text, _RED if inverted else _INK)


def _caption(ax: Axes, text: str, color: tuple[float, float, float]) -> None:
    left, right = ax.get_position(original=True).intervalx
    ax.figure.text((left + right) / 2, 0.93, text, ha="center", size=12.5, color=color)


def _figure(inches: tuple[float, float]) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=inches, dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _panels(figure: Figure, count: int) -> list[Axes]:
    width = 1 / count
    return [figure.add_axes((i * width + 0.005, 0.02, width - 0.01, 0.88)) for i in range(count)]


def _mesh(V: ArrayLike, F: ArrayLike) -> tuple[FloatArray, IntArray]:
    return _finite(V, "V"), np.asarray(F, dtype=np.int64)


def _finite(points: ArrayLike, name: str) -> FloatArray:
    array = np.asarray(points, dtype=np.float64)
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        raise ValueError(f"{name} has no finite place for vertex {int(np.argmin(finite))}")
    return array
