"""HTML of a result for notebooks: an escaped summary and its picture."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING

from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.display.pictures import draw
from quasiharmonic.ui.plot.canvas import png_bytes
from quasiharmonic.util.display import Displayable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Maximum number of triangles drawn automatically; drawing half as many takes about one second.
MAX_TRIANGLES = 200_000
_COLORS = 128
_STYLE = "white-space: pre-wrap; margin: 0 0 0.5em; font-size: 90%"


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
        return f"<em>{count:,} triangles are drawn when asked for: .plot()</em>"
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
    return len(getattr(surface, "F", ()))
