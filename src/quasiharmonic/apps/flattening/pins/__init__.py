"""Flat maps with fixed vertices: impossible target positions, and initial maps that satisfy the others.

The package builds on the flattening around it and on `problem.diagnosis`. Start reading in `pins`.
"""
