"""Progress reports: regular calls of the caller's callback during long work.

A public function with a callback is decorated with `reports_progress` and calls the callback at every step. Code that
may run long between two steps calls `heartbeat` regularly. If no step was reported for `INTERVAL`, `heartbeat` reports
the last step again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

# Seconds after which the last step is reported again; half of the documented interval.
INTERVAL = 0.25


class _Hearing:
    """A callback and the time of its last call."""

    def __init__(self, callback: Callable[[Any], object]) -> None:
        self._callback = callback
        self._errors = np.geterr()
        self._told: list[Any] = []
        self._when = 0.0

    def tell(self, step: Any) -> None:
        """Call the callback."""
        # If the callback raises, do not call it again while the exception propagates.
        self._told = []
        # Work that the callback does itself must not report to this callback.
        token = _HEARING.set(None)
        try:
            with np.errstate(**self._errors):
                self._callback(step)
            self._told = [step]
        finally:
            _HEARING.reset(token)
            self._when = time.monotonic()

    def remind(self) -> None:
        """Report the last step again if the last call was at least `INTERVAL` ago."""
        if self._told and time.monotonic() - self._when >= INTERVAL:
            self.tell(self._told[0])


_HEARING: ContextVar[_Hearing | None] = ContextVar("hearing", default=None)


def reports_progress(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function with a ``callback`` argument so that `heartbeat` repeats its last step during long work."""

    @wraps(function)
    def hearing(*args: P.args, **kwargs: P.kwargs) -> R:
        callback = cast("Callable[[Any], object] | None", kwargs.get("callback"))
        if not callable(callback):
            return function(*args, **kwargs)
        one = _Hearing(callback)
        kwargs["callback"] = one.tell
        token = _HEARING.set(one)
        try:
            return function(*args, **kwargs)
        finally:
            _HEARING.reset(token)

    return hearing


def heartbeat() -> None:
    """Report that work continues; long loops call this at least every tenth of a second.

    Exceptions raised by the callback propagate to the caller.
    """
    one = _HEARING.get()
    if one is not None:
        one.remind()
