"""Plane curves by arc length, and which boundary vertices slide along them.

The package builds on `geometry.exact`. Start reading in `curve`, then `boundary_curves`; `deviation` bounds how far
edges of the boundary may be from their curve.
"""

from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.curves.curve import Curve

__all__ = ["Arc", "BoundaryCurves", "Curve"]
