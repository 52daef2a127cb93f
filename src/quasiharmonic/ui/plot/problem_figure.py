"""Figures of problems: a surface beside the target positions of its boundary and pins, and the obstructions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.ui.plot.canvas import (
    BORDER,
    RED,
    as_mesh,
    caption,
    draw_edges,
    draw_pins,
    fit,
    new_figure,
    paint_surface,
    panels,
)
from quasiharmonic.ui.plot.shading import scale_for_drawing, view
from quasiharmonic.util.arrays import check_range, fixed_vertices, index_array, target_positions

if TYPE_CHECKING:
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
