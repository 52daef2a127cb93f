"""The caller's callback, heard while work takes long that has no steps of its own to tell.

Whoever takes a callback is `reports_progress`, and calls it at every step. What may take long in between, wherever it
is, says now and then that it is `heartbeat`; if nothing has been told for a while, the last step is told once more.
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

# Seconds after which the last step is told again; half of what is promised.
INTERVAL = 0.25


class _Hearing:
    """A callback, and when it was called last."""

    def __init__(self, callback: Callable[[Any], object]) -> None:
        self._callback = callback
        self._errors = np.geterr()
        self._told: list[Any] = []
        self._when = 0.0

    def tell(self, step: Any) -> None:
        """Call the callback."""
        # Once it has raised, what is left to be done is done undisturbed.
        self._told = []
        # What it does takes part in nothing that is going on here.
        token = _HEARING.set(None)
        try:
            with np.errstate(**self._errors):
                self._callback(step)
            self._told = [step]
        finally:
            _HEARING.reset(token)
            self._when = time.monotonic()

    def remind(self) -> None:
        """Tell the last step again, if there is one and it is long ago."""
        if self._told and time.monotonic() - self._when >= INTERVAL:
            self.tell(self._told[0])


_HEARING: ContextVar[_Hearing | None] = ContextVar("hearing", default=None)


def reports_progress(function: Callable[P, R]) -> Callable[P, R]:
    """Have the argument ``callback`` of a function called with its last step again, whenever it has none for long."""

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
    """Say that work goes on, from wherever it may take long: a tenth of a second apart at most.

    Whatever the callback raises comes out of here.
    """
    one = _HEARING.get()
    if one is not None:
        one.remind()
