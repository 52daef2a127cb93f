"""Ways to descend, one a file; `base` says what each of them is."""

from __future__ import annotations

from .alternating import Alternating
from .base import Descent
from .lbfgs import LBFGS
from .newton import Newton
from .patches import Patches
from .random_restarts import RandomRestarts
from .untangling import Untangling
from .vector_adam import VectorAdam

__all__ = ["LBFGS", "Alternating", "Descent", "Newton", "Patches", "RandomRestarts", "Untangling", "VectorAdam"]
