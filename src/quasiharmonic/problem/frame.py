"""Coordinates of unit size around a target, in which problems are solved."""

from __future__ import annotations

import math

import numpy as np

from quasiharmonic.util.arrays import ComplexArray, FloatArray


class Frame:
    """Coordinates of unit size around the target, and the conversion back.

    The scale is a power of two, so scaling loses no digits. `Problem.positions` then sets the fixed vertices to their
    exact target positions.

    Parameters
    ----------
    target : (k, 2) float64
        Positions of the fixed vertices.
    """

    def __init__(self, target: FloatArray) -> None:
        # Halving first avoids overflow in the extent of coordinates near the largest double.
        low, high = target.min(axis=0) / 2, target.max(axis=0) / 2
        self.centre = low + high
        self._exponent = math.frexp((high - low).max())[1]

    def inward(self, uv: FloatArray) -> ComplexArray:
        """Return positions (n, 2) as complex numbers in the frame; (n,) complex128."""
        return np.ldexp(uv - self.centre, -self._exponent).view(np.complex128).ravel()

    def lengths(self, x: FloatArray) -> FloatArray:
        """Return lengths or displacements in the frame's unit, without translation; an array of the same shape."""
        return np.ldexp(x, -self._exponent)

    def outward(self, w: ComplexArray) -> FloatArray:
        """Return complex numbers of the frame (n,) as positions; (n, 2) float64."""
        return np.ldexp(w.view(np.float64).reshape(-1, 2), self._exponent) + self.centre
