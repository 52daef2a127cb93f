"""Topology of triangle meshes, reference triangles, rest shapes, operators, seams and refinement.

The package builds on `util`. Start reading in `topology`, then `surface` for what counts as a surface.
"""
