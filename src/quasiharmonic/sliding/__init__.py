"""Boundary vertices that glide along the outline they are on, its corners held.

`pieces` and `curves` have positions, directions and corners by arc length; `rails` which vertex is on which curve, and
their order; `straying` how far the boundary's edges may come to be from the curves; `descent` Newton's steps in the
free vertices' places and the sliding ones' lengths.
"""

from quasiharmonic.sliding.curves import Curve
from quasiharmonic.sliding.pieces import Arc
from quasiharmonic.sliding.rails import Rails

__all__ = ["Arc", "Curve", "Rails"]
