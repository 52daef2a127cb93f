"""The command called in process, and the worker command for data sets with failing problems."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from quasiharmonic.ui.cli import main

# Replaces `quasiharmonic.ui.batch.supervisor.COMMAND`.
FAILING_WORKER = [sys.executable, "-P", str(Path(__file__).with_name("failing_worker.py"))]
linux = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="looks into /proc")


def run(*arguments):
    """Call ``qhm`` and return its exit status."""
    return main([str(a) for a in arguments])
