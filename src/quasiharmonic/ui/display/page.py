"""A result as a notebook shows it: what it is, in words that nothing can break out of, and its picture."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING

from quasiharmonic.energies.measures import Distortion
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.display.pictures import draw
from quasiharmonic.util.display import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Drawing takes a second for half as many triangles; more are drawn when somebody asks for it.
MOST_TRIANGLES = 200_000
_COLORS = 128
_STYLE = "white-space: pre-wrap; margin: 0 0 0.5em; font-size: 90%"


def html(shown: Displayable) -> str:
    """A few lines of HTML, with the picture in them; never raises for what cannot be drawn."""
    lines = [f"<strong>{escape(type(shown).__name__)}</strong>: {escape(shown.short_repr())}"]
    lines.append(f'<pre style="{_STYLE}">{escape(shown.summary())}</pre>')
    lines.append(_picture(shown))
    return f'<div class="quasiharmonic">{"".join(lines)}</div>'


def _picture(shown: Displayable) -> str:
    """The picture as an image in the page itself, or why there is none."""
    count = _triangles(shown)
    if count == 0:
        return ""
    if count > MOST_TRIANGLES:
        return f"<em>{count:,} triangles are drawn when asked for: .plot()</em>"
    try:
        data = b64encode(_png(draw(shown, "map"))).decode()
    except (ValueError, ImportError) as error:
        return f"<em>no picture: {escape(str(error))}</em>"
    words = escape(shown.short_repr(), quote=True)
    return f'<img alt="{words}" style="max-width: 100%" src="data:image/png;base64,{data}"/>'


def _png(figure: Figure) -> bytes:
    """A picture of few colours, a third of the size: a notebook keeps every one that it has shown."""
    from PIL import Image

    file = BytesIO()
    figure.savefig(file, format="png", dpi=80)
    Image.open(file).convert("RGB").quantize(_COLORS).save(small := BytesIO(), format="png", optimize=True)
    return small.getvalue()


def _triangles(shown: Displayable) -> int:
    """How many triangles there are to draw; none where the surface is not known."""
    match shown:
        case MapResult():
            return 0 if shown.V is None else len(shown.F)
        case Diagnosis():
            return 0 if shown.problem is None else len(shown.problem.F)
        case Certificate() | Distortion() | Problem():
            return len(shown.F)
    return 0
