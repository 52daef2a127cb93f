"""Set up the problems of a file: its surface with seams, and the target of each island's boundary."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import io
from quasiharmonic.apps.atlas.mapped_atlas import name_island, orient_islands
from quasiharmonic.apps.atlas.seam_cuts import cut_apart
from quasiharmonic.energies.newton.sliding_boundary import move_onto
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.targets.boundary.boundary_to import FittedProblem, fit_boundary, fix_in_place
from quasiharmonic.targets.boundary.corner_pins import CornerSpec, read_corners
from quasiharmonic.targets.specification import find_sliding_curves


class BatchIsland(NamedTuple):
    """Problem of one island."""

    fitted: FittedProblem
    slide: bool | BoundaryCurves  # Whether its boundary slides, and along which curves


def make_surface(mesh: io.MeshData, settings: dict[str, Any]) -> SeamedMesh:
    """Return the surface of a file with the seams of its map, and with additional cuts if the settings contain them."""
    surface = io.seamed(mesh)
    if settings["cut"]:
        flat = settings["flatten"]
        return cut_apart(surface, polygons=mesh.polygons, disks_too=flat, reach=flat or settings["refine"])
    return surface


def make_problems(
    surface: SeamedMesh, fixed: NDArray[np.signedinteger] | None, settings: dict[str, Any]
) -> list[BatchIsland]:
    """Return the problem of every island, in order; ValueError if the input does not define one.

    ``fixed`` are the mesh's vertices that are fixed at their positions in the file's map; the boundaries if None.
    ``settings`` are as from `Settings.to_dict`.
    """
    to, reference = settings["to"], settings["reference"]
    islands = orient_islands(surface, reflect=to is None)
    if to is not None and settings["slide"] and len(islands) > 1:
        raise ValueError(f"a boundary can slide only if the mesh has one island, but it has {len(islands)}")
    corner_spec = None if settings["corners"] is None else read_corners(settings["corners"])
    found = []
    for k, (island, _) in enumerate(islands):
        with name_island(island, len(islands)):
            fitted = (
                fix_in_place(island, fixed, reference=reference)
                if to is None
                else _fit_island(island, k, corner_spec, settings)
            )
            slide: bool | BoundaryCurves = settings["slide"]
            if slide:
                slide = slide if to is None else _find_curves(to, fitted, settings)
                fitted = replace(fitted, problem=move_onto(slide, fitted.problem))
        found.append(BatchIsland(fitted, slide))
    return found


def _fit_island(island: Island, k: int, corner_spec: CornerSpec | None, settings: dict[str, Any]) -> FittedProblem:
    """Map an island's boundary to the outline; island ``k`` gets a copy of the outline shifted to the right."""
    to = settings["to"]
    # A file that has changed is read again.
    contours = _outline(to, settings["font"], os.stat(to).st_mtime_ns if os.path.isfile(to) else 0)
    corners = None if corner_spec is None else corner_spec.within(island.vertices)
    return fit_boundary(
        island.V,
        island.F,
        contours,
        corners=corners,
        corner_angle=settings["corner_angle"],
        reference=settings["reference"],
        beside=k,
    )


def _find_curves(to: str, fitted: FittedProblem, settings: dict[str, Any]) -> BoundaryCurves:
    """Return the curves of the outline, along which the boundary slides; corners of ``corners`` stay fixed."""
    return find_sliding_curves(
        to,
        font=settings["font"],
        corner_angle=settings["corner_angle"],
        fixed=fitted.corner_vertices,
        pieces=None if settings["pieces"] is None else Path(settings["pieces"]),
    )


@cache
def _outline(to: str, font: str | None, _changed: int) -> list[NDArray[np.float64]]:
    from quasiharmonic.targets import outline

    return outline(to, font=font)
