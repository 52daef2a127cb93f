"""Time of a call by phase: functions of the library are timed from outside and each is assigned to a phase."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any

from quasiharmonic.geometry.mesh import reference
from quasiharmonic.linsolve import base, laplacian
from quasiharmonic.problem import domain
from quasiharmonic.solver import mapping
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.search import record, search

# The available clocks: wall time or CPU time.
clock = time.perf_counter

# Functions not listed here count toward the listed function that calls them.
_CLOCKED: tuple[tuple[Any, str, str], ...] = (
    (mapping, "injective_map", "set-up"),
    (mapping, "solve", "set-up"),
    (domain.Domain, "__init__", "set-up"),
    (reference.ReferenceMesh, "__init__", "set-up"),
    (laplacian.Laplacian, "__init__", "set-up"),
    (search, "coarsen", "coarsening"),
    (search, "prolong", "prolongation"),
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
NAMES = tuple(dict.fromkeys(phase for *_, phase in _CLOCKED))


class Phases:
    """Seconds by phase, measured within `clocking`; the time of a function excludes that of those that it calls."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(NAMES, 0.0)
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def clocking(self) -> Iterator[Phases]:
        """Time every call of the listed functions within the block."""
        saved = []
        try:
            for owner, name, phase in _CLOCKED:
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
