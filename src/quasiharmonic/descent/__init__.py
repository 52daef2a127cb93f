"""Ways to descend, one a file; `base` says what each of them is."""

from __future__ import annotations

from quasiharmonic.descent.alternating import Alternating
from quasiharmonic.descent.base import Descent
from quasiharmonic.descent.combing import Combing
from quasiharmonic.descent.composite import Composite
from quasiharmonic.descent.lbfgs import LBFGS
from quasiharmonic.descent.newton import Newton
from quasiharmonic.descent.patches import Patches
from quasiharmonic.descent.random_restarts import RandomRestarts
from quasiharmonic.descent.untangling import Untangling
from quasiharmonic.descent.vector_adam import VectorAdam

__all__ = [
    "LBFGS",
    "Alternating",
    "Combing",
    "Composite",
    "Descent",
    "Newton",
    "Patches",
    "RandomRestarts",
    "Untangling",
    "VectorAdam",
]
