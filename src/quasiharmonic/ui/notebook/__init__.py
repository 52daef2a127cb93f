"""The view of ``qhm studio`` in a notebook cell: `MapWidget`. It needs the extra ``notebook``.

The package builds on `ui.studio`. Start reading in `widget`.
"""

from __future__ import annotations

import lazy_loader  # type: ignore[import-untyped]

# Same meaning as in `typing`, without the import.
TYPE_CHECKING = False

if TYPE_CHECKING:
    from quasiharmonic.ui.notebook.widget import MapWidget as MapWidget

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submod_attrs={"widget": ["MapWidget"]})
