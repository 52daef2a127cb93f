"""Handle Ctrl-C reliably.

Python raises `KeyboardInterrupt` at any point of the main thread. In a finaliser Python reports it and drops it.
During the initialisation of an extension module it can turn into another exception.
"""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

# Seconds after which a lost interrupt is repeated.
_RETRY_SECONDS = 0.01


class Interrupts:
    """Context manager that records interrupts and repeats those that Python lost.

    It does nothing if another handler is installed, interrupts are ignored, or this is not the main thread.

    Attributes
    ----------
    happened : bool
        Whether an interrupt occurred.
    """

    def __init__(self) -> None:
        self.happened = False
        self._installed = False

    def __enter__(self) -> Self:
        mine = threading.current_thread() is threading.main_thread()
        if mine and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._installed = True
            self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
            signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._installed:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            sys.unraisablehook = self._hook

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self.happened = True
        raise KeyboardInterrupt

    def _unraisable(self, lost: UnraisableHookArgs) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            again = threading.Timer(_RETRY_SECONDS, _interrupt_main)
            again.daemon = True
            again.start()
        else:
            self._hook(lost)


def _interrupt_main() -> None:
    """Interrupt the main thread, also while it waits."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:  # Windows, where `_thread.interrupt_main` does not wake a thread that sleeps
        signal.raise_signal(signal.SIGINT)
