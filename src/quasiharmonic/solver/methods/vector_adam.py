"""VectorAdam (Ling et al. 2022): Adam whose step is normalised by each triangle's complex modulus (§9.4, §F.1).

The normalisation makes every triangle move at the same pace in ξ, however small its area, and makes
the path independent of the frames in which the triangles' ξ are expressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quasiharmonic.geometry.mesh.reference import blocks
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import FunctionalDescent, Iterates
from quasiharmonic.solver.methods.relocation import RetrySchedule, placed
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray
from quasiharmonic.util.kernels import compiled

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
    placing : bool
        Try now and then to right the last inverted triangles at once, by moving their vertices
        (`quasiharmonic.solver.methods.relocation`); where that fails the descent goes on as if it had not been tried.
    """

    schedule: Sequence[tuple[int, float]] = ()
    momenta: tuple[float, float] = MOMENTA
    placing: bool = False

    word: ClassVar[str] = "vector-adam"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            times, lengths = np.array([*zip(*self._steps, strict=True)], dtype=np.float64)
        except (TypeError, ValueError):
            times, lengths = np.zeros(2), np.zeros(2)
        if not np.all(np.diff(times) > 0) or not np.all((times >= 0) & (lengths > 0) & np.isfinite(times + lengths)):
            raise ValueError(
                "schedule must be pairs (iteration, step length) with ascending iterations and positive lengths, "
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

    def pace(self, triangles: int) -> AdamState:
        """What the method remembers of so many triangles, to be asked for one step after another."""
        times, lengths = zip(*self._steps, strict=True)
        return AdamState(triangles, self.momenta, times, lengths)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """As of `Descent`; a step that leaves no positive definite Laplacian is shortened."""
        pace = self.pace(start.xi.size)
        problem, tries, here = objective.problem, RetrySchedule(), start
        for _ in range(self.iterations):
            if self.placing and tries.due(here.inverted):
                w = placed(problem.F, here.w, problem.fixed)
                if w is not None:
                    yield objective.of_map(w)
            here = objective.step(here, pace.step(here.gradient))
            yield here
        return False


class AdamState:
    """The mean gradient and the mean square of it, triangle by triangle, and the steps that follow from them.

    No triangle knows of another, so the triangles may be of one mesh or of many.

    Parameters
    ----------
    triangles : int
    momenta, times, lengths
        As `VectorAdam` has them.
    """

    def __init__(
        self, triangles: int, momenta: tuple[float, float], times: Sequence[int], lengths: Sequence[float]
    ) -> None:
        self._momenta, self._times, self._lengths = momenta, times, lengths
        self._mean = np.zeros(triangles, dtype=np.complex128)
        self._square = np.zeros(triangles)
        self._steps = 0

    def part(self, triangles: IntArray | slice) -> AdamState:
        """What is remembered of some of the triangles, for these to go on by themselves."""
        return self._with(self._mean[triangles], self._square[triangles])

    @staticmethod
    def joined(paces: Sequence[AdamState]) -> AdamState:
        """One for the triangles of several, one after another, which have made as many steps each."""
        return paces[0]._with(
            np.concatenate([pace._mean for pace in paces]), np.concatenate([pace._square for pace in paces])
        )

    def _with(self, mean: ComplexArray, square: FloatArray) -> AdamState:
        """Of the same method after as many steps."""
        other = AdamState(0, self._momenta, self._times, self._lengths)
        # What is taken from another one's is changed at every step.
        other._mean, other._square, other._steps = np.array(mean), np.array(square), self._steps
        return other

    def step(self, gradient: ComplexArray) -> ComplexArray:
        """The step in ξ that a gradient calls for, after those before it; (f,) complex128."""
        first, second = self._momenta
        length = float(np.interp(self._steps, self._times, self._lengths))
        self._steps += 1
        length *= np.sqrt(1 - second**self._steps) / (1 - first**self._steps)
        step = np.empty_like(self._mean)
        adam_step(gradient, first, second, length, self._mean, self._square, step)
        return step


@compiled
def adam_step(
    gradient: ComplexArray,
    first: float,
    second: float,
    length: float,
    mean: ComplexArray,
    square: FloatArray,
    step: ComplexArray,
) -> None:
    """Take a gradient into its mean and mean square, and fill in the step of this length."""
    for part in blocks(step.size):
        g, average, squares = gradient[part], mean[part], square[part]
        average *= first
        average += (1 - first) * g
        squares *= second
        squares += (1 - second) * (g.real**2 + g.imag**2)
        root = np.sqrt(squares)
        # A triangle whose gradient has never differed from zero stays where it is.
        root[root == 0] = np.inf
        np.multiply(average, -length / root, out=step[part])
