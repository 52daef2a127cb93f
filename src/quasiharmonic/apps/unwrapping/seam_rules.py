"""Where seams are wanted on a cleaned mesh: costs, demanded seams, texture coordinates to keep, and symmetry."""

from __future__ import annotations

from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, KEPT_COST, UNDIVIDED_COST, Hinges, find_hinges
from quasiharmonic.apps.unwrapping.layout import find_differing_sides
from quasiharmonic.apps.unwrapping.symmetry import Mirror, Symmetry, find_mirror
from quasiharmonic.apps.unwrapping.wanted_seams import (
    WantedSeams,
    extend_seams,
    mark_edges,
    read_edges,
    read_wanted_seams,
)
from quasiharmonic.geometry.mesh.reference import area_vectors
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, number_array
from quasiharmonic.util.options import UnwrapOptions

# Smaller factors on the cost of seams count as this one.
_LEAST_COST = 1e-6
# Angles between normals, in radians, that differ by at most this value count as equal, as files round positions.
_SAME_ANGLE = 1e-4
# Factor on the cost of seams between two labels.
_COST_BETWEEN_LABELS = 1e-3
# Factor on the cost of seams on places that face down, below this slope, and in concave edges beyond this angle.
_COST_BELOW, _SLOPE = 0.9, -0.5
_COST_CONCAVE, _CONCAVE = 0.9, np.pi / 6


class Rules(NamedTuple):
    """Where seams are wanted on a cleaned mesh.

    Attributes
    ----------
    cost : (f, 3) float64
        Factor on the cost of a seam at each side; see `find_charts`.
    uv : (f, 3, 2) float64 or None
        Texture coordinates whose seams are kept.
    uv_cuts : (k, 2) int64 or None
        Their seams, and the demanded ones.
    mirror : Mirror or None
        Mirror images, if the model is symmetric.
    symmetry : Symmetry
    wanted : WantedSeams
    """

    cost: FloatArray
    uv: FloatArray | None
    uv_cuts: IntArray | None
    mirror: Mirror | None
    symmetry: Symmetry
    wanted: WantedSeams


def find_rules(
    points: FloatArray,
    cleaned: CleanedMesh,
    F: IntArray,
    costs: FloatArray | None,
    corner_uv: FloatArray | None,
    options: UnwrapOptions,
) -> Rules:
    """Return where seams are wanted.

    Parameters
    ----------
    points : (n', 3) float64
        Positions of the cleaned mesh.
    cleaned : CleanedMesh
    F : (f, 3) int64
        Triangles of the model.
    costs : (f, 3) float64 or None
        Costs of their sides.
    corner_uv : (f, 3, 2) float64 or None
        Texture coordinates of their corners.
    options : UnwrapOptions

    Raises
    ------
    ValueError
        If lists of edges or labels are wrong.
    """
    wanted = read_wanted_seams(options.seams, options.no_seams, F, cleaned.representatives)
    demanded, kept = mark_edges(cleaned, wanted.seams), mark_edges(cleaned, wanted.no_seams)
    labels = (
        None
        if options.labels is None
        else number_array("labels", options.labels, len(F), "triangle")[cleaned.triangles]
    )
    cost = np.ones(cleaned.F.shape) if costs is None else _turn_sides(costs, cleaned)
    cost = np.maximum(cost, _LEAST_COST)
    hinges = find_hinges(points, cleaned.F)
    if labels is not None:
        apart = labels[hinges.first] != labels[hinges.second]
        cost[hinges.mark_sides(apart, len(cleaned.F))] *= _COST_BETWEEN_LABELS
    mirror, symmetry = None, Symmetry(None, 0.0, False, "")
    uv = uv_cuts = None
    if corner_uv is not None:
        uv = _turn_corners(corner_uv, cleaned)
        uv_cuts = _find_uv_cuts(uv, cleaned)
    else:
        plain = costs is None and labels is None and wanted.empty
        if options.symmetry is not None and (plain or options.symmetry != "auto"):
            mirror, symmetry = find_mirror(points, cleaned.F, options.symmetry)
        if not options.divide_for_packing:
            cost[hinges.mark_sides(hinges.flat, len(cleaned.F))] *= UNDIVIDED_COST
        demanded |= _mark_hard_edges(options.hard_edges, hinges, cleaned, F) & ~kept
    if options.up is not None:
        _prefer_hidden(cost, points, cleaned.F, hinges, options.up, symmetry)
    if mirror is not None:
        demanded, kept = (_mirror_sides(sides, hinges, mirror, cleaned.F) for sides in (demanded, kept))
    cost[kept] = KEPT_COST
    if len(wanted.seams) or not isinstance(options.hard_edges, Real | None):
        demanded = extend_seams(points, cleaned.F, hinges, demanded, np.where(kept, np.inf, cost))
    cost[demanded] = DEMANDED_COST
    if uv_cuts is not None:
        sides = np.stack([cleaned.F[demanded], cleaned.F[:, (1, 2, 0)][demanded]], axis=1)
        uv_cuts = np.concatenate([uv_cuts, sides])
    return Rules(cost, uv, uv_cuts, mirror, symmetry, wanted)


def _prefer_hidden(
    cost: FloatArray, points: FloatArray, F: IntArray, hinges: Hinges, up: str, symmetry: Symmetry
) -> None:
    """Lower the costs (f, 3) of seams where the surface faces down, and in concave edges."""
    cost[hinges.mark_sides(hinges.angle < -_CONCAVE, len(F))] *= _COST_CONCAVE
    if symmetry.applied and symmetry.axis == up[-1]:
        # Seams below are mirrored to the upper side.
        return
    normal = area_vectors(points, F)
    length = np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)
    height = (-1 if up[0] == "-" else 1) * normal[:, "xyz".index(up[-1])] / length
    below = (height[hinges.first] + height[hinges.second]) / 2 < _SLOPE
    cost[hinges.mark_sides(below, len(F))] *= _COST_BELOW


def _mark_hard_edges(given: Any, hinges: Hinges, cleaned: CleanedMesh, F: IntArray) -> BoolArray:
    """Return a mask (f', 3) of the sides at hard edges, given by an angle in degrees or listed."""
    if given is None:
        return np.zeros(cleaned.F.shape, dtype=np.bool_)
    if isinstance(given, Real):
        return hinges.mark_sides(np.abs(hinges.angle) > np.deg2rad(float(given)) + _SAME_ANGLE, len(cleaned.F))
    return mark_edges(cleaned, read_edges("hard_edges", given, F, cleaned.representatives))


def _mirror_sides(sides: BoolArray, hinges: Hinges, mirror: Mirror, F: IntArray) -> BoolArray:
    """Return some sides (f, 3) of hinges and their mirror images."""
    chosen = hinges.touch(sides)
    return hinges.mark_sides(chosen | chosen[mirror.of_hinges(hinges, F)], len(F))


def _turn_sides(costs: FloatArray, cleaned: CleanedMesh) -> FloatArray:
    """Return the costs of the sides of the cleaned triangles."""
    turned = costs[cleaned.triangles]
    # Reversing a triangle exchanges its first and last side.
    turned[cleaned.flipped] = turned[cleaned.flipped][:, ::-1]
    return turned


def _turn_corners(corner_uv: FloatArray, cleaned: CleanedMesh) -> FloatArray:
    """Return the texture coordinates of the corners of the cleaned triangles."""
    position = corner_uv[cleaned.triangles]
    # Reversing a triangle exchanges its last two corners.
    position[cleaned.flipped] = position[cleaned.flipped][:, (0, 2, 1)]
    return position


def _find_uv_cuts(corner_uv: FloatArray, cleaned: CleanedMesh) -> IntArray:
    """Return the edges (k, 2) of the cleaned mesh at which texture coordinates (f', 3, 2) differ."""
    # Corners without coordinates count as one position.
    position = np.nan_to_num(corner_uv, nan=np.finfo(np.float64).max) + 0.0
    rows = np.unique(position.reshape(-1, 2), axis=0, return_inverse=True)[1]
    side = find_differing_sides(cleaned.F, rows.reshape(-1, 3), len(cleaned.V))
    return np.stack([cleaned.F.ravel()[side], cleaned.F[:, (1, 2, 0)].ravel()[side]], axis=1)
