"""Target positions: outlines, the correspondence of boundary vertices to an outline, and where to cut a surface.

The package builds on `problem` and `geometry.curves`. Start reading in `outlines.shapes`, then `boundary.boundary_to`.
"""

from quasiharmonic.targets.boundary.boundary_to import boundary_to
from quasiharmonic.targets.boundary.corner_pins import nearest_on_boundary
from quasiharmonic.targets.boundary.correspondence import arc_length
from quasiharmonic.targets.boundary.placement import flattened_edges
from quasiharmonic.targets.boundary.turning import BoundaryLoop, boundary_corners, boundary_turning
from quasiharmonic.targets.outlines.contours import filled, nested, signed_area
from quasiharmonic.targets.outlines.letters import letter, word
from quasiharmonic.targets.outlines.shapes import disk, ellipse, read_polylines, rectangle, regular_polygon, ring, star
from quasiharmonic.targets.outlines.svg import read_svg
from quasiharmonic.targets.specification import outline, outline_curves

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
