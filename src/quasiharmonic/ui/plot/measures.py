"""Figures coloured by a measure, with histograms: the distortion of maps, and the quality of finite elements.

Also a displacement field: the mapped grid, coloured by the change of area of each cell. Elements are drawn before and
after their boundary moved; of tetrahedra, a cut through the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.displacement_fields.grid import Grid, check_field
from quasiharmonic.apps.displacement_fields.nearest import fold_free
from quasiharmonic.energies.measures import Distortion, distortion
from quasiharmonic.io.accepts_mesh import accepts_mesh, writer_accepts_mesh
from quasiharmonic.ui.plot.canvas import (
    INK,
    RED,
    as_mesh,
    caption,
    fill,
    fit,
    name_axes,
    new_figure,
    paint_map,
    paint_surface,
    save_picture,
    shade,
    view,
)
from quasiharmonic.util.arrays import FloatArray, IntArray, check_choice, count_of, map_array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

_GREY = (0.6, 0.6, 0.6)  # triangles without a value

#: The measures that can be drawn: axis label, value of a perfect map, and scale.
LABELS = {
    "sigma1": ("σ₁", None, "log"),
    "sigma2": ("σ₂", None, "log"),
    "mips": ("MIPS: σ₁/σ₂ + σ₂/σ₁ − 2", 0.0, "asinh"),
    "conformal": ("conformal ratio σ₁/σ₂", 1.0, "log"),
    "isometric": ("isometric distortion max(σ₁, 1/σ₂)", 1.0, "log"),
    "symmetric_dirichlet": ("symmetric Dirichlet energy", 0.0, "asinh"),
    "arap": ("ARAP energy", 0.0, "asinh"),
    "area_ratio": ("area ratio σ₁σ₂", 1.0, "both ways"),
    "shear": ("|μ|", 0.0, "linear"),
}
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


@dataclass(frozen=True, eq=False)
class _ColourScale:
    """Colour scale of one measure."""

    label: str
    norm: Normalize  # Limits from the 1st and 99th percentiles by area, or from the value of a perfect map
    # Diverging if a perfect map lies in the middle. No colormap contains red, which marks inverted triangles.
    colormap: str
    beyond: str = "max"  # {"max", "both"}: the ends beyond which there may be values

    def place(self, values: FloatArray) -> FloatArray:
        """Return the positions of values (k,) between the limits, 0 to 1."""
        return np.asarray(self.norm(np.clip(values, self.norm.vmin, self.norm.vmax))).clip(0, 1)

    @property
    def ticks(self) -> tuple[FloatArray, list[str]]:
        """Values at even steps of the colours, (5,) float64, and their labels."""
        values = np.asarray(self.norm.inverse(np.linspace(0, 1, 5)))
        return values, [f"{value:.3g}" for value in values]

    def colors(self, values: FloatArray) -> FloatArray:
        """Return colours (f, 3) of values (f,), grey where the value is NaN."""
        import matplotlib

        colors = np.asarray(matplotlib.colormaps[self.colormap](self.place(np.nan_to_num(values, nan=1.0))))[:, :3]
        colors[np.isnan(values)] = _GREY
        return colors


@accepts_mesh
def plot_distortion(V: ArrayLike, F: ArrayLike, uv: ArrayLike, measure: str = "isometric") -> Figure:
    """Draw a surface and its map coloured by a measure of distortion, and the measure's histogram.

    Inverted triangles are red; triangles without area in the rest mesh are grey. The colours range from the best value
    to the 99th percentile by area.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
        The rest surface.
    F : (f, 3) int
    uv : (n, 2) float
        The map.
    measure : str
        One of `quasiharmonic.energies.measures.MEASURES`, which `quasiharmonic.Distortion` describes.

    Returns
    -------
    matplotlib Figure
        Three panels: the surface, the map, and the share of the surface's area over the measure.

    Raises
    ------
    ValueError
        If the measure is unknown, if no triangle has a finite value, or as for `quasiharmonic.distortion`.
    """
    check_choice("measure", measure, LABELS)
    rest, F = as_mesh(V, F)
    uv = map_array("uv", uv, len(rest))
    found = distortion(rest, F, uv)
    values: FloatArray = found.per_triangle()[measure]
    scale = choose_scale(measure, values, found.share)
    color = scale.colors(values)

    figure = new_figure((13.5, 4.5))
    surface, plane, bars = (figure.add_axes((x, y, w, h)) for x, y, w, h in _LAYOUT)
    seen = view(rest, F)
    tinted = color.copy()
    tinted[found.inverted] = RED
    paint_surface(surface, seen, F, shade(tinted, seen.light))
    caption(surface, f"surface: {len(F):,} triangles")
    paint_map(plane, F, uv, color, found.inverted)
    many = len(found.inverted)
    caption(plane, f"map: {many:,} inverted" if many else "map", RED if many else INK)
    draw_bar(figure, scale)
    _histogram(bars, found, measure, values, scale)
    return figure


@writer_accepts_mesh
def save_distortion_figure(
    path: str | PathLike[str], V: ArrayLike, F: ArrayLike, uv: ArrayLike, measure: str = "isometric"
) -> None:
    """Write the figure of `plot_distortion`, 1350 × 450 pixels.

    Parameters
    ----------
    path : path
        Ends in .png, .svg or .pdf. The file is replaced only when the picture is complete.
    V, F, uv, measure
        As for `plot_distortion`.

    Raises
    ------
    ValueError
        As for `plot_distortion`.
    quasiharmonic.io.errors.OutputError
        If the file cannot be written.
    """
    save_picture(path, plot_distortion(V, F, uv, measure))


_BAR = (0.605, 0.14, 0.012, 0.74)
_LAYOUT = ((0.005, 0.02, 0.29, 0.88), (0.30, 0.02, 0.29, 0.88), (0.72, 0.14, 0.265, 0.74))


def choose_scale(measure: str, values: FloatArray, share: FloatArray) -> _ColourScale:
    """Choose the colour scale of a measure for the given values; raise ValueError if no value is usable."""
    from matplotlib.colors import AsinhNorm, LogNorm, Normalize

    label, perfect, kind = LABELS[measure]
    usable = np.isfinite(values) & ((values > 0) | (kind in ("asinh", "linear")))
    if not usable.any():
        raise ValueError(f"{measure} has no finite value on any triangle that is not inverted")
    low, high = _share_between(values[usable], share[usable], 0.01, 0.99)
    if kind == "linear":
        return _ColourScale(label, Normalize(0.0, max(min(high, 1.0), 1e-3)), "viridis")
    if kind == "asinh":
        top = max(high, 1e-3)
        return _ColourScale(label, AsinhNorm(linear_width=min(1.0, top), vmin=0.0, vmax=top), "viridis")
    if kind == "both ways":
        reach = max(high, 1 / low, 1.1)
        return _ColourScale(label, LogNorm(1 / reach, reach), "PuOr", "both")
    if perfect is None:
        return _ColourScale(label, LogNorm(low, max(high, 1.01 * low)), "viridis", "both")
    return _ColourScale(label, LogNorm(perfect, max(high, 1.01 * perfect)), "viridis")


def _share_between(values: FloatArray, share: FloatArray, low: float, high: float) -> tuple[float, float]:
    """Return two quantiles of the values, weighted by area."""
    order = np.argsort(values)
    below = np.cumsum(share[order])
    at = np.searchsorted(below, np.array([low, high]) * below[-1]).clip(max=len(order) - 1)
    first, last = values[order[at]]
    return float(first), float(last)


def draw_bar(figure: Figure, scale: _ColourScale, box: tuple[float, float, float, float] = _BAR) -> None:
    """Draw the colour bar of a scale into a box of the figure: left, bottom, width and height."""
    from matplotlib.cm import ScalarMappable

    drawn = ScalarMappable(scale.norm, scale.colormap)
    bar = figure.colorbar(drawn, cax=figure.add_axes(box), extend=scale.beyond)
    # Use the histogram's ticks, because a logarithmic bar over less than a decade has at most one tick.
    bar.ax.set_yticks(*scale.ticks, size=9)
    bar.ax.minorticks_off()


def _histogram(ax: Axes, found: Distortion, measure: str, values: FloatArray, scale: _ColourScale) -> None:
    """Draw the histogram of the measure over the surface's area, in equal steps of the colours."""
    import matplotlib

    known = np.isfinite(values)
    shares, steps = np.histogram(scale.place(values[known]), bins=40, range=(0, 1), weights=100 * found.share[known])
    middle = (steps[1:] + steps[:-1]) / 2
    ax.bar(steps[:-1], shares, width=1 / 40, align="edge", color=matplotlib.colormaps[scale.colormap](middle))
    _, names = scale.ticks
    ax.set_xticks(np.linspace(0, 1, len(names)), names, size=9)
    name_axes(ax, scale.label, "% of the surface's area")
    summed = found.statistics(measure)
    caption(ax, f"median {summed.median:.3g}, 95 % < {summed.p95:.3g}, max {summed.maximum:.3g}")


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
