"""The view of ``qhm studio`` in a notebook's cell: `MapWidget`, for which the extra ``notebook`` is needed."""

from __future__ import annotations

# As of `typing`.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from quasiharmonic.notebook.widget import MapWidget

__all__ = ["MapWidget"]


def __getattr__(name: str) -> Any:
    if name != "MapWidget":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from quasiharmonic.notebook.widget import MapWidget

    return MapWidget
