"""Warps of images and of the plane by landmarks, without folds.

The package builds on `solver`. Start reading in `warping`.
"""
