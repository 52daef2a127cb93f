"""How results show themselves where somebody looks at them: in a console by a line, in a notebook by a picture.

What is looked at and what draws it lie at the two ends of the house. A result knows the room `display`, which knows all
of them, by its name only and imports it when it is asked to show itself: this is the one arrow that points down.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


class Shown:
    """What says in a line what it is, sums itself up in a few, and shows itself in a notebook, with a picture."""

    def summary(self) -> str:
        """Say in a few lines what this is."""
        raise NotImplementedError

    def in_short(self) -> str:
        """The same in a few words."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.in_short()}>"

    def _repr_html_(self) -> str:
        page: str = import_module("quasiharmonic.display.page").page(self)
        return page

    def _drawn(self, kind: str, **options: Any) -> Any:
        """The matplotlib Figure of some kind of this."""
        return import_module("quasiharmonic.display.pictures").drawn(self, kind, **options)
