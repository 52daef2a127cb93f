"""What is tried, in which order: the strategy of §9.2 and §10.1, and the words to spell out another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from numbers import Integral
from typing import Any, Literal, get_args, get_type_hints

import numpy as np

from quasiharmonic.mesh.reference import Reference
from quasiharmonic.problem import Problem

# Long steps unfold a map in few iterations, short ones get through where it is tight. Chosen on letters and
# on random pairs of surface and outline.
TANH_STEPS = ((0, 0.5), (10, 0.2), (39, 0.2), (40, 0.05))
# The longer way that si-log's ξ has to go to the same tensor wants longer steps.
SI_LOG_STEPS = ((0, 0.5),)
# Vertices from which on a coarse mesh, made, solved and refined again, is quicker than ten iterations on the mesh.
_LARGE = 6000
# Tries at local repair: most succeed in the first few, and a failing one costs as much as many Newton steps.
_PATCHES, _FEW_SHAKES, _SHAKES = 30, 30, 60


@dataclass(frozen=True)
class Descent:
    """One stage of a search: an objective and a way to descend it.

    Attributes
    ----------
    optimizer : {"vector-adam", "l-bfgs", "newton", "alternating", "untangling", "patches", "shaking", "coarse-to-fine"}
        Newton and alternation descend V₃ whatever the functional (§9.2, §F.2). The three after them move vertices and
        not tensors: untangling all of them, patches those around the last inverted triangles, and shaking the same
        from random starts. Coarse-to-fine does all of that on a coarse mesh, if this one is large, and carries the
        map that it finds to this one.
    parameterization : {"tanh", "si-log"}
        How ξ becomes a tensor (§8.2): tanh is fast, si-log keeps angles.
    functional : {"dirichlet", "neumann", "sobolev", "poisson"}
        What is descended (§7.3).
    reference : {"equilateral", "rest", "corrected"}
        Shape of the triangles, unless the problem itself names one.
    iterations : int
        Steps to take at most; for patches, how many to try, and for shaking, how many to try in vain.
    schedule : sequence of (int, float)
        VectorAdam's step lengths at given iterations, linear in between and constant after the last. Empty
        for those that suit the parameterisation.
    resume : bool
        Start from the tensors of the lowest V₃ so far (patches and shaking: from the map with the fewest inverted
        triangles) instead of ξ = 0.

    Raises
    ------
    ValueError
        When a word is none of those above.
    """

    optimizer: Literal[
        "vector-adam", "l-bfgs", "newton", "alternating", "untangling", "patches", "shaking", "coarse-to-fine"
    ] = "vector-adam"
    parameterization: Literal["tanh", "si-log"] = "tanh"
    functional: Literal["dirichlet", "neumann", "sobolev", "poisson"] = "dirichlet"
    reference: Reference = "equilateral"
    iterations: int = 1000
    schedule: Sequence[tuple[int, float]] = ()
    resume: bool = False

    def __post_init__(self) -> None:
        for name, words in _words():
            given = getattr(self, name)
            if given not in words:
                raise ValueError(f"{name} must be one of {', '.join(words)}, not {given!r}")
        whole_number("iterations", self.iterations, least=1)
        try:
            times, lengths = np.array([*zip(*self.steps, strict=True)], dtype=np.float64)
        except (TypeError, ValueError):
            times, lengths = np.zeros(2), np.zeros(2)
        if not np.all(np.diff(times) > 0) or not np.all((times >= 0) & (lengths > 0) & np.isfinite(times + lengths)):
            raise ValueError(
                "schedule must be pairs (iteration, step length), iterations ascending and lengths positive, "
                f"not {self.schedule!r}"
            )

    @property
    def name(self) -> str:
        """How reports call it."""
        words: list[str] = [self.optimizer] if self.moves_vertices else [self.optimizer, self.parameterization]
        if self.optimizer in ("vector-adam", "l-bfgs"):
            words.append(self.functional)
        return ", ".join(words)

    @property
    def moves_vertices(self) -> bool:
        """Whether positions are what the optimiser moves, and tensors only follow."""
        return self.optimizer in ("untangling", "patches", "shaking")

    @property
    def patience(self) -> tuple[int, float]:
        """The stage has settled when within so many iterations none was righted and the energy fell by less.

        As a fraction of itself. Newton's steps are dear, and where they lead anywhere they do so at once. What
        moves vertices knows by itself when to end.
        """
        if self.moves_vertices:
            return self.iterations, 0.0
        return (40, 0.1) if self.optimizer == "newton" else (300, 1e-3)

    @property
    def steps(self) -> Sequence[tuple[int, float]]:
        """VectorAdam's step lengths."""
        return self.schedule or (TANH_STEPS if self.parameterization == "tanh" else SI_LOG_STEPS)


@cache
def _words() -> list[tuple[str, tuple[str, ...]]]:
    """The attributes of a `Descent` that are one of several words, and those words."""
    hints = [(name, get_args(hint)) for name, hint in get_type_hints(Descent).items()]
    return [(name, words) for name, words in hints if words and all(isinstance(word, str) for word in words)]


def whole_number(name: str, value: Any, *, least: int) -> None:
    """Raise a ValueError for what is not an integer of at least ``least``."""
    if not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, not {value!r}")


def speed(problem: Problem) -> list[Descent]:
    """The stages that find a map soonest, the first of which usually suffices.

    Boundaries alone want tanh, pins want si-log: the spike that a pinned point draws needs distortion that
    grows slowly towards it, and tanh never gets there. What is left then are a few triangles in tight places,
    which moving vertices rights sooner than moving tensors does; or else the map is far from any solution in
    parts, and Newton's method brings it nearer. All of this is tried on a coarse mesh first if the mesh is large,
    and soon if it is not.

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    list of Descent
        In the order in which they are run.
    """
    if problem.pins.size:
        first, newton = Descent(parameterization="si-log", iterations=400), Descent("newton", "si-log", iterations=60)
    else:
        first, newton = Descent(iterations=100), Descent("newton", iterations=300)
    coarse = replace(first, optimizer="coarse-to-fine")
    patches = Descent("patches", iterations=_PATCHES, resume=True)
    return [
        *([coarse, first, patches] if problem.n >= _LARGE else [first, patches, coarse]),
        Descent("untangling", iterations=300, resume=True),
        Descent("shaking", iterations=_FEW_SHAKES, resume=True),
        replace(newton, resume=True),
        Descent("untangling", iterations=600, resume=True),
        Descent("shaking", iterations=_FEW_SHAKES),
        Descent("shaking", iterations=_SHAKES, resume=True),
    ]


def quality(problem: Problem) -> list[Descent]:
    """The stages that keep angles: si-log on the rest mesh's own triangles, then whatever finds a map (§10.1).

    Parameters
    ----------
    problem : Problem

    Returns
    -------
    list of Descent
    """
    return [
        Descent(parameterization="si-log", reference="corrected", iterations=1000),
        Descent("newton", "si-log", reference="corrected", iterations=60, resume=True),
        *speed(problem),
    ]


STRATEGIES = {"speed": speed, "quality": quality}


def stages_of(strategy: str | Sequence[Descent], problem: Problem) -> Sequence[Descent]:
    """The stages that a strategy's name, or the user's own list, stands for.

    Raises
    ------
    ValueError
        When there is no such strategy.
    """
    if isinstance(strategy, str):
        if strategy not in STRATEGIES:
            raise ValueError(f"strategy must be one of {', '.join(STRATEGIES)} or a list of Descent, not {strategy!r}")
        return STRATEGIES[strategy](problem)
    given = list(strategy) if isinstance(strategy, Sequence) else []
    stages = [stage for stage in given if isinstance(stage, Descent)]
    if not stages or len(stages) < len(given):
        raise ValueError(f"strategy must be one of {', '.join(STRATEGIES)} or a list of Descent, not {strategy!r}")
    return stages
