"""The record of a call while it runs: history, stages, recorded maps, clock, and how it ends.

A descent is an iterator: it changes its map and yields a status, or None, after every step. `Run.descend` takes the
steps and records each. Outside the command and the page, Ctrl-C is caught only here: code that keeps the work so far
runs in `Run.until_interrupted`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, TypeVar

from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.problem.result import MapResult, Snapshot, Stage, Status, Step
from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat, time_limit

T = TypeVar("T")


class Run:
    """Record of the steps and stages of a call.

    Parameters
    ----------
    callback : callable, optional
        Called with every `Step`. It may raise `KeyboardInterrupt`, which ends the run as Ctrl-C does.
    record_every : int
        Keep the map of every ``record_every``-th step; none if 0.
    first : int
        Number of the first step.

    Attributes
    ----------
    history : list of Step
    path : list of Snapshot
    stages : list of Stage
    interrupted : bool
        Whether Ctrl-C, the callback or a time limit ended a block of `until_interrupted`.
    """

    def __init__(
        self, callback: Callable[[Step], object] | None = None, record_every: int = 0, *, first: int = 0
    ) -> None:
        self._callback, self._record_every, self._first = callback, record_every, first
        self._began = self._stage_began = time.perf_counter()
        self.history: list[Step] = []
        self.path: list[Snapshot] = []
        self.stages: list[Stage] = []
        self.interrupted = False

    @property
    def seconds(self) -> float:
        """Wall time since the run began."""
        return time.perf_counter() - self._began

    @contextmanager
    def until_interrupted(self) -> Iterator[None]:
        """Run a block until it ends or is interrupted; the caller continues after it in both cases."""
        try:
            yield
        except KeyboardInterrupt:
            self.interrupted = True

    def record(self, inverted: int, energy: float, uv: Callable[[], FloatArray] | None = None) -> None:
        """Record a step; ``uv`` returns its map (n, 2), for ``path``. Raise KeyboardInterrupt after a time limit."""
        step = Step(self._first + len(self.history), inverted, energy)
        self.history.append(step)
        if uv is not None and self._record_every and step.iteration % self._record_every == 0:
            self.path.append(Snapshot(step.iteration, uv()))
        if self._callback is not None:
            self._callback(step)
        heartbeat()

    def add_stage(
        self,
        name: str,
        *,
        n_iterations: int = 0,
        inverted: tuple[int, int] = (0, 0),
        energy: tuple[float, float],
        kept: bool = True,
    ) -> None:
        """Add a stage that has just ended; it began when the stage before it ended."""
        now = time.perf_counter()
        self.stages.append(Stage(name, n_iterations, now - self._stage_began, inverted, energy, kept))
        self._stage_began = now

    def descend(
        self,
        name: str,
        steps: Iterable[Status | None],
        energy: Callable[[], float],
        uv: Callable[[], FloatArray] | None = None,
    ) -> Status:
        """Take the steps of a descent among injective maps as one stage, and record the start and every step.

        ``energy`` and ``uv`` return those of the current map. Return the status of the last step, ``STILL_FALLING`` if
        it had none. The stage is added even if the steps raise an exception.
        """
        done, first, status = len(self.history), energy(), Status.STILL_FALLING
        last = first
        try:
            self.record(0, first, uv)
            for outcome in steps:
                status, last = outcome or status, energy()
                self.record(0, last, uv)
        finally:
            # Compute nothing here: an exception would hide that of the steps.
            taken = max(len(self.history) - done - 1, 0)
            self.add_stage(name, n_iterations=taken, energy=(first, last))
        return status

    def judge_last_stage(self, kept: bool) -> None:
        """Replace whether the result of the last stage was kept; there is none if the call ended before it."""
        if self.stages:
            self.stages[-1] = replace(self.stages[-1], kept=kept)

    def result(
        self, uv: FloatArray, F: IntArray, status: Status, *, loops: list[IntArray] | None = None, **further: Any
    ) -> MapResult:
        """Certify a map and return it as the result; ``further`` are other fields of `MapResult`.

        If that is interrupted, the status is ``INTERRUPTED``.
        """
        certificate, interrupted = finish(lambda: certify(F, uv, loops=loops))
        self.interrupted |= interrupted
        return MapResult(
            uv=uv,
            status=Status.INTERRUPTED if interrupted else status,
            certificate=certificate,
            stages=[*self.stages],
            history=[*self.history],
            path=[*self.path],
            seconds=self.seconds,
            **further,
        )


def finish(compute: Callable[[], T]) -> tuple[T, bool]:
    """Run a computation that every result needs; return its value, and whether an interrupt made it run again.

    A second interrupt propagates.
    """
    with suppress(KeyboardInterrupt):
        return compute(), False
    return compute(), True


def run_until(seconds: float | None, compute: Callable[[], T]) -> T | None:
    """Return the result of a computation, or None if the time limit or `end_work` ends it.

    Other interrupts propagate.
    """
    with time_limit(math.inf if seconds is None else seconds) as limit:
        with Run().until_interrupted():
            return compute()
        if not limit.reached:
            raise KeyboardInterrupt
    return None


def finish_result(compute: Callable[[], MapResult]) -> MapResult:
    """Return the result of a `finish`, ``INTERRUPTED`` if an interrupt has repeated it."""
    result, interrupted = finish(compute)
    return replace(result, status=Status.INTERRUPTED) if interrupted else result


def run_within(seconds: float | None, compute: Callable[[], MapResult]) -> MapResult:
    """Return the result of a computation that ends after a time limit, if there is one, with the best map so far.

    Its status is then ``TIME_LIMIT``. Raise TimeoutError if there is no map yet.
    """
    if seconds is None:
        return compute()
    with time_limit(seconds) as limit:
        result = None
        with Run().until_interrupted():
            result = compute()
    if result is None:
        if limit.reached:
            raise TimeoutError(f"no map was computed within the time limit of {seconds:g} s: allow more time")
        raise KeyboardInterrupt
    interrupted = limit.reached and result.status is Status.INTERRUPTED
    return replace(result, status=Status.TIME_LIMIT) if interrupted else result
