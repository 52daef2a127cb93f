"""Plane curves parametrised by arc length, and the boundary vertices that slide along them.

The package builds on `geometry.exact`. Start reading in `curve`, then `boundary_curves`; `deviation` bounds the
distance between boundary edges and their curve.
"""

from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.curves.curve import Curve

__all__ = ["Arc", "BoundaryCurves", "Curve"]
