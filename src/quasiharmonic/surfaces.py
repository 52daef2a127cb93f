"""Example surfaces: the public names of `quasiharmonic.geometry.surfaces`."""

from quasiharmonic.geometry import surfaces as _package
from quasiharmonic.geometry.surfaces import *  # noqa: F403

__all__: list[str] = []
__all__ += _package.__all__
