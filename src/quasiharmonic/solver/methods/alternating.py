"""The greedy alternation of §9.2: the best tensor for the map, the best map for the tensor, and again.

This is the total unsigned area of Xu et al. (2011) in another dress. It gets stuck at once from afar (§7.1), and often
rights the last few tiny triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import own_tensor
from quasiharmonic.solver.methods.base import Iterates, TensorDescent


@dataclass(frozen=True, kw_only=True)
class Alternating(TensorDescent):
    """Descend V₃ by alternation; each half step lowers it."""

    word: ClassVar[str] = "alternating"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """As of `Descent`."""
        here = start
        for _ in range(self.iterations):
            best = objective.parameterisation.invert(own_tensor(here.dw.p, here.dw.q))
            here = objective.step(here, best - here.xi)
            yield here
        return False
