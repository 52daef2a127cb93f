"""Ctrl-C that is never lost.

Python raises `KeyboardInterrupt` wherever the main thread happens to be. In a finaliser it is reported and forgotten;
out of the initialisation of an extension module it comes as some other error.
"""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

# Seconds after which an interrupt that was lost comes again.
_AGAIN = 0.01


class Interrupts:
    """While this is entered, interrupts are noted, and come again where they were lost.

    Where somebody else minds them, or they are ignored, this does nothing.

    Attributes
    ----------
    happened : bool
        Whether there was one.
    """

    def __init__(self) -> None:
        self.happened = False
        self._minded = False

    def __enter__(self) -> Self:
        mine = threading.current_thread() is threading.main_thread()
        if mine and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._minded = True
            self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
            signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._minded:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            sys.unraisablehook = self._hook

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self.happened = True
        raise KeyboardInterrupt

    def _unraisable(self, lost: UnraisableHookArgs) -> None:
        if isinstance(lost.exc_value, KeyboardInterrupt):
            again = threading.Timer(_AGAIN, _interrupt_main)
            again.daemon = True
            again.start()
        else:
            self._hook(lost)


def _interrupt_main() -> None:
    """Interrupt the main thread, even if it waits for something, where the system knows how."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
