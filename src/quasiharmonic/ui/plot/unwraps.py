"""The figure of texture coordinates: the charts, a checkerboard, the stretch, and the texel density."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.mesh.topology import components
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.ui.plot.canvas import (
    RED,
    as_mesh,
    caption,
    new_figure,
    paint_map,
    paint_surface,
    shade,
    verdict,
    view,
)
from quasiharmonic.ui.plot.distortion import choose_scale, draw_bar
from quasiharmonic.ui.plot.texture import checkerboard_color, render, show_render
from quasiharmonic.util.arrays import map_array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SQUARES = 32  # of the checkerboard, along the unit square


@accepts_mesh
def plot_unwrap(V: ArrayLike, F: ArrayLike, uv: ArrayLike) -> Figure:
    """Draw texture coordinates: the charts, and the surface with a checkerboard, the stretch and the texel density.

    Triangles whose orientation differs from that of their chart are red.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
        Positions; vertices on seams occur once for each chart, as in ``V[result.vmapping]`` of an `UnwrapResult`.
    F : (f, 3) int
    uv : (n, 2) float
        Texture coordinates. Each connected component of ``F`` is a chart, and may be mirrored.

    Returns
    -------
    matplotlib Figure
        Four panels. The stretch is the larger of σ₁ and 1/σ₂ after one scaling of all charts. The texel density is
        relative to its mean.

    Raises
    ------
    ValueError
        If there are no triangles, or a coordinate is not finite.
    """
    rest, F = as_mesh(V, F)
    uv = map_array("uv", uv, len(rest))
    seen = view(rest, F)
    part = components(F, len(rest))
    first, chart = np.unique(part, return_inverse=True)
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    area = np.bincount(chart[F[:, 0]], a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], minlength=len(first))
    upright = uv * np.column_stack([np.where(area[chart] < 0, -1.0, 1.0), np.ones(len(uv))])
    found = distortion(rest, F, upright)
    bad = np.flatnonzero(found.sigma2 <= 0)

    figure = new_figure((18.4, 4.8))
    layout, board, stretched, dense = (figure.add_axes((x, 0.02, 0.225, 0.88)) for x in (0.003, 0.233, 0.463, 0.733))
    # Neighbouring numbers have different colours, and none is red.
    from matplotlib import colormaps

    paint_map(layout, F, uv, colormaps["viridis"](chart[F[:, 0]] * 0.618 % 1)[:, :3], bad)
    verdict(layout, f"{len(first)} charts" if len(first) > 1 else "1 chart", len(bad))
    show_render(
        board,
        seen.points,
        render(seen.points, seen.depth, F, uv * _SQUARES, checkerboard_color, bad, seen.light),
    )
    caption(board, "checkerboard")
    density = np.sqrt(np.where(found.area_ratio > 0, found.area_ratio, np.nan))
    for ax, name, measure, values, left in (
        (stretched, "stretch", "isometric", found.isometric, 0.694),
        (dense, "texel density, relative to the mean", "area_ratio", density, 0.964),
    ):
        scale = choose_scale(measure, values, found.share)
        color = scale.colors(values)
        color[bad] = RED
        paint_surface(ax, seen, F, shade(color, seen.light))
        caption(ax, name)
        draw_bar(figure, scale, (left, 0.14, 0.008, 0.74))
    return figure
