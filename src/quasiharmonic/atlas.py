"""Maps with seams, island by island: the public names of `quasiharmonic.apps.atlas`."""

from quasiharmonic.apps import atlas as _package
from quasiharmonic.apps.atlas import *  # noqa: F403

__all__: list[str] = []
__all__ += _package.__all__
