"""Surfaces with known distances."""

from __future__ import annotations

import numpy as np

from quasiharmonic import surfaces


def rolled(V, radius):
    """Roll a planar mesh around the y axis; distances along it do not change."""
    angle = V[:, 0] / radius
    return np.stack([radius * np.sin(angle), V[:, 1], radius * np.cos(angle)], axis=1)


def spherical(V, radius):
    """Put a planar mesh on a sphere without changing distances from the origin."""
    r = np.hypot(V[:, 0], V[:, 1])
    flat = radius * np.sin(r / radius) / np.where(r > 0, r, 1)
    return np.stack([V[:, 0] * flat, V[:, 1] * flat, radius * np.cos(r / radius)], axis=1)


def turned(V, angle):
    c, s = np.cos(angle), np.sin(angle)
    return V @ np.array([[c, -s], [s, c]]).T


def make_dome():
    V, F = surfaces.disk(11)
    return spherical(V, 0.8), F
