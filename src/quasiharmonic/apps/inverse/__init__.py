"""Inverses of maps, and maps from one surface to another through the plane.

The package builds on `geometry.exact.point_location`. Start reading in `inverse_map`, then `transfer`.
"""
