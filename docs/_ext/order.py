"""The order of a section of the gallery: figures, tables, then other scripts by name."""

from __future__ import annotations

from sphinx_gallery.sorting import FunctionSortKey

KINDS = ("figure_", "table_")


def _place(name: str) -> tuple[int, str]:
    return next((k for k, kind in enumerate(KINDS) if name.startswith(kind)), len(KINDS)), name


by_kind = FunctionSortKey(_place)
