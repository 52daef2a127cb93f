"""Figures of problems: a surface beside where its boundary and its pins go, and what stands in the way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.ui.plot.canvas import BORDER, INK, RED, as_mesh, caption, fit, new_figure, paint_surface, panels
from quasiharmonic.ui.plot.shading import drawable, view
from quasiharmonic.util.arrays import FloatArray, IntArray, held_places, held_vertices

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@accepts_mesh
def plot_problem(
    V: ArrayLike,
    F: ArrayLike,
    fixed: ArrayLike,
    target: ArrayLike,
    *,
    vertices: ArrayLike = (),
    edges: ArrayLike = (),
) -> Figure:
    """Draw a surface beside where its fixed vertices go: boundary edges as lines, pins as dots.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
    F : (f, 3) array of int
    fixed : (k,) array of int
        The boundary and any pins.
    target : (k, 2) array
    vertices : (a,) array of int
    edges : (b, 2) array of int
        What is marked in red, as a diagnosis names it; beside the surface as far as its vertices are fixed.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        When an array has the wrong shape, refers to what there is not, or is not finite.
    """
    rest, F = as_mesh(V, F)
    held = held_vertices(fixed, len(rest))
    places = np.full((len(rest), 2), np.nan)
    places[held] = drawable(held_places(target, len(held)))
    border, marked = boundary_edges(F, len(rest)), np.asarray(vertices, dtype=np.int64)
    figure, seen = new_figure((8, 4.5)), view(rest, F)
    surface, plane = panels(figure, 2)
    paint_surface(surface, seen, F, seen.color)
    caption(surface, f"surface: {len(F):,} triangles")
    fit(plane, places[held])
    _lines(plane, places, border, INK, BORDER)
    pins = np.setdiff1d(held, border)
    plane.plot(*places[pins].T, "o", markersize=5, color="white", mec=INK, mew=1.4, zorder=5)
    caption(plane, f"where {len(held):,} vertices go")
    for ax, points in ((surface, seen.points), (plane, places)):
        _lines(ax, points, np.asarray(edges, dtype=np.int64).reshape(-1, 2), RED, 2 * BORDER)
        ax.plot(*points[marked].T, "o", markersize=5, color=RED, zorder=7)
    return figure


def _lines(ax: Axes, points: FloatArray, edges: IntArray, color: tuple[float, float, float], width: float) -> None:
    """Draw edges, as far as both ends have a place."""
    ends = points[edges].reshape(-1, 2, 2)
    gap = np.full((len(ends), 1, 2), np.nan)
    x, y = np.concatenate([ends, gap], axis=1).reshape(-1, 2).T
    ax.plot(x, y, color=color, linewidth=width, solid_capstyle="round", zorder=6)
