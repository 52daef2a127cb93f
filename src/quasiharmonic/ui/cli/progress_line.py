"""Show progress on one terminal line that is overwritten; silent if standard error is not a terminal."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quasiharmonic.problem.result import Step

_INTERVAL = 0.1


def describe_step(step: Step) -> str:
    """Return a sentence about a step of a search."""
    return f"iteration {step.iteration}   inverted {step.inverted}   energy/area {step.energy:.3g}"


def overwrite(text: str) -> None:
    """Write text over the terminal's current line, and blanks after it: old Windows consoles print escape codes."""
    width = max(shutil.get_terminal_size().columns - 1, 1)
    sys.stderr.write("\r" + text[:width].ljust(width) + ("" if text else "\r"))
    sys.stderr.flush()


@contextmanager
def line(words: Callable[[Any], str] = describe_step) -> Iterator[Callable[[Any], None] | None]:
    """Yield a callback that shows steps, or None if standard error is not a terminal."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    shown = 0.0

    def show(step: Any) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown < _INTERVAL:
            return
        shown = now
        overwrite(words(step))

    try:
        yield show
    finally:
        overwrite("")
