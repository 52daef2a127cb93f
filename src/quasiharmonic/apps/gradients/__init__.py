"""Derivatives of maps by their target positions, tensors and surface, in forward and reverse mode.

The package builds on `energies` and `problem`. Start reading in `derivative`, then `map_derivatives`.
"""

from __future__ import annotations

from quasiharmonic.apps.gradients.derivative import Derivative, Doubt, Gradients
from quasiharmonic.apps.gradients.map_derivatives import (
    flatten_derivative,
    polish_derivative,
    quasi_harmonic_derivative,
)

__all__ = ["Derivative", "Doubt", "Gradients", "flatten_derivative", "polish_derivative", "quasi_harmonic_derivative"]
