"""HTML and figures of results, as notebooks display them.

The HTML is an escaped summary and the figure, which depends on the result's type. `quasiharmonic/__init__.py` registers
this module with `util.outcome`, which imports it when a result is displayed.
"""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
from quasiharmonic.apps.tetrahedra.result import TetrahedraResult
from quasiharmonic.apps.unwrapping.result import UnwrapResult
from quasiharmonic.energies.measures import Distortion
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui import plot
from quasiharmonic.ui.plot.canvas import RED, caption, new_figure, png_bytes, verdict
from quasiharmonic.ui.plot.maps import map_figure
from quasiharmonic.ui.plot.measures import cut_tetrahedra, elements_figure, outline_elements
from quasiharmonic.util.arrays import map_array
from quasiharmonic.util.outcome import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KINDS = ("map", "distortion", "texture", "convergence")
# Maximum number of triangles drawn automatically; drawing half as many takes about one second.
MAX_TRIANGLES = 200_000
_COLORS = 128
_STYLE = "white-space: pre-wrap; margin: 0 0 0.5em; font-size: 90%"


def draw(shown: Displayable, kind: str, *, measure: str = "isometric") -> Figure:
    """Draw a result, a morphed mesh, a problem, a certificate, a diagnosis or a distortion measurement.

    ``kind`` is one of `KINDS`, for a `MapResult` only; ``measure`` is that of a distortion. ValueError if the kind is
    unknown, or the object lacks the data to draw.
    """
    match shown:
        case MapResult():
            return _result(shown, kind, measure)
        case MorphResult():
            qualities = shown.quality_before, shown.quality_after
            drawn = [outline_elements(shown.F, points) for points in (shown.points_before, shown.points)]
            return elements_figure(drawn, qualities, shown.inverted)
        case TetrahedraResult():
            qualities, worst = (shown.quality_before, shown.quality_after), int(shown.quality_after.argmin())
            drawn = [cut_tetrahedra(shown.T, points, worst) for points in (shown.points_before, shown.points)]
            return elements_figure(drawn, qualities, shown.inverted)
        case UnwrapResult():
            return plot.plot_unwrap(shown.V[shown.vmapping], shown.indices, shown.uvs)
        case Distortion():
            return plot.plot_distortion(shown.V, shown.F, shown.uv, measure)
        case Problem():
            return plot.plot_problem(shown.V, shown.F, shown.fixed, shown.target)
        case Certificate():
            return _certificate(shown)
        case Diagnosis():
            return _diagnosis(shown)
    raise TypeError(f"cannot draw a {type(shown).__name__}")


def _result(result: MapResult, kind: str, measure: str) -> Figure:
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, not {kind!r}")
    if kind == "convergence":
        return plot.plot_convergence(result)
    if result.V is None:
        raise ValueError("the result has no surface: use quasiharmonic.plot with V and F")
    if kind == "distortion":
        return plot.plot_distortion(result.V, result.F, result.uv, measure)
    if kind == "texture":
        return plot.plot_texture(result.V, result.F, result.uv)
    return map_figure(result.V, result.F, result.uv, inverted=_find_bad(result.certificate))


def _certificate(certificate: Certificate) -> Figure:
    figure = new_figure((4.5, 4.5))
    ax = figure.add_axes((0.01, 0.02, 0.98, 0.88))
    uv, bad = map_array("uv", certificate.uv), _find_bad(certificate)
    plot.plot_map(uv, certificate.F, uv, inverted=bad, ax=ax)
    for i, j, k, m in certificate.crossings.tolist():
        ax.plot(*uv[[i, j]].T, *uv[[k, m]].T, color=RED, linewidth=2.4, zorder=7)
    ax.plot(*uv[certificate.multiply_wound].T, "o", color=RED, markersize=5, zorder=7)
    if not bad.size and certificate.bijective is False:
        caption(ax, "map: not bijective", RED)
    else:
        verdict(ax, "map", len(bad))
    return figure


def _diagnosis(diagnosis: Diagnosis) -> Figure:
    problem = diagnosis.problem
    if problem is None:
        raise ValueError("the diagnosis has no problem to draw")
    # Obstructions of whole loops are not marked, because no part of a loop is the cause.
    vertices = np.unique(np.concatenate([np.empty(0, dtype=np.int64), *(o.vertices for o in diagnosis.obstructions)]))
    triangles = [problem.F[o.triangles][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2) for o in diagnosis.obstructions]
    edges = np.concatenate([np.empty((0, 2), dtype=np.int64), *(o.edges for o in diagnosis.obstructions), *triangles])
    return plot.plot_problem(problem.V, problem.F, problem.fixed, problem.target, vertices=vertices, edges=edges)


def _find_bad(certificate: Certificate) -> np.ndarray:
    """Return the triangles that are not positive."""
    return np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])


def html(shown: Displayable) -> str:
    """Return a few lines of HTML with the picture; errors of drawing become part of the text."""
    lines = [f"<strong>{escape(type(shown).__name__)}</strong>: {escape(shown.short_repr())}"]
    lines.append(f'<pre style="{_STYLE}">{escape(shown.summary())}</pre>')
    lines.append(_picture(shown))
    return f'<div class="quasiharmonic">{"".join(lines)}</div>'


def _picture(shown: Displayable) -> str:
    """Return the picture as an inline image, or the reason why there is none."""
    count = _triangles(shown)
    if count == 0:
        return ""
    if count > MAX_TRIANGLES:
        return f"<em>{count:,} triangles: call .plot() to draw them</em>"
    try:
        data = b64encode(_png(draw(shown, "map"))).decode()
    except (ValueError, ImportError) as error:
        return f"<em>no picture: {escape(str(error))}</em>"
    words = escape(shown.short_repr(), quote=True)
    return f'<img alt="{words}" style="max-width: 100%" src="data:image/png;base64,{data}"/>'


def _png(figure: Figure) -> bytes:
    """Return a PNG with few colours, a third of the size, because notebooks store every picture."""
    from PIL import Image

    Image.open(BytesIO(png_bytes(figure, dpi=80))).convert("RGB").quantize(_COLORS).save(
        small := BytesIO(), format="png", optimize=True
    )
    return small.getvalue()


def _triangles(shown: Displayable) -> int:
    """Return the number of triangles to draw; 0 if the surface is not known."""
    surface = shown.problem if isinstance(shown, Diagnosis) else shown
    if isinstance(surface, MapResult) and surface.V is None:
        return 0
    return len(surface.indices if isinstance(surface, UnwrapResult) else getattr(surface, "F", ()))
