"""Progress reports: regular calls of the caller's callback during long work.

A public function with a callback is decorated with `reports_progress` and calls the callback at every step. Code that
may run long between two steps calls `heartbeat` regularly. If no step was reported for `INTERVAL`, `heartbeat` reports
the last step again. After a time limit, `heartbeat` ends the work like Ctrl-C. A function without a callback calls
`report` at every step, which has an effect in a block of `report_to`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, NoReturn, ParamSpec, TypeVar, cast

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

# Seconds after which the last step is reported again; half of the documented interval.
INTERVAL = 0.25


@contextmanager
def use_value(variable: ContextVar[R], value: R) -> Iterator[None]:
    """Give a context variable another value in a block."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


class _Reporter:
    """A callback and the time of its last call."""

    def __init__(self, callback: Callable[[Any], object]) -> None:
        self._callback = callback
        self._errors = np.geterr()
        self._last: list[Any] = []
        self._time = 0.0

    def report(self, step: Any) -> None:
        """Call the callback."""
        # If the callback raises, do not call it again while the exception propagates.
        self._last = []
        try:
            # Work that the callback does itself must not report to this callback.
            with use_value(_REPORTER, None), np.errstate(**self._errors):
                self._callback(step)
            self._last = [step]
        finally:
            self._time = time.monotonic()

    def repeat_if_due(self) -> None:
        """Report the last step again if the last call was at least `INTERVAL` ago."""
        if self._last and time.monotonic() - self._time >= INTERVAL:
            self.report(self._last[0])


_REPORTER: ContextVar[_Reporter | None] = ContextVar("reporter", default=None)


def reports_progress(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function with a ``callback`` argument so that `heartbeat` repeats its last step during long work."""

    @wraps(function)
    def report_progress(*args: P.args, **kwargs: P.kwargs) -> R:
        callback = cast("Callable[[Any], object] | None", kwargs.get("callback"))
        if not callable(callback):
            return function(*args, **kwargs)
        reporter = _Reporter(callback)
        kwargs["callback"] = reporter.report
        with use_value(_REPORTER, reporter):
            return function(*args, **kwargs)

    return report_progress


@contextmanager
def report_to(callback: Callable[[Any], object] | None) -> Iterator[None]:
    """Pass the steps of `report` in a block to a callback, if there is one, and let `heartbeat` repeat the last one."""
    with use_value(_REPORTER, None if callback is None else _Reporter(callback)):
        yield


def report(step: Any) -> None:
    """Pass a step to the callback of the surrounding block of `report_to`, if there is one; then as `heartbeat`."""
    reporter = _REPORTER.get()
    if reporter is not None:
        reporter.report(step)
    heartbeat()


class TimeLimit:
    """A time limit of some work; ``reached`` tells whether it has ended the work."""

    def __init__(self, seconds: float, outer: TimeLimit | None) -> None:
        self._end, self._outer = time.monotonic() + seconds, outer
        self._raised = threading.local()
        self.reached = False

    def check(self, ahead: float = 0.0) -> None:
        """Raise KeyboardInterrupt, once in each thread, if this limit or an outer one is over so many seconds ahead."""
        limited = self._end < np.inf and not hasattr(self._raised, "once")
        if limited and time.monotonic() + ahead >= self._end:
            self.reached = self._raised.once = True
            raise KeyboardInterrupt
        if self._outer is not None:
            self._outer.check(ahead)

    def end(self) -> None:
        """End the limit now, in all threads."""
        self._end = -np.inf
        self.check()


_TIME_LIMIT: ContextVar[TimeLimit | None] = ContextVar("time limit", default=None)


@contextmanager
def time_limit(seconds: float) -> Iterator[TimeLimit]:
    """Let `heartbeat` raise KeyboardInterrupt, once, when the block has taken this many seconds."""
    limit = TimeLimit(seconds, _TIME_LIMIT.get())
    with use_value(_TIME_LIMIT, limit):
        yield limit


def end_work() -> NoReturn:
    """End the work as a time limit does, with the best result so far; for callbacks."""
    limit = _TIME_LIMIT.get()
    if limit is not None:
        limit.end()
    raise KeyboardInterrupt


def keep_time_limit(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function for another thread, in which `heartbeat` ends its work after the time limit of this thread."""
    limit = _TIME_LIMIT.get()

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        with use_value(_TIME_LIMIT, limit):
            return function(*args, **kwargs)

    return call


def heartbeat(ahead: float = 0.0) -> None:
    """Report that work continues; long loops call this at least every tenth of a second.

    Exceptions raised by the callback propagate to the caller. KeyboardInterrupt is raised after a time limit, and if
    the limit will be over before the next step ends, which takes about ``ahead`` seconds.
    """
    limit = _TIME_LIMIT.get()
    if limit is not None:
        limit.check(ahead)
    reporter = _REPORTER.get()
    if reporter is not None:
        reporter.repeat_if_due()
