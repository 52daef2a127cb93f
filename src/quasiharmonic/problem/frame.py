"""Coordinates of unit size around a target: what is solved in, and the way back."""

from __future__ import annotations

import math

import numpy as np

from quasiharmonic.util.arrays import ComplexArray, FloatArray


class Frame:
    """Coordinates of unit size around the target, and back.

    The scale is a power of two, so going there and back costs no digits; positions at the fixed
    vertices are put back as they were given, to the last bit.

    Parameters
    ----------
    target : (k, 2) float64
        Positions of the fixed vertices.
    """

    def __init__(self, target: FloatArray) -> None:
        # Halved first: the extent of numbers near the largest double must not overflow.
        low, high = target.min(axis=0) / 2, target.max(axis=0) / 2
        self.centre = low + high
        self._exponent = math.frexp((high - low).max())[1]

    def inward(self, uv: FloatArray) -> ComplexArray:
        """Positions (n, 2) as complex numbers in the frame; (n,) complex128."""
        return np.ldexp(uv - self.centre, -self._exponent).view(np.complex128).ravel()

    def lengths(self, x: FloatArray) -> FloatArray:
        """Lengths, or positions that stay about their own origin, in the frame's unit; an array of the same shape."""
        return np.ldexp(x, -self._exponent)

    def outward(self, w: ComplexArray) -> FloatArray:
        """Complex numbers of the frame (n,) as positions; (n, 2) float64."""
        return np.ldexp(w.view(np.float64).reshape(-1, 2), self._exponent) + self.centre
