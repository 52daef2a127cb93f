from __future__ import annotations

import os

import pytest

# Workers of pytest-xdist have a core each. Read by libraries when they are loaded, so before NumPy is imported.
if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
        os.environ[name] = "1"

# From this many on a worker's memory, half a gigabyte, and its start are not worth its time.
MOST_WORKERS = 8


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """A worker for each core; none where files are named, most of which have ended before workers have started."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None  # the plugin's own way to set it
    if any(".py" in argument for argument in config.args):
        return 0
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(MOST_WORKERS, cores)


@pytest.fixture
def rng():
    """Random numbers, the same ones every time."""
    import numpy as np

    return np.random.default_rng(20231)


@pytest.fixture
def troubled(monkeypatch):
    """Problems of a data set are solved by a process to which what their names say happens."""
    from quasiharmonic.batch import supervisor
    from shared.commands import TROUBLED

    monkeypatch.setattr(supervisor, "COMMAND", TROUBLED)
    # Several that get nowhere are soon solved one by one.
    monkeypatch.setattr(supervisor, "TOGETHER", 1.0)
