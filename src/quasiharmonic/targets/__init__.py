"""Places to map a boundary to: outlines, and which boundary vertex goes where on them."""

from quasiharmonic.targets.asked_corners import nearest_on_boundary
from quasiharmonic.targets.boundary import boundary_to
from quasiharmonic.targets.chords import flattened_edges
from quasiharmonic.targets.contours import signed_area
from quasiharmonic.targets.correspondence import arc_length
from quasiharmonic.targets.curves import outline_curves
from quasiharmonic.targets.glyphs import letter
from quasiharmonic.targets.nesting import filled, nested
from quasiharmonic.targets.outlines import disk, ellipse, rectangle, regular_polygon, ring, star
from quasiharmonic.targets.polylines import read_polylines
from quasiharmonic.targets.specification import outline
from quasiharmonic.targets.svg import read_svg
from quasiharmonic.targets.turning import BoundaryLoop, boundary_corners, boundary_turning
from quasiharmonic.targets.words import word

__all__ = [
    "BoundaryLoop",
    "arc_length",
    "boundary_corners",
    "boundary_to",
    "boundary_turning",
    "disk",
    "ellipse",
    "filled",
    "flattened_edges",
    "letter",
    "nearest_on_boundary",
    "nested",
    "outline",
    "outline_curves",
    "read_polylines",
    "read_svg",
    "rectangle",
    "regular_polygon",
    "ring",
    "signed_area",
    "star",
    "word",
]
