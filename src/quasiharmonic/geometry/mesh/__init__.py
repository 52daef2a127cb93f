"""Mesh topology, reference triangles, rest shapes, operators, seams and refinement.

The package builds on `util`. Start reading in `topology`, which also defines a valid surface.
"""
