"""One line on the terminal that is written over while the solver works; silent when piped."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quasiharmonic.result import Step

_INTERVAL = 0.1


@contextmanager
def line() -> Iterator[Callable[[Step], None] | None]:
    """Give a callback that shows a solver's steps, or none where standard error is not a terminal."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    shown = 0.0

    def show(step: Step) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown < _INTERVAL and step.flipped:
            return
        shown = now
        text = f"iteration {step.iteration}   inverted {step.flipped}   energy/area {step.energy:.3g}"
        sys.stderr.write("\r\x1b[K" + text[: shutil.get_terminal_size().columns - 1])
        sys.stderr.flush()

    try:
        yield show
    finally:
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()
