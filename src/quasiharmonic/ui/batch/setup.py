"""Set up the problems of a file: its surface with seams, and the target of each island's boundary."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import io
from quasiharmonic.apps.atlas.mapped import faced, naming
from quasiharmonic.apps.atlas.seaming import cut_apart
from quasiharmonic.apps.repair.fitting import Fitted, held_in_place, laid_along
from quasiharmonic.energies.newton.sliding import moved_onto
from quasiharmonic.geometry.curves import BoundaryCurves, Curve
from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh
from quasiharmonic.targets.boundary.corner_spec import AskedCorners, read_corners


class Posed(NamedTuple):
    """Problem of one island.

    Attributes
    ----------
    fitted : Fitted
    slide : bool or BoundaryCurves
        Whether its boundary slides, and along which curves.
    """

    fitted: Fitted
    slide: bool | BoundaryCurves


def surface_of(mesh: io.MeshData, settings: dict[str, Any]) -> SeamedMesh:
    """Return the surface of a file with the seams of its map, and with additional cuts if requested.

    Parameters
    ----------
    mesh : MeshData
    settings : dict
        As returned by `Settings.to_dict`.

    Raises
    ------
    ValueError, ModuleNotFoundError
        As for `quasiharmonic.io.seams` and `cut_apart`.
    """
    surface = io.seamed(mesh)
    if settings["cut"]:
        flat = settings["flatten"]
        return cut_apart(surface, polygons=mesh.polygons, disks_too=flat, reach=flat or settings["refine"])
    return surface


def posed(surface: SeamedMesh, fixed: NDArray[np.signedinteger] | None, settings: dict[str, Any]) -> list[Posed]:
    """Return the problem of every island, in order.

    Parameters
    ----------
    surface : SeamedMesh
    fixed : (k,) int or None
        The mesh's vertices that are fixed at their positions in the file's map; the boundaries if None.
    settings : dict
        As returned by `Settings.to_dict`.

    Raises
    ------
    ValueError
        If the input does not define a problem; the message names the cause.
    """
    to, reference = settings["to"], settings["reference"]
    islands = faced(surface, reflect=to is None)
    if to is not None and settings["slide"] and len(islands) > 1:
        raise ValueError(f"a boundary can slide only if the mesh has one island, but it has {len(islands)}")
    asked = None if settings["corners"] is None else read_corners(settings["corners"])
    found = []
    for k, (island, _) in enumerate(islands):
        with naming(island, len(islands)):
            fitted = (
                held_in_place(island, fixed, reference=reference) if to is None else _onto(island, k, asked, settings)
            )
            slide: bool | BoundaryCurves = settings["slide"]
            if slide:
                slide = slide if to is None else BoundaryCurves(_curves(to, _changed(to)), fixed=fitted.held)
                fitted = replace(fitted, problem=moved_onto(slide, fitted.problem))
        found.append(Posed(fitted, slide))
    return found


def _onto(island: Island, k: int, asked: AskedCorners | None, settings: dict[str, Any]) -> Fitted:
    """Map an island's boundary to the outline; island ``k`` gets a copy of the outline shifted to the right."""
    contours = _outline(settings["to"], _changed(settings["to"]))
    corners = None if asked is None else asked.within(island.vertices)
    return laid_along(island.V, island.F, contours, corners=corners, reference=settings["reference"], beside=k)


def _changed(to: str) -> int:
    """Return the modification time of an outline's file, so that changed files are read again."""
    return os.stat(to).st_mtime_ns if os.path.isfile(to) else 0


@cache
def _outline(to: str, _changed: int) -> list[NDArray[np.float64]]:
    from quasiharmonic.targets import outline

    return outline(to)


@cache
def _curves(to: str, _changed: int) -> list[Curve]:
    from quasiharmonic.targets import outline_curves

    return outline_curves(to)
