"""The figure of a displacement field: the mapped grid, and the change of area of each cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import Grid, check_field
from quasiharmonic.apps.displacement_fields.nearest import fold_free
from quasiharmonic.ui.plot.canvas import INK, RED, caption, fill, fit, new_figure
from quasiharmonic.ui.plot.distortion import choose_scale, draw_bar
from quasiharmonic.util.arrays import count_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_field(field: ArrayLike, *, spacing: ArrayLike = 1.0) -> Figure:
    """Draw the cells of a displacement field before and after, coloured by area ratio, folded cells in red.

    Parameters
    ----------
    field : (h, w, 2) or (d, h, w, 3) array
        Displacements; see `quasiharmonic.nearest_invertible`. Of a field on voxels, the slice with the most folded
        cells is drawn, as seen along z.
    spacing : float, (float, float) or (float, float, float)
        Distance between neighbouring pixels, along x, along y, and along z.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        If the field has the wrong shape or is not finite, or the spacing is not positive.
    """
    given = check_field(field)
    folded = ~fold_free(given, spacing=spacing)
    grid = Grid(given.shape[:-1], spacing)
    mapped, rest = grid.positions(given), grid.points
    folds, where = int(folded.sum()), ""
    if given.ndim == 4:
        layer = int(folded.sum(axis=(1, 2)).argmax())
        mapped, rest, folded, where = mapped[layer], rest[layer], folded[layer], f", slice {layer}"
    # Rows run downwards.
    before, after = (
        np.stack([p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]], axis=2)[..., :2].reshape(-1, 4, 2) * [1, -1]
        for p in (rest, mapped)
    )
    diagonals = after[:, 2:] - after[:, :2]
    ratio = (diagonals[:, 1, 0] * diagonals[:, 0, 1] - diagonals[:, 1, 1] * diagonals[:, 0, 0]) / 2
    ratio /= grid.spacing[0] * grid.spacing[1]
    bad = folded.ravel()
    usable = ratio[~bad & (ratio > 0)]
    usable = usable if usable.size else np.ones(1)
    scale = choose_scale("area_ratio", usable, np.ones(len(usable)))
    colors = np.where(bad[:, None], RED, scale.colors(np.where(ratio > 0, ratio, np.nan)))
    order = np.argsort(bad, kind="stable")
    figure = new_figure((10.4, 4.8))
    for k, cells in enumerate((before, after)):
        ax = figure.add_axes((0.005 + 0.45 * k, 0.02, 0.44, 0.88))
        width = float(np.clip(fit(ax, cells.reshape(-1, 2)) * grid.spacing[:2].min() / 30, 0.05, 0.6))
        fill(ax, cells[order], colors[order], [(*INK, 0.6)], width)
    caption(figure.axes[0], f"field{where}: {count_of('cell', 'cells', folds)} folded", RED if folds else INK)
    caption(figure.axes[1], "mapped grid, coloured by area ratio")
    draw_bar(figure, scale, (0.925, 0.14, 0.012, 0.74))
    return figure
