"""Pictures of a report: charts as SVG with the colours of the style sheet, and thumbnails of problems and maps."""

from __future__ import annotations

import re
from base64 import b64encode
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import io
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.ui.batch.results import find_map
from quasiharmonic.util.arrays import FloatArray, scale_to_unit
from quasiharmonic.util.options import MAP_FORMATS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from quasiharmonic.io import MeshData


class ChartSizes(NamedTuple):
    """Sizes of charts."""

    # Number of bins of a histogram per factor of ten.
    bins_per_decade: int = 6
    # Sizes in pixels of the SVG.
    font: int = 13
    width: int = 640
    height: int = 400
    # Maximum number of triangles in a picture; drawing that many takes about one second.
    max_triangles: int = 100_000


_SIZES = ChartSizes()

# Matplotlib draws with these colours; in the SVG the style sheet's variables replace them.
_COLORS = {"ours": "#2463c8", "theirs": "#c26a00", "failed": "#c2182c", "quiet": "#5d6878", "line": "#dde2ea"}
_QUIET = _COLORS["quiet"]
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def power(exponent: int) -> str:
    """Return a power of ten as text."""
    plain = {-3: "0.001", -2: "0.01", -1: "0.1", 0: "1", 1: "10", 2: "100", 3: "1000"}
    return plain.get(exponent, "10" + str(exponent).translate(_SUPERSCRIPTS))


def histogram(series: list[tuple[str, FloatArray]], label: str) -> str:
    """Return histograms over a logarithmic axis as SVG: the first series as bars, the others as lines.

    Each series is the name of a colour and values. Values that are not finite are omitted; values that are not positive
    count in the first bar. ``label`` is that of the value axis.
    """
    from matplotlib.ticker import PercentFormatter

    finite = [(color, values[np.isfinite(values)]) for color, values in series]
    low, high = _decades([values for _, values in finite], least=1e-6)
    edges = np.logspace(low, high, (high - low) * _SIZES.bins_per_decade + 1)
    figure, axes = _chart(label, "share of the maps")
    _use_decades(axes, "x", low, high)
    for k, (color, values) in enumerate(finite):
        weights = np.full(values.size, 1 / max(values.size, 1))
        style: dict[str, Any] = {"histtype": "step", "linewidth": 2} if k else {"rwidth": 0.95, "alpha": 0.8}
        axes.hist(np.clip(values, edges[0], edges[-1]), edges.tolist(), weights=weights, color=_COLORS[color], **style)
    axes.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    return _svg(figure)


def scatter(series: list[tuple[str, FloatArray, FloatArray]], x_label: str, y_label: str, *, same: bool = False) -> str:
    """Return a scatter plot over two logarithmic axes as SVG; its size is bounded for any number of dots.

    Each series is the name of a colour and coordinates; pairs that are not positive and finite are omitted. With
    ``same``, both axes have the same range, and lines show where y is 1, 10 and 100 times smaller than x.
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path
    from matplotlib.transforms import IdentityTransform

    dots = [(color, np.column_stack([x, y])) for color, x, y in series]
    dots = [(color, xy[((xy > 0) & (xy < np.inf)).all(axis=1)]) for color, xy in dots]
    xs, ys = ([xy[:, k] for _, xy in dots] for k in (0, 1))
    figure, axes = _chart(x_label, y_label)
    x_range, y_range = _decades(xs + ys if same else xs), _decades(xs + ys if same else ys)
    _use_decades(axes, "x", *x_range)
    _use_decades(axes, "y", *y_range)
    low, high = x_range
    for exponent in range(min(3, high - low)) if same else ():
        start = 10.0 ** (low + exponent), 10.0**low
        axes.plot((start[0], 10.0**high), (start[1], 10.0 ** (high - exponent)), "--", color=_QUIET, linewidth=1)
        label, place = f"{10**exponent} ×", (34, 5)
        axes.annotate(label, start, place, textcoords="offset pixels", color=_QUIET, size=_SIZES.font)
    count = sum(map(len, xs))
    for color, xy in dots:
        # One dot per pixel at most. A dot is a very short line with round ends, because a marker takes more bytes.
        pixels = np.unique(np.round(axes.transData.transform(xy)), axis=0)
        ends = np.stack([pixels, pixels + np.array((0.01, 0))], axis=1)
        path = Path(ends.reshape(-1, 2), np.tile([Path.MOVETO, Path.LINETO], len(pixels)))
        patch = PathPatch(path, transform=IdentityTransform(), facecolor="none", edgecolor=_COLORS[color], alpha=0.65)
        patch.set(linewidth=7 if count <= 200 else 5 if count <= 2000 else 3, capstyle="round", zorder=3)
        axes.add_artist(patch)
    return _svg(figure)


def _decades(values: list[FloatArray], least: float = 1e-300) -> tuple[int, int]:
    """Return exponents of powers of ten that enclose all values, after raising them to at least ``least``."""
    every = np.maximum(np.concatenate(values), least)
    if not every.size:
        return 0, 1
    low, high = int(np.floor(np.log10(every.min()))), int(np.ceil(np.log10(every.max())))
    return low, max(high, low + 1)


def _chart(x_label: str, y_label: str) -> tuple[Figure, Axes]:
    """Return an empty chart."""
    from quasiharmonic.ui.plot.canvas import new_figure

    figure = new_figure((_SIZES.width / 72, _SIZES.height / 72))
    figure.set_dpi(72)
    figure.patch.set_visible(False)
    axes = figure.add_axes((0.1, 0.13, 0.87, 0.83), facecolor="none", axisbelow=True)
    axes.set_xlabel(x_label, color=_QUIET, size=_SIZES.font)
    axes.set_ylabel(y_label, color=_QUIET, size=_SIZES.font)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_QUIET)
    axes.tick_params(length=0, pad=6, labelcolor=_QUIET, labelsize=_SIZES.font)
    axes.grid(color=_COLORS["line"])
    return figure, axes


def _use_decades(axes: Axes, name: str, low: int, high: int) -> None:
    """Make the axis "x" or "y" logarithmic, from 10^low to 10^high with at most nine ticks."""
    from matplotlib.ticker import NullLocator

    ticks = range(low, high + 1, -(-(high - low) // 8))
    axes.set(**{f"{name}scale": "log", f"{name}lim": (10.0**low, 10.0**high)})
    axes.set(**{f"{name}ticks": [10.0**k for k in ticks], f"{name}ticklabels": [power(k) for k in ticks]})
    (axes.xaxis if name == "x" else axes.yaxis).set_minor_locator(NullLocator())


def _svg(figure: Figure) -> str:
    """Return a figure as an SVG element that refers to nothing, with the style sheet's colours."""
    from matplotlib import rc_context

    for artist in figure.findobj():
        artist.set_clip_on(False)
    file = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "quasiharmonic", "path.simplify": False}):
        figure.savefig(file, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    drawing = re.sub(r' id="[^"]*"', "", file.getvalue().partition("</defs>")[2])
    text = f'<svg viewBox="0 0 {_SIZES.width} {_SIZES.height}" role="img">{drawing}'
    for name, color in _COLORS.items():
        text = text.replace(color, f"var(--{name})")
    return text


def thumbnail(record: Record, results: Path | None) -> str:
    """Draw the surface of a record and, if it exists, its map: a ``data:`` address of a PNG, empty if nothing can be
    drawn.
    """
    if (record.get("triangles") or 0) > _SIZES.max_triangles:
        return ""
    mesh, mapped = _read(record, results)
    if mesh is None or not len(mesh.F) or len(mesh.F) > _SIZES.max_triangles:
        return ""
    from quasiharmonic.ui.plot import plot_map, plot_surface
    from quasiharmonic.ui.plot.canvas import new_figure, panels, png_bytes

    figure = new_figure((3.2, 1.6) if mapped else (1.6, 1.6))
    axes = panels(figure, 2 if mapped else 1)
    for ax in axes:
        ax.set_position((ax.get_position().x0, 0.03, ax.get_position().width, 0.94))
    V = _center(mesh.V)
    plot_surface(V, mesh.F, axes[0])
    if mapped:
        opened, F, uv = io.without_idle(*io.cut_at_seams(mesh))
        plot_map(_center(opened), F, _center(uv), ax=axes[1])
    return "data:image/png;base64," + b64encode(png_bytes(figure)).decode()


def _read(record: Record, results: Path | None) -> tuple[MeshData | None, bool]:
    """Return the mesh to draw, and whether it has a map."""
    found = None if results is None else find_map(results, record["problem"])
    if found is not None:
        data, form = found
        with TemporaryDirectory() as place:
            path = records.map_path(Path(place), form)
            path.write_bytes(data)
            return io.read_mesh(path), True
    folder = None if results is None else results / record["problem"]
    candidates = [] if folder is None else [(records.map_path(folder, form), True) for form in MAP_FORMATS]
    if record.get("source"):
        candidates.append((Path(record["source"]), False))
    for path, mapped in candidates:
        try:
            if path.is_file():
                return io.read_mesh(path), mapped
        except (ValueError, OSError):
            continue
    return None, False


def _center(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points translated and scaled by powers of two into a box around the origin, which prevents overflow."""
    points = scale_to_unit(points)
    points = points - points.mean(axis=0)
    return np.ldexp(points, -int(np.frexp(np.abs(points).max() or 1.0)[1]))
