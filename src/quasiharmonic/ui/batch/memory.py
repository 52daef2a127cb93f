"""Peak memory of a worker process while it solves one problem, for the record of the problem."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

# Written to /proc/self/clear_refs, this number resets the peak resident memory (VmHWM) of the process; see proc(5).
_RESET_PEAK = "5"


def reset_peak() -> None:
    """Reset the peak memory of this process, where the system supports it (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text(_RESET_PEAK, encoding="utf-8")


def measure_peak() -> int | None:
    """Return the peak resident memory in bytes; None if the system does not report it.

    On Linux it is the peak since `reset_peak`, on other systems since the start of this process.
    """
    with suppress(OSError, IndexError):
        return 1024 * int(Path("/proc/self/status").read_text(encoding="utf-8").split("VmHWM:")[1].split()[0])
    try:
        import resource
    except ImportError:
        return _measure_peak_on_windows()
    max_rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return max_rss if sys.platform == "darwin" else 1024 * max_rss


def _measure_peak_on_windows() -> int | None:
    try:
        import psutil
    except ImportError:
        return None
    return getattr(psutil.Process().memory_info(), "peak_wset", None)
