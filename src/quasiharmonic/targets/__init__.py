"""Places to map a boundary to: outlines, and which boundary vertex goes where on them."""

from quasiharmonic.targets.correspondence import arc_length
from quasiharmonic.targets.outlines import (
    disk,
    ellipse,
    letter,
    rectangle,
    regular_polygon,
    signed_area,
    star,
)

__all__ = [
    "arc_length",
    "disk",
    "ellipse",
    "letter",
    "rectangle",
    "regular_polygon",
    "signed_area",
    "star",
]
