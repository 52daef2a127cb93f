"""Figures of a report as SVG with CSS colours: logarithmic histograms and scatter plots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import FloatArray

_WIDTH, _HEIGHT = 640, 400
# Margins for labels: left, top, right, bottom.
_LEFT, _TOP, _RIGHT, _BOTTOM = 62, 16, 16, 50
_BINS_A_DECADE = 6
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class _Axis:
    """A logarithmic axis from 10^low to 10^high, drawn from pixel ``begin`` to ``end``."""

    low: int
    high: int
    begin: float
    end: float

    def place(self, values: FloatArray) -> FloatArray:
        """Return the pixel positions of values; values beyond an end are clipped."""
        with np.errstate(divide="ignore"):
            share = (np.log10(values) - self.low) / (self.high - self.low)
        return self.begin + np.clip(share, 0, 1) * (self.end - self.begin)

    def ticks(self) -> list[tuple[float, str]]:
        """Return positions and labels of at most nine powers of ten."""
        step = -(-(self.high - self.low) // 8)
        exponents = range(self.low, self.high + 1, step)
        return [(float(self.place(np.array(10.0**k))), power(k)) for k in exponents]


def power(exponent: int) -> str:
    """Return a power of ten as text."""
    plain = {-3: "0.001", -2: "0.01", -1: "0.1", 0: "1", 1: "10", 2: "100", 3: "1000"}
    return plain.get(exponent, "10" + str(exponent).translate(_SUPERSCRIPTS))


def histogram(series: list[tuple[str, FloatArray]], label: str) -> str:
    """Return histograms over a logarithmic axis: the first series as bars, the others as lines.

    Parameters
    ----------
    series : list of (str, (n,) float)
        CSS class and values. Values that are not finite are omitted; values that are not positive count in the first
        bar.
    label : str
        Label of the value axis.

    Returns
    -------
    str
        An SVG element.
    """
    shown = [(css, values[np.isfinite(values)]) for css, values in series]
    x = _axis([values for _, values in shown], _LEFT, _WIDTH - _RIGHT, least=1e-6)
    edges = np.linspace(x.low, x.high, (x.high - x.low) * _BINS_A_DECADE + 1)
    counts = []
    for _, values in shown:
        places = np.log10(np.clip(values, 10.0**x.low, 10.0**x.high))
        counts.append(np.histogram(places, edges)[0] / max(values.size, 1))
    top = max(float(count.max()) for count in counts) or 1.0
    bottom, across = _HEIGHT - _BOTTOM, x.place(10.0**edges)
    parts = [_frame(x, [], label, "share of the maps")]
    for percent in _round_steps(top):
        y = bottom - percent / top * (bottom - _TOP)
        parts.append(_grid_line(y) + _text(_LEFT - 8, y + 4, f"{100 * percent:g} %", "end"))
    for k, ((css, _), count) in enumerate(zip(shown, counts, strict=True)):
        heights = bottom - count / top * (bottom - _TOP)
        if k == 0:
            bars = zip(across[:-1], across[1:], heights, strict=True)
            path = "".join(f"M{a + 0.5:.1f} {bottom}V{h:.1f}H{b - 0.5:.1f}V{bottom}z" for a, b, h in bars if h < bottom)
            parts.append(f'<path class="{css} fill" d="{path}"/>')
        else:
            steps = "".join(f"V{h:.1f}H{b:.1f}" for b, h in zip(across[1:], heights, strict=True))
            parts.append(f'<path class="{css} line" d="M{across[0]:.1f} {bottom}{steps}V{bottom}"/>')
    return _svg(parts)


def scatter(series: list[tuple[str, FloatArray, FloatArray]], x_label: str, y_label: str, *, same: bool = False) -> str:
    """Return a scatter plot over two logarithmic axes.

    Parameters
    ----------
    series : list of (str, (n,) float, (n,) float)
        CSS class and coordinates; pairs that are not positive and finite are omitted.
    x_label, y_label : str
    same : bool
        Give both axes the same range, and draw lines where y is 1, 10 and 100 times smaller than x.

    Returns
    -------
    str
        An SVG element; its size is bounded for any number of dots.
    """
    shown = []
    for css, x, y in series:
        good = np.isfinite(x) & np.isfinite(y) & (x > 0) & (y > 0)
        shown.append((css, x[good], y[good]))
    xs, ys = [x for _, x, _ in shown], [y for _, _, y in shown]
    x_axis = _axis(xs + ys if same else xs, _LEFT, _WIDTH - _RIGHT)
    y_axis = _axis(xs + ys if same else ys, _HEIGHT - _BOTTOM, _TOP)
    parts = [_frame(x_axis, y_axis.ticks(), x_label, y_label)]
    for times in (1, 10, 100) if same else ():
        ends = np.array([10.0 ** (x_axis.low + np.log10(times)), 10.0**x_axis.high])
        if ends[0] < ends[1]:
            (x0, x1), (y0, y1) = x_axis.place(ends), y_axis.place(ends / times)
            parts.append(f'<path class="guide" d="M{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}"/>')
            parts.append(_text(x1 - 4, y1 + 26 if times == 1 else y1 - 8, f"{times} ×", "end"))
    count = sum(len(x) for _, x, _ in shown)
    width = 7 if count <= 200 else 5 if count <= 2000 else 3
    for css, x, y in shown:
        # Draw one dot per pixel.
        pixels = np.unique(np.round(np.column_stack([x_axis.place(x), y_axis.place(y)])).astype(np.int64), axis=0)
        path = "".join(f"M{a} {b}h0" for a, b in pixels.tolist())
        parts.append(f'<path class="{css} dots" stroke-width="{width}" d="{path}"/>')
    return _svg(parts)


def _axis(values: list[FloatArray], begin: float, end: float, least: float = 1e-300) -> _Axis:
    """Return an axis of whole decades that contains all values, after raising them to at least ``least``."""
    every = np.concatenate([np.maximum(v, least) for v in values] or [np.empty(0)])
    if not every.size:
        return _Axis(0, 1, begin, end)
    low, high = int(np.floor(np.log10(every.min()))), int(np.ceil(np.log10(every.max())))
    return _Axis(low, max(high, low + 1), begin, end)


def _round_steps(top: float) -> list[float]:
    """Return multiples of a round step up to ``top``, three to six of them."""
    step = 10.0 ** np.floor(np.log10(top))
    step = next(s for s in (step / 5, step / 4, step / 2, step, 2 * step) if top / s < 6.5)
    return [step * k for k in range(1, int(top / step) + 1)]


def _frame(x: _Axis, y_ticks: list[tuple[float, str]], x_label: str, y_label: str) -> str:
    bottom = _HEIGHT - _BOTTOM
    parts = [f'<path class="axis" d="M{_LEFT} {_TOP}V{bottom}H{_WIDTH - _RIGHT}"/>']
    for place, label in x.ticks():
        parts.append(f'<path class="grid" d="M{place:.1f} {_TOP}V{bottom}"/>')
        parts.append(_text(place, bottom + 18, label, "middle"))
    for place, label in y_ticks:
        parts.append(_grid_line(place) + _text(_LEFT - 8, place + 4, label, "end"))
    parts.append(_text((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 10, x_label, "middle"))
    middle = (_TOP + bottom) / 2
    parts.append(f'<g transform="rotate(-90 14 {middle})">{_text(14, middle, y_label, "middle")}</g>')
    return "".join(parts)


def _grid_line(y: float) -> str:
    return f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    """Return an SVG text element; the text is not escaped."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>'


def _svg(parts: list[str]) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img">{"".join(parts)}</svg>'
