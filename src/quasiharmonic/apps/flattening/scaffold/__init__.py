"""Triangles that fill the plane around a map, so that its boundary cannot cross itself.

The package builds on `geometry.exact`. Start reading in `air_triangulation`.
"""
