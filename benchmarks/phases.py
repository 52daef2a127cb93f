"""Where the time of a call goes: functions of the library clocked from outside, each charged to a phase."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from quasiharmonic.geometry.mesh import reference
from quasiharmonic.linsolve import base, laplacian
from quasiharmonic.problem import domain
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.refine import mapping
from quasiharmonic.solver.search import coarse, solving, stages

# What is read: seconds of wall time, or of the processor.
clock = time.perf_counter

NAMES = (
    "set-up",
    "coarsening",
    "analysis",
    "assembly",
    "factor",
    "solve",
    "gradient",
    "optimiser",
    "polish",
    "prolongation",
    "certificate",
)

# What is not named here is charged to the named function that calls it.
_CLOCKED: tuple[tuple[Any, str, str], ...] = (
    (mapping, "injective_map", "set-up"),
    (mapping, "solve", "set-up"),
    (domain.Domain, "__init__", "set-up"),
    (reference.ReferenceMesh, "__init__", "set-up"),
    (laplacian.Laplacian, "__init__", "set-up"),
    (coarse, "coarsen", "coarsening"),
    (coarse, "prolong", "prolongation"),
    (stages, "polish_map", "polish"),
    (base.LinearSolver, "__init__", "analysis"),
    (Objective, "evaluate", "assembly"),
    (laplacian.Laplacian, "factor", "assembly"),
    (laplacian.FactoredLaplacian, "extend", "assembly"),
    (base.LinearSolver, "factor", "factor"),
    (base.LinearSolver, "solve", "solve"),
    (Iterate, "_sweep", "gradient"),
    (stages.Search, "run", "optimiser"),
    (solving, "certify", "certificate"),
    (stages, "triangle_signs", "certificate"),
)


class Phases:
    """Seconds by phase, and calls by phase, while it is `clocking`.

    A function's time is its own: what it calls and is clocked too is charged there and not twice.

    Parameters
    ----------
    clocked : sequence of (owner, name, phase)
        The functions; by default those of a map, whose phases are ``NAMES``.
    """

    def __init__(self, clocked: Sequence[tuple[Any, str, str]] = _CLOCKED) -> None:
        self._functions = clocked
        self.seconds: dict[str, float] = {phase: 0.0 for *_, phase in clocked}
        self.calls: dict[str, int] = defaultdict(int)
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def clocking(self) -> Iterator[Phases]:
        """Clock every call of the library's functions within the block."""
        saved = []
        try:
            for owner, name, phase in self._functions:
                function = vars(owner)[name]
                saved.append((owner, name, function))
                if isinstance(function, cached_property):
                    clocked: Any = cached_property(self._clocked(function.func, phase))
                    clocked.__set_name__(owner, name)
                else:
                    clocked = self._clocked(function, phase)
                setattr(owner, name, clocked)
            yield self
        finally:
            for owner, name, function in saved:
                setattr(owner, name, function)

    def _clocked(self, function: Callable[..., Any], phase: str) -> Callable[..., Any]:
        def clocked(*arguments: Any, **named: Any) -> Any:
            self._turn(phase)
            self.calls[phase] += 1
            try:
                return function(*arguments, **named)
            finally:
                self._turn(None)

        return clocked

    def _turn(self, phase: str | None) -> None:
        """Charge the time since the last turn to who was running; start a phase, or end the one that runs."""
        now = clock()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        if phase is None:
            self._running.pop()
        else:
            self._running.append(phase)
        self._since = clock()
