"""Injective warps of images by landmarks.

The package builds on `solver`. Start reading in `warping`.
"""
