"""Maps as functions of JAX arrays: the public names of `quasiharmonic.apps.jax`."""

from quasiharmonic.apps import jax as _package
from quasiharmonic.apps.jax import *  # noqa: F403

__all__: list[str] = []
__all__ += _package.__all__
