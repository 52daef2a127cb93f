"""From the plane back to the surface, and from one surface to another.

The package builds on `geometry.exact.point_location`. Start reading in `inverse`, then `transfer`.
"""
