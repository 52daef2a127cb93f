"""Coarse meshes of a surface, and prolongation of maps to the fine mesh.

The package builds on `geometry.mesh`. Start reading in `levels`, which removes vertices; `prolongation` inserts
them again.
"""
