"""Write to standard output and standard error, also after their readers have closed them."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

#: Exit status of a process that wrote to a pipe without a reader: 128 plus the number of SIGPIPE.
NO_READER = 141


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
