"""Boundary vertices that glide along the outline they are on, its corners held.

    curves ── positions, tangents and corners by arc length
      ▼
    rails ─── which vertex is on which curve, and where; their order along it
      ▼
    descent ─ Newton's steps in the free vertices' places and the sliding ones' arc lengths
"""

from quasiharmonic.sliding.curves import Arc, Curve
from quasiharmonic.sliding.rails import Rails

__all__ = ["Arc", "Curve", "Rails"]
