"""Derivatives of maps: how a map moves as its target, its tensors or its surface do, and the transpose of that."""

from __future__ import annotations

from quasiharmonic.gradients.derivative import Derivative, Doubt, Gradients
from quasiharmonic.gradients.flattened import flatten_derivative
from quasiharmonic.gradients.polished import polish_derivative
from quasiharmonic.gradients.tensors import quasi_harmonic_derivative

__all__ = [
    "Derivative",
    "Doubt",
    "Gradients",
    "flatten_derivative",
    "polish_derivative",
    "quasi_harmonic_derivative",
]
