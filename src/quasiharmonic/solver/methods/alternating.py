"""The greedy alternation of §9.2: alternate between the best tensor for the map and the best map for the tensor.

It is equivalent to lowering the total unsigned area of Xu et al. (2011). Far from a solution it stalls at once (§7.1),
but it often untangles the last few tiny triangles.
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

    label: ClassVar[str] = "alternating"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`."""
        here = start
        for _ in range(self.iterations):
            best = objective.parameterisation.invert(own_tensor(here.dw.p, here.dw.q))
            here = objective.step(here, best - here.xi)
            yield here
        return False
