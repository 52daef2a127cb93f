"""The command called in process, and the worker command for data sets with failing problems."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from quasiharmonic.ui.cli import main
from shared.datasets import write_problem

# Replaces `quasiharmonic.ui.batch.supervisor.COMMAND`.
FAILING_WORKER = [sys.executable, "-P", str(Path(__file__).with_name("failing_worker.py"))]
linux = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="looks into /proc")


def run(*arguments):
    """Call ``qhm`` and return its exit status."""
    return main([str(a) for a in arguments])


def write_input(folder, V, F, fixed, target, handles=True):
    """Write a problem as `input.obj` and, unless told otherwise, `handles.txt`; return the path of the mesh."""
    write_problem(folder, V, F, fixed, target)
    if not handles:
        (folder / "handles.txt").unlink()
    return folder / "input.obj"
