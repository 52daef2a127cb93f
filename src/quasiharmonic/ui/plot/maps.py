"""Figures of problems and maps: the surface, the targets of its boundary, the map, and an earlier map for comparison.

Boundary vertices have numbers; those that would overlap are omitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.accepts_mesh import accepts_mesh, writer_accepts_mesh
from quasiharmonic.ui.plot.canvas import (
    BORDER,
    INK,
    RED,
    View,
    as_mesh,
    caption,
    draw_edges,
    draw_pins,
    find_not_positive,
    fit,
    new_figure,
    paint_map,
    paint_surface,
    panels,
    save_picture,
    scale_for_drawing,
    verdict,
    view,
)
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_range,
    distinct_vertices,
    index_array,
    loop_arrays,
    map_array,
    target_positions,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class NumberStyle(NamedTuple):
    """Sizes of the numbers at vertices, in units of the font size."""

    # Font size in points.
    font_size: float = 7.5
    # Width of a digit.
    digit_width: float = 0.68
    # Height of a number.
    height: float = 1.25
    # Distance of a number from its vertex.
    distance: float = 0.3


_NUMBERS = NumberStyle()


@accepts_mesh
def plot_surface(V: ArrayLike, F: ArrayLike, ax: Axes) -> None:
    """Draw a rest surface, shaded and coloured as `plot_map` colours its map.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
    F : (f, 3) int
    ax : matplotlib Axes
        Two-dimensional axes; the function projects the surface itself.

    Raises
    ------
    ValueError
        If a vertex is not finite.
    """
    rest, F = as_mesh(V, F)
    seen = view(rest, F)
    paint_surface(ax, seen, F, seen.color)


@accepts_mesh
def plot_map(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    inverted: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a map, its inverted triangles in red on top.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
        The rest surface, whose shading colours the triangles.
    F : (f, 3) int
    uv : (n, 2) float
        The map.
    inverted : (k,) int or (f,) bool, optional
        The triangles to show as inverted, as a certificate lists them. By default those whose area
        in floating point is not positive.
    fixed : (k,) int, optional
        Fixed vertices; those in the interior are marked.
    ax : matplotlib Axes, optional
        Axes to draw into; by default the axes of a new `matplotlib.figure.Figure`.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ValueError
        If a vertex of the surface or the map is not finite.
    """
    rest, F = as_mesh(V, F)
    if ax is None:
        from quasiharmonic.ui.plot.notebook_figures import NotebookAxes

        ax = new_figure((6, 6)).add_axes((0.02, 0.02, 0.96, 0.9), axes_class=NotebookAxes)
    _draw_map(ax, view(rest, F), F, map_array("uv", uv, len(rest)), inverted, fixed)
    return ax


@accepts_mesh
def plot_before_after(
    V: ArrayLike, F: ArrayLike, before: ArrayLike, after: ArrayLike, *, fixed: ArrayLike | None = None
) -> Figure:
    """Draw two maps of one surface side by side, inverted triangles in red.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
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
        If a vertex of the surface or a map is not finite.
    """
    rest, F = as_mesh(V, F)
    figure, seen = new_figure((9, 4.8)), view(rest, F)
    for ax, uv, name in zip(panels(figure, 2), (before, after), ("before", "after"), strict=True):
        verdict(ax, name, _draw_map(ax, seen, F, map_array(name, uv, len(rest)), None, fixed))
    return figure


@writer_accepts_mesh
def save_map_figure(
    path: str | PathLike[str],
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    before: ArrayLike | None = None,
    *,
    inverted: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
) -> None:
    """Write a picture of a rest surface, its initial map, and its map; 1200 × 450 pixels.

    Parameters
    ----------
    path : path
        Ends in .png, .svg or .pdf. The file is replaced only when the picture is complete.
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
    F : (f, 3) int
    uv : (n, 2) float
    before : (n, 2) float, optional
        The initial map. Without it the picture has two panels and is 800 pixels wide.
    inverted, fixed
        As for `plot_map`, of ``uv``.

    Raises
    ------
    ValueError
        If a vertex of the surface or a map is not finite, or the suffix is not supported.
    quasiharmonic.io.errors.OutputError
        If the file cannot be written.
    """
    save_picture(path, map_figure(V, F, uv, before, inverted=inverted, fixed=fixed))


def map_figure(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    before: ArrayLike | None = None,
    *,
    inverted: ArrayLike | None = None,
    fixed: ArrayLike | None = None,
) -> Figure:
    """Draw the figure that `save_map_figure` writes."""
    rest, F = as_mesh(V, F)
    seen = view(rest, F)
    count = 2 if before is None else 3
    figure = new_figure((4 * count, 4.5))
    axes = panels(figure, count)
    plot_surface(rest, F, axes[0])
    caption(axes[0], f"surface: {len(F):,} triangles")
    if before is not None:
        guess = map_array("before", before, len(rest))
        verdict(axes[1], "first guess", _draw_map(axes[1], seen, F, guess, None, fixed))
    verdict(axes[-1], "map", _draw_map(axes[-1], seen, F, map_array("uv", uv, len(rest)), inverted, fixed))
    return figure


def _draw_map(
    ax: Axes, seen: View, F: IntArray, uv: FloatArray, inverted: ArrayLike | None, fixed: ArrayLike | None
) -> int:
    """Draw a map into axes and return the number of its inverted triangles."""
    marked = _check_inverted(inverted, len(F)) if inverted is not None else find_not_positive(F, uv)
    paint_map(ax, F, uv, seen.color, marked, fixed)
    return int(marked.size)


def _check_inverted(inverted: ArrayLike, count: int) -> IntArray:
    """Return the indices of triangles given as indices or as a mask."""
    mask = np.asarray(inverted)
    if mask.dtype == bool and mask.shape == (count,):
        return np.flatnonzero(mask)
    indices = index_array("inverted", inverted)
    check_range("inverted", indices, count, "triangle", "triangles")
    return indices


@writer_accepts_mesh
def save_boundary_figure(
    path: str | PathLike[str], V: ArrayLike, F: ArrayLike, loops: Sequence[IntArray], corners: ArrayLike = ()
) -> None:
    """Write a picture of a surface with its boundary vertices numbered, 1000 × 1000 pixels.

    A number that would overlap another one is omitted; the numbers of corners are placed first. Boundaries behind the
    surface are drawn too.

    Parameters
    ----------
    path : path
        Ends in .png, .svg or .pdf. The file is replaced only when the picture is complete.
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
    F : (f, 3) int
    loops : sequence of (l,) int64
        Boundary vertices in order.
    corners : (k,) int
        Boundary vertices to mark, in the order in which their numbers are placed.

    Raises
    ------
    ValueError
        If a vertex of the surface is not finite.
    quasiharmonic.io.errors.OutputError
        If the file cannot be written.
    """
    rest, F = as_mesh(V, F)
    seen, marked = view(rest, F), index_array("corners", corners)
    loops = loop_arrays(loops, len(rest))
    check_range("corners", marked, len(rest))
    figure = new_figure((10, 10))
    ax = figure.add_axes((0.04, 0.02, 0.92, 0.9))
    # Pale colours keep the numbers readable.
    paint_surface(ax, seen, F, 0.4 * seen.color + 0.6)
    scale = fit(ax, seen.points)
    for loop in loops:
        ax.plot(*seen.points[np.append(loop, loop[0])].T, color=INK, linewidth=BORDER, zorder=4)
        ax.plot(*seen.points[loop].T, ".", color=INK, markersize=2.5, zorder=5)
    ax.plot(*seen.points[marked].T, "o", color=RED, markersize=5, zorder=6)
    border = np.concatenate([marked, *(loop[~np.isin(loop, marked)] for loop in loops)])
    digits = np.array([len(str(vertex)) for vertex in border.tolist()])
    size = np.stack([_NUMBERS.digit_width * (digits + 1), np.full(len(digits), _NUMBERS.height)], axis=1)
    half, gap = _NUMBERS.font_size / 2 * size, _NUMBERS.distance * _NUMBERS.font_size
    centres = scale * seen.points[border] + (half + gap) * _outward(seen.points, F, border)
    for k in _find_readable(centres, half):
        color = RED if k < len(marked) else INK
        x, y = centres[k] / scale
        ax.text(x, y, str(border[k]), size=_NUMBERS.font_size, color=color, ha="center", va="center", zorder=7)
    count, many = sum(len(loop) for loop in loops), "" if len(loops) == 1 else "s"
    caption(ax, f"{count:,} boundary vertices in {len(loops)} loop{many}; corners in red")
    save_picture(path, figure)


def _outward(points: FloatArray, F: IntArray, border: IntArray) -> FloatArray:
    """Return unit vectors from the surrounding triangles towards some boundary vertices; (k, 2)."""
    middles, count = np.zeros_like(points), np.zeros(len(points))
    for corner in F.T:
        np.add.at(middles, corner, points[F].mean(axis=1))
        np.add.at(count, corner, 1)
    away = points[border] - middles[border] / count[border, None]
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1), np.finfo(float).tiny)[:, None])


def _find_readable(centres: FloatArray, half: FloatArray) -> list[int]:
    """Return the indices of a greedy choice of boxes that do not overlap.

    The boxes have ``centres`` (k, 2) and half sizes ``half`` (k, 2). Earlier boxes take precedence.
    """
    chosen: list[int] = []
    for k in range(len(centres)):
        apart = np.abs(centres[chosen] - centres[k]) >= half[chosen] + half[k]
        if apart.any(axis=1).all():
            chosen.append(k)
    return chosen


@accepts_mesh
def plot_problem(
    V: ArrayLike, F: ArrayLike, fixed: ArrayLike, target: ArrayLike, *, vertices: ArrayLike = (), edges: ArrayLike = ()
) -> Figure:
    """Draw a surface beside the targets of its fixed vertices: boundary edges as lines, pins as dots.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
    F : (f, 3) array of int
    fixed : (k,) array of int
        The boundary and any pins.
    target : (k, 2) array
        Target positions of the fixed vertices.
    vertices : (a,) array of int
    edges : (b, 2) array of int
        Vertices and edges to mark in red, as a diagnosis lists them. In the plane only fixed ones are marked.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        If an array has the wrong shape, contains an invalid index, or is not finite.
    """
    rest, F = as_mesh(V, F)
    held = distinct_vertices("fixed", fixed, len(rest))
    places = np.full((len(rest), 2), np.nan)
    places[held] = scale_for_drawing(target_positions(target, len(held)))
    border, marked = boundary_edges(F, len(rest)), index_array("vertices", vertices)
    pairs = index_array("edges", edges).reshape(-1, 2)
    check_range("vertices", marked, len(rest))
    check_range("edges", pairs, len(rest))
    figure, seen = new_figure((8, 4.5)), view(rest, F)
    surface, plane = panels(figure, 2)
    paint_surface(surface, seen, F, seen.color)
    caption(surface, f"surface: {len(F):,} triangles")
    fit(plane, places[held])
    draw_edges(plane, places, border, zorder=6)
    draw_pins(plane, places[np.setdiff1d(held, border)])
    caption(plane, f"where {len(held):,} vertices go")
    for ax, points in ((surface, seen.points), (plane, places)):
        draw_edges(ax, points, pairs, RED, 2 * BORDER, zorder=6)
        ax.plot(*points[marked].T, "o", markersize=5, color=RED, zorder=7)
    return figure
