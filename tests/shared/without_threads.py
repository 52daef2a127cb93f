"""Environment that simulates Pyodide, Python in a browser: no threads, no processes, only SciPy's own linear solver."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

# Every Python process with this on its path runs as in Pyodide. NumPy, SciPy and pytest are imported before the
# platform changes, because those installed here are not Pyodide's.
_SITE = """
import _thread, importlib.metadata, subprocess, sys, threading
sys.modules["qdldl"] = sys.modules["rslab"] = None
try:
    import pytest
except ImportError:
    pass
import numpy, scipy.linalg, scipy.optimize, scipy.sparse.csgraph, scipy.sparse.linalg, scipy.spatial, matplotlib

def refuse(*arguments, **named):
    raise RuntimeError("can't start new thread")

for name in ("start_new_thread", "start_joinable_thread", "start_new"):
    if hasattr(_thread, name):
        setattr(_thread, name, refuse)
threading._start_new_thread = threading._start_joinable_thread = refuse

class Popen(subprocess.Popen):
    def __init__(self, *arguments, **named):
        raise OSError(138, "Function not supported: emscripten does not support processes.")

subprocess.Popen = Popen
sys.platform = "emscripten"
"""

# Skips tests that start threads or processes themselves; where the library does, they fail. Page and batches need both.
_PLUGIN = """
import pytest

@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    try:
        return (yield)
    except (RuntimeError, OSError) as error:
        if "can't start new thread" not in str(error) and "does not support processes" not in str(error):
            raise
        path, trace = "", error.__traceback__
        while trace:
            path += trace.tb_frame.f_code.co_filename.replace("\\\\", "/") + "\\n"
            trace = trace.tb_next
        if "/quasiharmonic/" in path and not ("/ui/batch/" in path or "/ui/studio/" in path):
            raise
        pytest.skip(f"starts a thread or a process: {error}")
"""


def simulate(folder):
    """Write the simulation into a folder; return the environment of processes that run with it."""
    (folder / "sitecustomize.py").write_text(_SITE, encoding="utf-8")
    (folder / "skip_threads.py").write_text(_PLUGIN, encoding="utf-8")
    path = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(path), "QUASIHARMONIC_PURE": "1"}


if __name__ == "__main__":
    # By `.ci/pyodide`: run pytest with these arguments in the simulation.
    with tempfile.TemporaryDirectory() as folder:
        pytest = [sys.executable, "-m", "pytest", "-p", "skip_threads", "-n", "0", *sys.argv[1:]]
        sys.exit(subprocess.run(pytest, env=simulate(Path(folder)), check=False).returncode)
