"""Handle Ctrl-C reliably, and SIGTERM and SIGHUP like Ctrl-C: schedulers and terminals end commands with them.

Python raises `KeyboardInterrupt` at any point of the main thread. In a finaliser Python reports it and drops it.
During the initialisation of an extension module it can turn into another exception.
"""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
# Seconds after which a lost interrupt is repeated.
_RETRY_SECONDS = 0.01


class Interrupts:
    """Context manager that records interrupts and repeats those that Python lost.

    It does nothing about a signal that has another handler or is ignored, and nothing outside the main thread.

    Attributes
    ----------
    happened : bool
        Whether an interrupt occurred.
    """

    def __init__(self) -> None:
        self.happened = False
        self._before: dict[int, Any] = {}
        self._last: int = signal.SIGINT

    def __enter__(self) -> Self:
        mine = threading.current_thread() is threading.main_thread()
        handlers = {number: signal.getsignal(number) for number in _SIGNALS} if mine else {}
        usual = signal.default_int_handler, signal.SIG_DFL
        self._before = {number: handler for number, handler in handlers.items() if handler in usual}
        if self._before:
            self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        for number in self._before:
            signal.signal(number, self._interrupt)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._before:
            sys.unraisablehook = self._hook

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self.happened, self._last = True, number
        raise KeyboardInterrupt

    def _unraisable(self, lost: UnraisableHookArgs) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            again = threading.Timer(_RETRY_SECONDS, _interrupt_main, [self._last])
            again.daemon = True
            again.start()
        else:
            self._hook(lost)


def _interrupt_main(number: int) -> None:
    """Interrupt the main thread by a signal, also while it waits."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:  # Windows, where `_thread.interrupt_main` does not wake a thread that sleeps
        signal.raise_signal(number)
