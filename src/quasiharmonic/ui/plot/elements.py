"""The figure of a finite-element mesh, or of a cut through it, before and after its boundary moved."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from quasiharmonic.ui.plot.canvas import INK, RED, caption, fill, fit, name_axes, new_figure
from quasiharmonic.util.arrays import FloatArray, IntArray, count_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Points of a curved side, without its end.
_STEPS = 6
# Widths of a panel and of the histogram in inches.
_PANEL, _HISTOGRAM = 4.68, 3.64
# Edges that a plane cuts, around the cut, by the number of vertices below it; the vertices below come first.
_CUT_EDGES = {
    1: ((0, 1), (0, 2), (0, 3), (0, 3)),
    2: ((0, 2), (0, 3), (1, 3), (1, 2)),
    3: ((0, 3), (1, 3), (2, 3), (2, 3)),
}
#: Outlines (m, k, 2), and the element (m,) of each.
Outlines: TypeAlias = tuple[FloatArray, IntArray]


def elements_figure(drawn: Sequence[Outlines], quality: Sequence[FloatArray], inverted: IntArray) -> Figure:
    """Draw a mesh, or its states before and after, coloured by quality, and the histograms of the quality.

    ``drawn`` are the outlines and ``quality`` (f,) the qualities of each state. The ``inverted`` elements of the last
    state are red.
    """
    from matplotlib import colormaps

    names = ("before", "after")[: len(drawn)] if len(drawn) > 1 else ("mesh",)
    inches = _PANEL * len(drawn) + _HISTOGRAM
    figure = new_figure((inches, 5))
    colors = colormaps["viridis"]
    for k, name in enumerate(names):
        ax = figure.add_axes(((_PANEL * k + 0.065) / inches, 0.02, (_PANEL - 0.13) / inches, 0.88))
        bad = inverted if k == len(names) - 1 else np.empty(0, dtype=np.int64)
        _draw_elements(ax, drawn[k], colors(np.clip(quality[k], 0, 1))[:, :3], bad)
        worst = f"worst quality {quality[k].min():.3g}, mean {quality[k].mean():.3g}"
        text = f"{name}: {count_of('element', 'elements', len(bad))} inverted" if len(bad) else f"{name}: {worst}"
        caption(ax, text, RED if len(bad) else INK)
    ax = figure.add_axes((1 - (_HISTOGRAM - 0.65) / inches, 0.14, (_HISTOGRAM - 0.91) / inches, 0.74))
    bins = np.linspace(min(0.0, float(quality[-1].min())), 1, 41)
    styles: list[dict[str, Any]] = [
        {"histtype": "step", "color": INK},
        {"histtype": "stepfilled", "color": colors(0.6)},
    ]
    for name, values, style in zip(names, quality, styles[-len(names) :], strict=True):
        ax.hist(np.clip(values, bins[0], 1), list(bins), label=name, **style)
    name_axes(ax, "quality (1: best)", "elements")
    if len(names) > 1:
        ax.legend(frameon=False)
    return figure


def _draw_elements(ax: Axes, drawn: Outlines, colors: FloatArray, inverted: IntArray) -> None:
    outlines, of = drawn
    corners = outlines.reshape(-1, 2)
    scale = fit(ax, corners)
    colors = colors.copy()
    colors[inverted] = RED
    # Lines become thinner where elements are small.
    size = scale * np.sqrt(np.ptp(corners, axis=0).prod() / len(of))
    width = float(np.clip(size / 30, 0.05, 0.6))
    order = np.argsort(np.isin(of, inverted), kind="stable")
    fill(ax, outlines[order], colors[of[order]], [(*INK, 0.8)], width)


def outline_elements(F: IntArray, points: FloatArray) -> Outlines:
    """Return the outlines of planar elements (f, 3), (f, 4) or (f, 6); sides of second-order ones are parabolas."""
    return _follow_sides(F, points) if F.shape[1] == 6 else points[F], np.arange(len(F))


def cut_tetrahedra(T: IntArray, X: FloatArray, through: int) -> Outlines:
    """Return the outlines of the cut of tetrahedra (t, 4) with a plane through the centre of one of them.

    The plane is normal to the shortest side of the bounding box.
    """
    axis = int(np.ptp(X[np.unique(T)], axis=0).argmin())
    height = X[:, axis] - X[T[through], axis].mean()
    above = height[T] >= 0
    # The vertices below the plane come first.
    ordered = np.take_along_axis(T, np.argsort(above, axis=1, kind="stable"), axis=1)
    outlines, of = [np.empty((0, 4, 2))], [np.empty(0, dtype=np.int64)]
    for below, edges in _CUT_EDGES.items():
        rows = np.flatnonzero((~above).sum(axis=1) == below)
        low, high = (ordered[rows][:, [edge[k] for edge in edges]] for k in (0, 1))
        share = (height[low] / (height[low] - height[high]))[..., None]
        outlines.append(np.delete(X[low] + share * (X[high] - X[low]), axis, axis=2))
        of.append(rows)
    return np.concatenate(outlines), np.concatenate(of)


def _follow_sides(F: IntArray, points: FloatArray) -> FloatArray:
    """Return points of the curved sides of second-order triangles, (f, m, 2)."""
    t = (np.arange(_STEPS) / _STEPS)[:, None]
    # Lagrange polynomials of the side's ends and its middle.
    first, middle, last = (1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)
    sides = []
    for k in range(3):
        a, m, b = (points[F[:, node], None] for node in (k, 3 + k, (k + 1) % 3))
        sides.append(first * a + middle * m + last * b)
    return np.concatenate(sides, axis=1)
