"""Figures of surfaces and maps: the public names of `quasiharmonic.ui.plot`."""

from quasiharmonic.ui import plot as _package
from quasiharmonic.ui.plot import *  # noqa: F403

__all__: list[str] = []
__all__ += _package.__all__
