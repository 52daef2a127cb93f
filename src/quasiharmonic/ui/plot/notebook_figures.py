"""Figures and axes that notebooks display even without matplotlib's notebook integration."""

from __future__ import annotations

from io import BytesIO

from matplotlib.axes import Axes
from matplotlib.figure import Figure


class NotebookFigure(Figure):
    """Figure that a notebook displays as a PNG image."""

    def _repr_png_(self) -> bytes:
        file = BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()


class NotebookAxes(Axes):
    """Axes that a notebook displays as their figure."""

    def _repr_png_(self) -> bytes | None:
        return self.figure._repr_png_() if isinstance(self.figure, NotebookFigure) else None
