"""Arguments for kernels, by name, to compare their NumPy and C implementations."""

from __future__ import annotations

from shared.kernel_arguments import cuts, maps, surfaces
from shared.kernel_arguments.registry import ARGUMENTS

__all__ = ["ARGUMENTS", "cuts", "maps", "surfaces"]
