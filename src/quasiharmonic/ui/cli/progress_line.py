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


def _of_search(step: Step) -> str:
    return f"iteration {step.iteration}   inverted {step.inverted}   energy/area {step.energy:.3g}"


@contextmanager
def line(words: Callable[[Any], str] = _of_search) -> Iterator[Callable[[Any], None] | None]:
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
        sys.stderr.write("\r\x1b[K" + words(step)[: shutil.get_terminal_size().columns - 1])
        sys.stderr.flush()

    try:
        yield show
    finally:
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()
