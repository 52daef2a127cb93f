"""Flat maps with fixed vertices: contradictory target positions, and maps that satisfy the others.

The package builds on the flattening around it and on `problem.diagnosis`. Start reading in `pin_search`.
"""
