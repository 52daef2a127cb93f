from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def rng():
    """Random numbers, the same ones every time."""
    return np.random.default_rng(20231)
