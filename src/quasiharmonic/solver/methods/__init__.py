"""Methods that lower a functional over tensor fields, or move vertices.

The package builds on `solver.field` and `energies`. Start reading in `base`, which defines a method, then
`vector_adam`.
"""

from __future__ import annotations

from quasiharmonic.solver.methods.base import Descent
from quasiharmonic.solver.methods.lbfgs import LBFGS
from quasiharmonic.solver.methods.line_shift import LineShift
from quasiharmonic.solver.methods.local_repair import LocalRepair, WideRepair
from quasiharmonic.solver.methods.newton import Alternating, Newton
from quasiharmonic.solver.methods.random_restarts import RandomRestarts
from quasiharmonic.solver.methods.untangling import Untangling
from quasiharmonic.solver.methods.vector_adam import Composite, VectorAdam

__all__ = [
    "LBFGS",
    "Alternating",
    "Composite",
    "Descent",
    "LineShift",
    "LocalRepair",
    "Newton",
    "RandomRestarts",
    "Untangling",
    "VectorAdam",
    "WideRepair",
]
