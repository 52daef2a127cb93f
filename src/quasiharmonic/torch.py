"""Maps as functions of PyTorch tensors: the public names of `quasiharmonic.apps.torch`."""

from quasiharmonic.apps import torch as _package
from quasiharmonic.apps.torch import *  # noqa: F403

__all__: list[str] = []
__all__ += _package.__all__
