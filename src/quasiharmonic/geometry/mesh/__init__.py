"""Mesh topology, reference triangles, rest shapes, operators, seams and refinement.

The package builds on `util`. Start reading in `topology`, then `surface` for the definition of a valid surface.
"""
