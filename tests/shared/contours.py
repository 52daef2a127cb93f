"""Contours for the tests of targets."""

from __future__ import annotations

import numpy as np


def steps(points):
    return np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
