"""Flat maps with fixed vertices: what they forbid, and starts that satisfy them.

The package builds on the flattening around it and on `problem.diagnosis`. Start reading in `pins`.
"""
