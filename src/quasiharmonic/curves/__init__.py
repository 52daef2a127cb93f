"""Curves by arc length, and the boundary vertices that glide along them, corners held.

`pieces` and `curve` have positions, directions and corners; `rails` which vertex is on which curve, and their order;
`straying` how far the boundary's edges may come to be from the curves. Newton's steps along them are in
`quasiharmonic.energy.sliding`.
"""

from quasiharmonic.curves.curve import Curve
from quasiharmonic.curves.pieces import Arc
from quasiharmonic.curves.rails import Rails

__all__ = ["Arc", "Curve", "Rails"]
