"""Displacement fields on pixels and voxels: folds, the nearest field without folds, and inverses.

The package builds on `energies`, `geometry.exact` and `apps.tetrahedra`. Start reading in `grid`, then `nearest`.
"""
