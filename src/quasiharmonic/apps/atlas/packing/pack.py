"""Pack charts into textures by their shapes, as large as possible and at one texel density."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence, Sized
from dataclasses import dataclass
from math import atan2
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from quasiharmonic.apps.atlas.packing.bitmap_search import BITMAPS, Layout, Textures
from quasiharmonic.apps.atlas.packing.board import Occupied
from quasiharmonic.apps.atlas.packing.layout import (
    MAX_SIZE,
    find_layout,
    find_layout_around,
    find_sufficient_size,
    least_scale,
)
from quasiharmonic.apps.atlas.packing.shapes import Shape, make_shape
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_bool,
    check_integer,
    check_non_negative,
    check_positive,
    count_of,
    describe,
    map_array,
    reject,
    to_complex,
    to_points,
    triangle_array,
)

# Largest distance of occupied places from the texture, in textures. Edges to places farther away cannot be drawn.
_FARTHEST = 100_000


@dataclass(frozen=True)
class Placement:
    """How a chart is placed: mirror, rotate, scale and shift.

    Attributes
    ----------
    angle : float
        Rotation counterclockwise in radians.
    mirrored : bool
        Whether x changes its sign before the rotation.
    offset : tuple of two floats
        Position of the chart's origin in its tile, in texels from the lower left corner.
    tile : int
        Number of the tile. The UDIM number is 1001 + tile.

    See Also
    --------
    atlas.Packing : Lists them as ``placements``.

    Examples
    --------
    >>> from quasiharmonic.atlas import pack_charts
    >>> from quasiharmonic.surfaces import grid
    >>> (placement,) = pack_charts([grid(2, 2)], resolution=100, padding=2, rotate=False).placements
    >>> abs(placement.angle), placement.mirrored, placement.tile
    (0.0, False, 0)
    """

    angle: float
    mirrored: bool
    offset: tuple[float, float]
    tile: int


@dataclass(frozen=True, eq=False)
class Packing:
    """Charts in textures; see `pack_charts`.

    Attributes
    ----------
    placements : tuple of Placement
        One for each chart.
    uv : tuple of (m, 2) float64
        Texture coordinates of each chart's vertices. Tile ``k`` is the unit square at ``(k % 10, k // 10)``.
    texels_per_unit : float
        Scale of all charts: texels per unit of length of the given maps; infinite if double precision has no such
        number, for maps smaller than about 1e-305.
    utilisation : float
        Area of the charts in texels, as a fraction of all tiles. Charts in the same place count once.

    See Also
    --------
    atlas.pack_charts : Makes it.

    Examples
    --------
    >>> from quasiharmonic.atlas import pack_charts
    >>> from quasiharmonic.surfaces import grid
    >>> packing = pack_charts([grid(2, 2)], resolution=100, padding=2)
    >>> packing.uv[0].shape, round(packing.texels_per_unit)
    ((9, 2), 98)
    """

    placements: tuple[Placement, ...]
    uv: tuple[FloatArray, ...]
    texels_per_unit: float
    utilisation: float


def pack_charts(
    charts: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    resolution: int | tuple[int, int] = 2048,
    padding: float = 4,
    texels_per_unit: float | None = None,
    tiles: int = 1,
    rotate: bool = True,
    stack: bool = False,
    kinds: Sequence[int] | None = None,
    closely: int = BITMAPS,
    occupied: tuple[ArrayLike, ArrayLike] | None = None,
    rounding: float = 2.0**-22,
) -> Packing:
    """Pack charts into one or several textures by their shapes, as large as possible and at one texel density.

    Charts are placed into concave parts and holes of others. They are rotated by any angle and not mirrored.

    Parameters
    ----------
    charts : sequence of (uv, F)
        Positions (m, 2) of each chart's vertices, all charts at the same scale, and its triangles (k, 3).
    resolution : int or (int, int)
        Texels along a side of each texture, or width and height.
    padding : float
        Minimum distance between two charts in texels. The distance to the texture's sides is at least half of it, so
        that adjacent copies of the texture keep the padding too.
    texels_per_unit : float, optional
        Texel density. By default the largest that is found.
    tiles : int
        Number of textures (UDIM tiles).
    rotate : bool
        Allow rotations.
    stack : bool
        Place congruent charts, and mirrored ones, at the same position.
    kinds : sequence of int, optional
        A number for each chart. Charts with different numbers are not stacked.
    closely : int
        Number of charts that are placed by their shapes; all others are placed as boxes, which is faster.
    occupied : (uv, F), optional
        Texture coordinates (m, 2) and triangles (k, 3) of charts that stay. The others keep the padding to them.
    rounding : float
        Additional space between charts for rounding to single precision, relative to the texture's side.

    Returns
    -------
    Packing
        The result is deterministic.

    Raises
    ------
    ValueError
        If arguments are malformed, or the charts do not fit. The message then names a sufficient resolution.

    See Also
    --------
    atlas.pack : Packs the islands of a mesh.
    quasiharmonic.unwrap : Makes charts and packs them.

    Examples
    --------
    >>> from quasiharmonic.atlas import pack_charts
    >>> from quasiharmonic.surfaces import disk
    >>> packing = pack_charts([disk(4), disk(4)], resolution=256)
    >>> len(packing.placements), bool(packing.utilisation > 0.3)
    (2, True)
    """
    pairs = _check_charts(charts)
    size = check_texture(resolution, padding, texels_per_unit, tiles, rotate, stack)
    check_integer("closely", closely, minimum=0)
    if kinds is not None and len(kinds) != len(pairs):
        raise ValueError(
            f"kinds must have {count_of('number', 'numbers', len(pairs))}, one per chart, not {len(kinds)}"
        )
    if not pairs:
        return Packing((), (), texels_per_unit or 1.0, 0.0)
    # Scale by a power of two to about unit size, so that squares do not overflow.
    exponent = int(np.frexp(max(float(np.abs(uv).max()) for uv, _ in pairs))[1])
    pairs = [(np.ldexp(uv, -exponent), F) for uv, F in pairs]
    with np.errstate(over="ignore", under="ignore"):
        wanted = None if texels_per_unit is None else float(np.ldexp(texels_per_unit, exponent))
    copies = find_copies(pairs, kinds) if stack else {}
    originals = [i for i in range(len(pairs)) if i not in copies]
    shapes = [make_shape(*pairs[i]) for i in originals]
    # Coordinates of later tiles are larger, and so are their rounding errors.
    reach = max(min(tiles, 10), -(-tiles // 10))
    spaced = padding + max(size) * (rounding * 2.0 ** (reach - 1).bit_length() + _deviation(pairs, copies))
    into = Textures(size, spaced, tiles, rotate)
    described = f"{count_of('chart', 'charts', len(shapes))} with a padding of {padding:g} texels"
    no_fit = f"{described} {'does' if len(shapes) == 1 else 'do'} not fit into"
    if wanted is not None and wanted < least_scale(shapes):
        raise ValueError(
            f"with {texels_per_unit:g} texels per unit, all charts are smaller than a texel: use more texels per unit"
        )
    if occupied is not None:
        at = map_array("occupied", occupied[0])
        remedy = "move these charts, or leave them out"
        far = np.abs(at).max(axis=1) > _FARTHEST
        reject(far, "vertex", "vertices", f"occupied has {{}} more than {_FARTHEST:,} textures away: {remedy}")
        around = Occupied(make_shape(at * size, triangle_array(occupied[1], len(at))), size)
        layout = find_layout_around(around, shapes, into, wanted)
        if layout is None:
            largest = find_layout_around(around, shapes, into, None)
            density = None if largest is None else float(np.ldexp(largest.scale, -exponent))
            raise ValueError(
                f"{no_fit} the free part of {size[0]} × {size[1]} texels: "
                + ("use more tiles or less padding" if density is None else f"texels_per_unit={density:.6g} suffices")
            )
    else:
        layout = find_layout(shapes, into, wanted, bitmaps=closely)
    if layout is None:
        width, height = find_sufficient_size(shapes, into, wanted)
        if max(width, height) > MAX_SIZE:
            wished = "" if texels_per_unit is None else f" and {texels_per_unit:g} texels per unit"
            raise ValueError(
                f"the texture needs more than {MAX_SIZE:,} texels a side for {described}{wished}: "
                f"use less padding{'' if texels_per_unit is None else ', or fewer texels per unit'}"
            )
        sufficient = f"{width} × {height} texels" if width != height else f"resolution={width}"
        into_all = f"{f'{tiles} tiles of ' if tiles > 1 else ''}{size[0]} × {size[1]} texels"
        raise ValueError(f"{no_fit} {into_all}: {sufficient} suffices for these charts")
    placed = {i: _place(shape, layout, k) for k, (i, shape) in enumerate(zip(originals, shapes, strict=True))}
    for i, copy in copies.items():
        placed[i] = _place_copy(copy.motion, placed[copy.original], layout.scale)
    placements = tuple(placed[i] for i in range(len(pairs)))
    uv = tuple(
        _transform(points, layout.scale, placement, size)
        for (points, _), placement in zip(pairs, placements, strict=True)
    )
    covered = sum(shape.area for shape in shapes) * layout.scale**2
    with np.errstate(over="ignore"):
        density = float(np.ldexp(layout.scale, -exponent))
    return Packing(placements, uv, density, covered / into.texels)


def _check_charts(charts: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[tuple[FloatArray, IntArray]]:
    """Convert charts to arrays; a ValueError names the malformed ones."""
    if not isinstance(charts, Sized) or isinstance(charts, str | bytes):
        raise ValueError(f"charts must be a list of pairs (uv, F), not {describe(charts)}")
    pairs = []
    for i, chart in enumerate(charts):
        if not isinstance(chart, Sized) or len(chart) != 2:
            raise ValueError(f"charts[{i}] must be a pair (uv, F), not {describe(chart)}")
        uv = map_array(f"charts[{i}]", chart[0])
        pairs.append((uv, triangle_array(chart[1], len(uv))))
    return pairs


def check_texture(
    resolution: Any, padding: Any, texels_per_unit: Any, tiles: Any, rotate: Any, stack: Any
) -> tuple[int, int]:
    """Check the options of `pack_charts`; return width and height in texels."""
    check_non_negative("padding", padding)
    if texels_per_unit is not None:
        check_positive(texels_per_unit=texels_per_unit)
    check_bool("rotate", rotate)
    check_bool("stack", stack)
    check_integer("tiles", tiles, minimum=1)
    sides = tuple(resolution) if isinstance(resolution, Sequence | np.ndarray) else (resolution, resolution)
    if len(sides) != 2:
        raise ValueError(f"resolution must be a number of texels, or width and height, not {resolution!r}")
    for side in sides:
        check_integer("resolution", side, minimum=1)
    return int(sides[0]), int(sides[1])


def _place(shape: Shape, layout: Layout, i: int) -> Placement:
    """The placement of a shape in a layout."""
    direction = complex(layout.directions[i])
    offset = complex(layout.centres[i]) - layout.scale * shape.box_centre(direction)
    return Placement(-atan2(direction.imag, direction.real), False, (offset.real, offset.imag), int(layout.tiles[i]))


def _deviation(pairs: list[tuple[FloatArray, IntArray]], copies: dict[int, Copy]) -> float:
    """Bound on the distance between copies and their originals, twice, as a fraction of the texture's side."""
    return max((4 * copy.deviation / np.ptp(pairs[i][0], axis=0).max() for i, copy in copies.items()), default=0.0)


def _place_copy(motion: Motion, original: Placement, scale: float) -> Placement:
    """The placement of a chart that a motion moves onto another chart."""
    turn = complex(np.exp(1j * original.angle))
    offset = complex(*original.offset) + scale * turn * motion.shift
    angle = original.angle + atan2(motion.turn.imag, motion.turn.real)
    return Placement(angle, motion.mirrored, (offset.real, offset.imag), original.tile)


def _transform(uv: FloatArray, scale: float, placement: Placement, size: tuple[int, int]) -> FloatArray:
    """Texture coordinates of a chart's vertices."""
    z = to_complex(uv)
    if placement.mirrored:
        z = -z.conjugate()
    z = z * (scale * np.exp(1j * placement.angle)) + complex(*placement.offset)
    return np.stack([z.real / size[0] + placement.tile % 10, z.imag / size[1] + placement.tile // 10], axis=1)


# Largest distance between vertices of congruent charts, relative to the chart's radius.
_TOLERANCE = 1e-4


class Motion(NamedTuple):
    """A motion of the plane: change the sign of x if mirrored, multiply by a unit complex number, then shift."""

    mirrored: bool
    turn: complex
    shift: complex

    def move(self, z: ComplexArray) -> ComplexArray:
        """Apply the motion to points (k,)."""
        return np.asarray((-z.conj() if self.mirrored else z) * self.turn + self.shift)


class Copy(NamedTuple):
    """A chart that a motion moves onto an earlier one, and the largest remaining distance of their vertices."""

    original: int
    motion: Motion
    deviation: float


def find_copies(charts: list[tuple[FloatArray, IntArray]], kinds: Sequence[int] | None = None) -> dict[int, Copy]:
    """Find the charts that are congruent to an earlier one of their kind, with vertices and triangles in any order."""
    originals: defaultdict[tuple[int, int, int], list[_Original]] = defaultdict(list)
    copies = {}
    for i, (uv, F) in enumerate(charts):
        z = to_complex(uv)
        z = z - z.mean()
        same_sizes = originals[len(uv), len(F), kinds[i] if kinds is not None else 0]
        for original in same_sizes:
            found = _align(z, F, original.z, charts[original.chart][1], original.tree)
            if found is not None:
                motion, deviation = found
                # The motion is relative to the mean of the vertices.
                here = complex(*uv.mean(axis=0))
                there = complex(*charts[original.chart][0].mean(axis=0))
                shift = motion.shift + there - complex(motion._replace(shift=0).move(np.array([here]))[0])
                copies[i] = Copy(original.chart, motion._replace(shift=shift), deviation)
                break
        else:
            same_sizes.append(_Original(i, z, KDTree(to_points(z))))
    return copies


class _Original(NamedTuple):
    """A chart with its vertices, relative to their mean."""

    chart: int
    z: ComplexArray
    tree: KDTree


def _align(
    z: ComplexArray, F: IntArray, goal: ComplexArray, goal_F: IntArray, tree: KDTree
) -> tuple[Motion, float] | None:
    """Motion of vertices with mean zero onto those of another chart, if the charts are congruent."""
    # Vertices of a chart compared with the most distant vertex of another.
    most_anchors = 64
    radius = float(np.abs(goal).max())
    tolerance = _TOLERANCE * radius
    if abs(float(np.abs(z).max()) - radius) > tolerance:
        return None
    anchor = goal[np.argmax(np.abs(goal))]
    near = np.flatnonzero(np.abs(np.abs(z) - radius) <= tolerance)[:most_anchors]
    for mirrored in (False, True):
        for vertex in near.tolist():
            start = Motion(mirrored, 1, 0).move(z)
            turn = complex(anchor * start[vertex].conj())
            moved = start * (turn / abs(turn)) if turn else start
            distance, match = tree.query(to_points(moved))
            if distance.max() > tolerance or len(np.unique(match)) < len(match):
                continue
            if not np.array_equal(_sorted_triangles(match[F]), _sorted_triangles(goal_F)):
                continue
            # The best rotation for all vertices.
            best = complex(np.vdot(start, goal[match]))
            motion = Motion(mirrored, best / abs(best) if best else 1, 0)
            return motion, float(np.abs(motion.move(z) - goal[match]).max())
    return None


def _sorted_triangles(F: IntArray) -> IntArray:
    """Triangles in an order that depends neither on their rows nor on their corners."""
    rows = np.sort(F, axis=1)
    return np.asarray(rows[np.lexsort(rows.T)])
