"""Arguments for kernels, by name, to compare their NumPy and C implementations."""

from __future__ import annotations

from shared.kernel_arguments import maps, surfaces
from shared.kernel_arguments.registry import ARGUMENTS

__all__ = ["ARGUMENTS", "maps", "surfaces"]
