"""Figures of maps: the surface, the map, and an earlier map for comparison."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh, writer_accepts_mesh
from quasiharmonic.ui.plot.canvas import (
    View,
    as_mesh,
    caption,
    find_not_positive,
    new_figure,
    paint_map,
    paint_surface,
    panels,
    save_picture,
    verdict,
    view,
)
from quasiharmonic.util.arrays import FloatArray, IntArray, check_range, index_array, map_array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
