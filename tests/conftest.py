from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def rng():
    """Random numbers, the same ones every time."""
    return np.random.default_rng(20231)


@pytest.fixture
def troubled(monkeypatch):
    """Problems of a data set are solved by a process to which what their names say happens."""
    from quasiharmonic.batch import supervisor
    from shared.commands import TROUBLED

    monkeypatch.setattr(supervisor, "COMMAND", TROUBLED)
    # Several that get nowhere are soon solved one by one.
    monkeypatch.setattr(supervisor, "TOGETHER", 1.0)
