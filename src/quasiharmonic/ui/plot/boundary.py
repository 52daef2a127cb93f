"""Figures of boundaries: a surface with numbered boundary vertices, and a problem with the targets of its vertices.

Numbers that would overlap are omitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh, writer_accepts_mesh
from quasiharmonic.ui.plot.canvas import (
    BORDER,
    INK,
    RED,
    as_mesh,
    caption,
    draw_edges,
    draw_pins,
    fit,
    new_figure,
    paint_surface,
    panels,
    save_picture,
    scale_for_drawing,
    view,
)
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_range,
    fixed_vertices,
    index_array,
    loop_arrays,
    target_positions,
)

if TYPE_CHECKING:
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
    held = fixed_vertices(fixed, len(rest))
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
