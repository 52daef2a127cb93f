"""Time of a call by phase: functions of the library are timed from outside and each is assigned to a phase."""

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
from quasiharmonic.solver import mapping
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.search import coarse, record, search

# The available clocks: wall time or CPU time.
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

# Functions not listed here count toward the listed function that calls them.
_CLOCKED: tuple[tuple[Any, str, str], ...] = (
    (mapping, "injective_map", "set-up"),
    (mapping, "solve", "set-up"),
    (domain.Domain, "__init__", "set-up"),
    (reference.ReferenceMesh, "__init__", "set-up"),
    (laplacian.Laplacian, "__init__", "set-up"),
    (coarse, "coarsen", "coarsening"),
    (coarse, "prolong", "prolongation"),
    (search, "polish_map", "polish"),
    (base.LinearSolver, "__init__", "analysis"),
    (Objective, "evaluate", "assembly"),
    (laplacian.Laplacian, "factor", "assembly"),
    (laplacian.FactoredLaplacian, "extend", "assembly"),
    (base.LinearSolver, "factor", "factor"),
    (base.LinearSolver, "solve", "solve"),
    (Iterate, "_sweep", "gradient"),
    (search.Search, "run", "optimiser"),
    (search, "certify", "certificate"),
    (record, "triangle_signs", "certificate"),
)


class Phases:
    """Seconds and calls by phase, measured within `clocking`.

    The time of a function excludes that of the timed functions that it calls.

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
        """Time every call of the listed functions within the block."""
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
        """Add the time since the last change to the running phase; start a phase, or end the running one if None."""
        now = clock()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        if phase is None:
            self._running.pop()
        else:
            self._running.append(phase)
        self._since = clock()
