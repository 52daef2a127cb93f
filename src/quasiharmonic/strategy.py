"""What is tried, in which order: the strategy of §9.2 and §10.1, and the words to spell out another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .mesh.reference import Reference
from .problem import Problem

# Long steps unfold a map in few iterations, short ones get through where it is tight. Chosen on letters and
# on random pairs of surface and outline.
TANH_STEPS = ((0, 0.5), (10, 0.2), (39, 0.2), (40, 0.05))
# The longer way that si-log's ξ has to go to the same tensor wants longer steps.
SI_LOG_STEPS = ((0, 0.5),)


@dataclass(frozen=True)
class Descent:
    """One stage of a search: an objective and a way to descend it.

    Attributes
    ----------
    parameterization : {"tanh", "si-log"}
        How ξ becomes a tensor (§8.2): tanh is fast, si-log keeps angles.
    functional : {"dirichlet", "neumann", "sobolev", "poisson"}
        What is descended (§7.3).
    reference : {"equilateral", "rest", "corrected"}
        Shape of the triangles, unless the problem itself names one.
    iterations : int
        Steps to take at most.
    schedule : sequence of (int, float)
        Step lengths at given iterations, linear in between and constant after the last.
    """

    parameterization: str = "tanh"
    functional: str = "dirichlet"
    reference: Reference = "equilateral"
    iterations: int = 1000
    schedule: Sequence[tuple[int, float]] = TANH_STEPS

    @property
    def name(self) -> str:
        """How reports call it."""
        return f"vector-adam, {self.functional}, {self.parameterization}"


def default_strategy(problem: Problem) -> list[Descent]:
    """The stages for a problem, the first of which usually suffices.

    Boundaries alone want tanh, pins want si-log: the spike that a pinned point draws needs distortion that
    grows slowly towards it, and tanh never gets there.
    """
    tanh = Descent("tanh", schedule=TANH_STEPS)
    si_log = Descent("si-log", schedule=SI_LOG_STEPS)
    return [si_log, tanh] if problem.pins.size else [tanh, si_log]
