"""Displacement fields on grids of pixels: the nearest one without folds, and the inverse of one."""
