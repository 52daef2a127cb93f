"""The view of ``qhm studio`` in a notebook cell: `MapWidget`. It needs the extra ``notebook``.

The package builds on `ui.studio`. Start reading in `widget`.
"""

from __future__ import annotations

# Same meaning as in `typing`, without the import.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from typing import Any

    from quasiharmonic.ui.notebook.widget import MapWidget

__all__ = ["MapWidget"]


def __getattr__(name: str) -> Any:
    if name != "MapWidget":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from quasiharmonic.ui.notebook.widget import MapWidget

    return MapWidget
