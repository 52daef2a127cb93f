"""VectorAdam (Ling et al. 2022): Adam whose step is normalised by each triangle's complex modulus (§9.4, §F.1).

The normalisation makes every triangle move at the same pace in ξ, however small its area, and makes
the path independent of the frames in which the triangles' ξ are expressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quasiharmonic.descent.base import FunctionalDescent, Iterates
from quasiharmonic.field.objective import Iterate, Objective
from quasiharmonic.mesh.reference import blocks

# Less momentum than Adam's usual 0.9 / 0.999 is the largest single gain: the landscape changes as fast as
# the map unfolds, and old gradients point to where the folds were.
MOMENTA = 0.6, 0.9
# Long steps unfold a map in few iterations, short ones get through where it is tight. Chosen on letters and
# on random pairs of surface and outline.
TANH_STEPS = ((0, 0.5), (10, 0.2), (39, 0.2), (40, 0.05))
# The longer way that si-log's ξ has to go to the same tensor wants longer steps.
SI_LOG_STEPS = ((0, 0.5),)


@dataclass(frozen=True, kw_only=True)
class VectorAdam(FunctionalDescent):
    """Descend by VectorAdam.

    Attributes
    ----------
    schedule : sequence of (int, float)
        Step lengths at given iterations, linear in between and constant after the last. Empty for those that suit the
        parameterisation.
    momenta : (float, float)
        Of the mean gradient and of its mean square, Adam's β₁ and β₂; at least 0 and below 1. The paper names none;
        Adam's own are 0.9 and 0.999. With those and the paper's steps it is
        ``VectorAdam(schedule=[(0, 0.1)], momenta=(0.9, 0.999))``.
    """

    schedule: Sequence[tuple[int, float]] = ()
    momenta: tuple[float, float] = MOMENTA

    word: ClassVar[str] = "vector-adam"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            times, lengths = np.array([*zip(*self._steps, strict=True)], dtype=np.float64)
        except (TypeError, ValueError):
            times, lengths = np.zeros(2), np.zeros(2)
        if not np.all(np.diff(times) > 0) or not np.all((times >= 0) & (lengths > 0) & np.isfinite(times + lengths)):
            raise ValueError(
                "schedule must be pairs (iteration, step length), iterations ascending and lengths positive, "
                f"not {self.schedule!r}"
            )
        try:
            momenta = np.array(self.momenta, dtype=np.float64)
        except (TypeError, ValueError):
            momenta = np.full(2, np.nan)
        if momenta.shape != (2,) or not np.all((momenta >= 0) & (momenta < 1)):
            raise ValueError(f"momenta must be two numbers of at least 0 and below 1, not {self.momenta!r}")

    @property
    def _steps(self) -> Sequence[tuple[int, float]]:
        return self.schedule or (TANH_STEPS if self.parameterisation == "tanh" else SI_LOG_STEPS)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """As of `Descent`; a step that leaves no positive definite Laplacian is shortened."""
        first, second = self.momenta
        times, lengths = zip(*self._steps, strict=True)
        mean = np.zeros_like(start.xi)
        square = np.zeros(start.xi.shape)
        here = start
        for k in range(1, self.iterations + 1):
            gradient, step = here.gradient, np.empty_like(mean)
            length = float(np.interp(k - 1, times, lengths)) * np.sqrt(1 - second**k) / (1 - first**k)
            for part in blocks(mean.size):
                g, average, squares = gradient[part], mean[part], square[part]
                average *= first
                average += (1 - first) * g
                squares *= second
                squares += (1 - second) * (g.real**2 + g.imag**2)
                root = np.sqrt(squares)
                # A triangle whose gradient has never differed from zero stays where it is.
                root[root == 0] = np.inf
                np.multiply(average, -length / root, out=step[part])
            here = objective.step(here, step)
            yield here
        return False
