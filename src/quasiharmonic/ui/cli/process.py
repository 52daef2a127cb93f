"""The process of a command: standard output, standard error, and the signals that end it.

The streams can be closed by their readers. Progress is shown on one terminal line that is overwritten, or in a log.
SIGTERM and SIGHUP act like Ctrl-C, because schedulers and terminals end commands with them. Python raises
`KeyboardInterrupt` at any point of the main thread. In a finaliser Python reports it and drops it. During the
initialisation of an extension module it can turn into another exception.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

    from quasiharmonic.problem.result import Step

#: Exit status of a process that wrote to a pipe without a reader: 128 plus the number of SIGPIPE.
NO_READER = 141
#: Seconds between two lines of progress where standard error is not a terminal.
LOG = 10.0
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


def tell(text: str) -> None:
    """Print to standard error; errors of the stream are ignored."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(text, file=sys.stderr, flush=True)


def finish(status: int) -> int:
    """Flush standard output and standard error, so that Python's own flush at exit cannot fail.

    Return the exit status: the given one if it is not 0, `NO_READER` if standard output has no reader, 2 if it cannot
    be written, otherwise 0.
    """
    error = _flush(1)
    _flush(2)
    return status if error is None or status else output_failed(error)


def output_failed(error: OSError) -> int:
    """Report that standard output cannot be written, unless it has no reader; return the exit status."""
    if isinstance(error, BrokenPipeError):
        return NO_READER
    tell(f"qhm: standard output cannot be written: {error.strerror or error}")
    return 2


def require_output() -> None:
    """Raise a BrokenPipeError when standard output is closed, where `print` does nothing."""
    if sys.stdout is None:
        raise BrokenPipeError("standard output is closed")


def _flush(number: int) -> OSError | None:
    stream = sys.stdout if number == 1 else sys.stderr
    if stream is None:
        return None
    try:
        stream.flush()
    except OSError as error:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, number)
        os.close(null)
        return error
    return None


def describe_step(step: Step) -> str:
    """Return a sentence about a step of a search."""
    return f"iteration {step.iteration}   inverted {step.inverted}   energy/area {step.energy:.3g}"


def overwrite(text: str) -> None:
    """Write text over the terminal's current line, and blanks after it: old Windows consoles print escape codes."""
    width = max(shutil.get_terminal_size().columns - 1, 1)
    sys.stderr.write("\r" + text[:width].ljust(width) + ("" if text else "\r"))
    sys.stderr.flush()


@contextmanager
def progress_line(
    words: Callable[[Any], str] = describe_step, *, live: float = 0.1
) -> Iterator[Callable[[Any], None] | None]:
    """Yield a callback that shows steps every ``live`` seconds.

    If standard error is not a terminal, the callback prints a line every `LOG` seconds; if it is closed, it is None.
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    interval = live if terminal else LOG
    if sys.stderr is None:
        yield None
        return
    # The first step is shown at once on a terminal only.
    shown = time.monotonic() - (interval if terminal else 0.0)

    def show(step: Any) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown >= interval:
            shown = now
            (overwrite if terminal else tell)(words(step))

    try:
        yield show
    finally:
        if terminal:
            overwrite("")


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
            again = threading.Timer(0.01, _interrupt_main, [self._last])
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
