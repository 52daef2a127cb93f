"""Coarser meshes of a surface, and the way back to the fine one.

The package builds on `geometry.mesh`. Start reading in `levels`; `removal` removes vertices, `prolongation` puts them
back.
"""
