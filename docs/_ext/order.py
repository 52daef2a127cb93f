"""The order of the gallery: the paper's figures, its tables, then what else one does with maps."""

from __future__ import annotations

from sphinx_gallery.sorting import FunctionSortKey

KINDS = ("figure_", "table_")


def _place(name: str) -> tuple[int, str]:
    return next((k for k, kind in enumerate(KINDS) if name.startswith(kind)), len(KINDS)), name


by_kind = FunctionSortKey(_place)
