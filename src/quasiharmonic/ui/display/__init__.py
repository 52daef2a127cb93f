"""HTML and figures of results, as notebooks display them.

`html` is in `page`, `draw` in `pictures`. The package builds on `ui.plot`. `quasiharmonic/__init__.py` registers it
with `util.display`, which imports it when a result is displayed. Start reading in `pictures`.
"""

from quasiharmonic.ui.display.markup import html
from quasiharmonic.ui.display.pictures import draw

__all__ = ["draw", "html"]
