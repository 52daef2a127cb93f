"""Show progress on one terminal line that is overwritten, or in a log."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from quasiharmonic.ui.cli.streams import tell

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
def line(
    words: Callable[[Any], str] = describe_step, *, live: float = _INTERVAL, log: float | None = None
) -> Iterator[Callable[[Any], None] | None]:
    """Yield a callback that shows steps every ``live`` seconds.

    If standard error is not a terminal, the callback prints a line every ``log`` seconds; without this it is None.
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    interval = live if terminal else log
    if sys.stderr is None or interval is None:
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
