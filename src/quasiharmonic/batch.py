"""Data sets of problems: the public names of `quasiharmonic.ui.batch`."""

from quasiharmonic.ui import batch as _package
from quasiharmonic.ui.batch import *  # noqa: F403

__all__: list[str] = []
__all__ += _package.__all__
