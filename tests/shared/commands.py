"""The command, called as from a terminal, and the processes of a data set with troubles."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from quasiharmonic.ui.cli import main

# What `quasiharmonic.ui.batch.supervisor` starts in place of its `COMMAND`.
TROUBLED = [sys.executable, "-P", str(Path(__file__).with_name("troubled_worker.py"))]
linux = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="looks into /proc")


def run(*arguments):
    """Exit status of ``qhm``."""
    return main([str(a) for a in arguments])
