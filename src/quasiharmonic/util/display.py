"""Display of results: one line in a console, a picture in a notebook.

A result does not import the code that draws it. Instead the drawing package registers a function that imports it. This
function is called when a result is displayed for the first time.
"""

from __future__ import annotations

# Same effect as in `typing`, whose import would dominate the import time of this module.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    from matplotlib.figure import Figure

_loader: Callable[[], Any] | None = None


def register_renderer(loader: Callable[[], Any]) -> None:
    """Set the function that imports the drawing package.

    It returns an object with ``html(result) -> str`` and ``draw(result, kind, **options) -> Figure``.
    """
    global _loader
    _loader = loader


class Displayable:
    """Base class of results with a short text, a summary and a notebook picture."""

    def summary(self) -> str:
        """Describe the result in a few lines."""
        raise NotImplementedError

    def short_repr(self) -> str:
        """Describe the result in a few words."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.short_repr()}>"

    def _repr_html_(self) -> str:
        html: str = _renderer().html(self)
        return html

    def _draw(self, kind: str, **options: Any) -> Figure:
        """Draw one kind of figure of the result."""
        return _renderer().draw(self, kind, **options)


def _renderer() -> Any:
    """The drawing package, imported at the first call."""
    assert _loader is not None, "quasiharmonic/__init__.py registers it"
    return _loader()
