"""The figure of a finite-element mesh before and after its boundary moved."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.ui.plot.canvas import INK, RED, caption, fill, fit, name_axes, new_figure
from quasiharmonic.util.arrays import FloatArray, IntArray, count_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Points of a curved side, without its end.
_STEPS = 6


def elements_figure(
    F: IntArray,
    positions: tuple[FloatArray, FloatArray],
    quality: tuple[FloatArray, FloatArray],
    inverted: IntArray,
) -> Figure:
    """Draw a mesh before and after, coloured by quality, and the histograms of both qualities.

    ``F`` (f, 3), (f, 4) or (f, 6) are the elements; ``positions`` (n, 2) and ``quality`` (f,) are those before and
    after. The ``inverted`` elements of the mesh after are red.
    """
    from matplotlib import colormaps

    figure = new_figure((13, 5))
    colors = colormaps["viridis"]
    for k, name in enumerate(("before", "after")):
        ax = figure.add_axes((0.36 * k + 0.005, 0.02, 0.35, 0.88))
        bad = inverted if k else np.empty(0, dtype=np.int64)
        _draw_elements(ax, F, positions[k], colors(np.clip(quality[k], 0, 1))[:, :3], bad)
        worst = f"worst quality {quality[k].min():.3g}, mean {quality[k].mean():.3g}"
        text = f"{name}: {count_of('element', 'elements', len(bad))} inverted" if len(bad) else f"{name}: {worst}"
        caption(ax, text, RED if len(bad) else INK)
    ax = figure.add_axes((0.77, 0.14, 0.21, 0.74))
    bins = np.linspace(min(0.0, float(quality[1].min())), 1, 41)
    for k, name in enumerate(("before", "after")):
        style: dict[str, Any] = {"histtype": ("step", "stepfilled")[k], "color": (INK, colors(0.6))[k], "label": name}
        ax.hist(np.clip(quality[k], bins[0], 1), list(bins), **style)
    name_axes(ax, "quality (1: best)", "elements")
    ax.legend(frameon=False)
    return figure


def _draw_elements(ax: Axes, F: IntArray, points: FloatArray, colors: FloatArray, inverted: IntArray) -> None:
    used = points[np.unique(F)]
    scale = fit(ax, used)
    outline = _outlines(F, points)
    colors = colors.copy()
    colors[inverted] = RED
    # Lines become thinner where elements are small.
    size = scale * np.sqrt(np.ptp(used, axis=0).prod() / len(F))
    width = float(np.clip(size / 30, 0.05, 0.6))
    order = np.argsort(np.isin(np.arange(len(F)), inverted), kind="stable")
    fill(ax, outline[order], colors[order], [(*INK, 0.8)], width)


def _outlines(F: IntArray, points: FloatArray) -> FloatArray:
    """Return the outline of each element, (f, m, 2); sides of second-order triangles are parabolas."""
    if F.shape[1] != 6:
        return points[F]
    t = (np.arange(_STEPS) / _STEPS)[:, None]
    # Lagrange polynomials of the side's ends and its middle.
    first, middle, last = (1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)
    sides = []
    for k in range(3):
        a, m, b = (points[F[:, node], None] for node in (k, 3 + k, (k + 1) % 3))
        sides.append(first * a + middle * m + last * b)
    return np.concatenate(sides, axis=1)
