"""Displacement fields on pixel grids: folds, the nearest field without folds, and inverses.

The package builds on `energies` and `geometry.exact`. Start reading in `grid`, then `nearest`.
"""
