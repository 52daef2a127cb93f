"""Derivatives of maps by their target positions, tensors and surface, in forward and reverse mode.

The package builds on `energies` and `problem`. Start reading in `derivative`, then `polish_gradient`.
"""

from __future__ import annotations

from quasiharmonic.apps.gradients.derivative import Derivative, Doubt, Gradients
from quasiharmonic.apps.gradients.flatten_gradient import flatten_derivative
from quasiharmonic.apps.gradients.polish_gradient import polish_derivative
from quasiharmonic.apps.gradients.tensors import quasi_harmonic_derivative

__all__ = [
    "Derivative",
    "Doubt",
    "Gradients",
    "flatten_derivative",
    "polish_derivative",
    "quasi_harmonic_derivative",
]
