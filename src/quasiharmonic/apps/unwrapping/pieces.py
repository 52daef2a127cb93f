"""Developable pieces of a surface: flat faces, prisms, tubes, cones and fillets, unrolled without stretch.

A surface is divided at its creases. A part without curvature inside is a piece. Parts with curvature are divided at
smaller angles, down to a few degrees; there, only large and compact parts are pieces. What is left is curved.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, UNDIVIDED_COST, Hinges
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.apps.unwrapping.unrolling import covers_once, find_forest, lay_along, meet
from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.mesh.reference import corner_angles, dot, rest_shapes, surface_area
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import boundary_loops, label_components, number_components
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, any_corner, mark, sum_at
from quasiharmonic.util.progress import heartbeat

#: Edges with a larger angle between the normals are creases. Those of tubes and tori with twelve sides, up to 31°, are
#: not, those of tubes with eleven sides, 32.7°, are.
CREASE = np.deg2rad(32.0)


class PieceTuning(NamedTuple):
    """Numbers that tune what counts as a developable piece; angles are in radians, shares are those of the area."""

    # Largest angle defect of a vertex of a developable piece.
    defect: float = 1e-3
    # Largest sum of the defects of all its vertices.
    all_defects: float = 0.1
    # A piece may have this number of vertices with larger defects, such as the apex of a cone. They are cut open.
    apexes: int = 2
    # A corner is rough if at least this number of pieces meets there, as on a rough scan.
    many_pieces: int = 5
    # A corner is also rough if three pieces meet there with less curvature than this, as on a coarse sphere.
    little_at_three: float = 0.45
    # The same for four pieces.
    little_at_four: float = 0.8
    # A piece is rough if more than this share of its corners is rough. Rough pieces between creases are not kept.
    rough: float = 0.5
    # But pieces between creases with at least this share are kept in any case.
    large_share: float = 0.2
    # The rings of a torus with at least six sides: largest angle of the creases between two of them, in degrees,
    # and largest ratio of their widths.
    torus_crease: float = 65.0
    torus_widths: float = 1.25
    # Smallest bound on the stretch at which such a torus needs fewer charts than its rings.
    torus_stretch: float = 1.35
    # Curved parts are divided at these angles, smaller than `CREASE`; in degrees.
    angles: tuple[float, ...] = (20.0, 13.0, 9.0, 6.0, 4.0)
    # There, a piece has at least this share.
    min_share: float = 0.15
    # More triangles than this cannot be a compact piece unless some of them are flat; see `_mark_flat`.
    many_triangles: int = 2_000
    # There, the squared perimeter of a piece is at most this multiple of its area.
    max_perimeter: float = 40.0
    # Pieces with a smaller share are dropped if they mostly border on curved parts.
    small_share: float = 0.02
    # Factor on the cost of cutting an edge that is its own mirror image.
    on_plane: float = 0.9
    # Largest stretch of an unrolled piece.
    max_stretch: float = 1.001
    # Vertices of a piece touch if they are at most this fraction of a typical edge apart.
    touching: float = 1e-5
    # Vertices that touch are moved inward by this fraction of their edges.
    apart: float = 2e-4
    # Shift of the grid on which positions are compared, so that it contains no simple fractions.
    grid_shift: float = 0.3819


_TUNING = PieceTuning()


@dataclass(eq=False)
class Pieces:
    """Developable pieces of a surface.

    Attributes
    ----------
    label : (f,) int64
        Piece of each triangle, from 0; -1 for curved parts.
    place : (f, 3) complex128
        Position of each corner in the plane, isometric; each piece has its own frame. 0 for curved parts.
    glued : (e,) bool
        Hinges at which two triangles of one piece are joined.
    """

    label: IntArray
    place: ComplexArray
    glued: BoolArray

    @property
    def count(self) -> int:
        """Number of pieces."""
        return int(self.label.max(initial=-1)) + 1

    def without(self, hinges: Hinges, curved: BoolArray) -> Pieces:
        """Return the pieces without some whole ones, whose triangles (f,) then count as curved."""
        label = np.where(curved, -1, self.label)
        label[label >= 0] = np.unique(label[label >= 0], return_inverse=True)[1]
        return Pieces(label, np.where(curved[:, None], 0.0, self.place), self.glued & ~curved[hinges.first])


class _Parts:
    """Parts of a surface (f, 3) whose triangles are connected by joined hinges (e,)."""

    def __init__(self, F: IntArray, hinges: Hinges, joined: BoolArray, angles: FloatArray, area: FloatArray) -> None:
        self.F, self.hinges, self.joined, self.angles = F, hinges, joined, angles
        self.open_sides = ~hinges.mark_sides(joined, len(F))
        self.component = number_components(hinges.first[joined], hinges.second[joined], len(F))
        self.count = int(self.component.max(initial=-1)) + 1
        self.area = np.bincount(self.component, area, self.count)
        total = np.bincount(F.ravel(), angles.ravel())
        inside, part = mark(total.size, F), np.zeros(total.size, dtype=np.int64)
        for corner in (0, 1, 2):
            inside[F[self.open_sides[:, corner - 1] | self.open_sides[:, corner], corner]] = False
            part[F[:, corner]] = self.component
        defect = np.where(inside, np.abs(2 * np.pi - total), 0.0)
        # The vertices of the surface at which a part has an apex.
        self.tips = defect > _TUNING.defect
        few = np.bincount(part[self.tips], minlength=self.count) <= _TUNING.apexes
        curved = np.bincount(part, np.where(self.tips, 0.0, defect), self.count) > _TUNING.all_defects
        self.developable = mark(self.count, self.component[any_corner(self.open_sides)]) & few & ~curved

    @cached_property
    def split(self) -> IntArray:
        """The triangles (f, 3) with separate vertices for each part."""
        return fans(self.F, pairs=(self.hinges.one[self.joined], self.hinges.other[self.joined]))[0]

    @cached_property
    def rough(self) -> BoolArray:
        """The parts (c,) at most of whose corners the surface is rounded, or many parts meet."""
        split, number = self.split, int(self.split.max()) + 1
        rim = mark(number, split[self.open_sides], np.roll(split, -1, axis=1)[self.open_sides])
        part, at = np.zeros((2, number), dtype=np.int64)
        part[split], at[split] = self.component[:, None], self.F
        # The number of parts around a vertex, at each vertex of a part's rim.
        around = np.bincount(at)[at]
        total = np.bincount(split.ravel(), self.angles.ravel(), number)
        curvature = np.abs(2 * np.pi - np.bincount(at, total))[at]
        little = np.where(around == 3, _TUNING.little_at_three, _TUNING.little_at_four)
        rounded = (curvature > _TUNING.defect) & (curvature < little)
        corner = rim & (around >= 3)
        rough = np.bincount(part[corner], (rounded | (around >= _TUNING.many_pieces))[corner], self.count)
        return np.asarray(rough > _TUNING.rough * np.bincount(part[corner], minlength=self.count))

    def find_cut(self, k: int, here: IntArray, cost: FloatArray) -> IntArray:
        """Return the cheapest cut among hinges ``here`` of part ``k`` that gives a disk, its apexes on the boundary."""
        rows = np.flatnonzero(self.component == k)
        names, own = np.unique(self.split[rows], return_inverse=True)
        loops = boundary_loops(own.reshape(-1, 3), len(names))
        terminal = np.full(len(names), -1)
        for number, loop in enumerate(loops):
            terminal[loop] = number
        side = self.hinges.one[here]
        ends = np.stack([self.split.ravel()[side], np.roll(self.split, -1, axis=1).ravel()[side]], axis=1)
        apexes = np.unique(own.reshape(-1, 3)[self.tips[self.F[rows]]])
        return _find_cut(np.searchsorted(names, ends), cost, terminal, apexes)


def _cut_costs(hinges: Hinges, cost: FloatArray, image: IntArray | None) -> FloatArray:
    """Return what it costs to cut each hinge (e,), given factors (f, 3) and the mirror images of the hinges."""
    dear = hinges.price(cost)
    # A cut along an edge inside a flat face would end there.
    dear[hinges.flat] *= UNDIVIDED_COST
    if image is not None:
        dear[image == np.arange(image.size)] *= _TUNING.on_plane
    return dear


def _drop_scattered(parts: _Parts, chosen: BoolArray, rim: FloatArray) -> BoolArray:
    """Return the chosen parts (c,) without the small ones that mostly border on parts that are not chosen."""
    hinges = parts.hinges
    one, other = parts.component[hinges.first], parts.component[hinges.second]
    apart = one != other
    one, other, length = one[apart], other[apart], hinges.length[apart]
    large = parts.area >= _TUNING.small_share
    single = np.bincount(parts.component, minlength=parts.count) == 1
    while True:
        firm = chosen & ~single
        shared = np.bincount(one, length * ~firm[other], parts.count)
        shared += np.bincount(other, length * ~firm[one], parts.count)
        kept = chosen & (large | (shared <= rim / 2))
        if np.array_equal(kept, chosen):
            return kept
        chosen = kept


def find_coarse_tori(
    V: FloatArray, F: IntArray, hinges: Hinges, max_stretch: float, apart: BoolArray | None = None
) -> BoolArray:
    """Return the triangles (f,) of tori with few sides, which count as curved at this bound on the stretch.

    Between creases, a torus with six to eleven sides consists of rings. Each ring is developable, but unrolled rings
    use the texture badly. Cut along and across, the torus needs few charts with little stretch. In contrast, the
    chamfer of a tube is narrower than its neighbours. If all creases are ``apart`` (e,), the rings are charts anyway.
    """
    if max_stretch < _TUNING.torus_stretch:
        return np.zeros(len(F), dtype=np.bool_)
    size = np.abs(hinges.angle)
    crease = (size > CREASE) & ~hinges.flat
    surface = label_components(hinges.first, hinges.second, len(F))
    # The number of hinges of a closed surface is 3/2 of the number of its triangles.
    sides, inner = (np.bincount(surface[of], minlength=len(F)) for of in (np.arange(len(F)), hinges.first))
    good = mark(len(F), surface[hinges.first[crease if apart is None else crease & ~apart]]) & (3 * sides == 2 * inner)
    for wrong in (size > np.deg2rad(_TUNING.torus_crease), crease & (hinges.angle < 0)):
        good[surface[hinges.first[wrong]]] = False
    if not good.any():
        return np.zeros(len(F), dtype=np.bool_)
    split, ring = fans(F, pairs=(hinges.one[~crease], hinges.other[~crease]))
    count, pair = int(ring.max()) + 1, np.stack([ring[hinges.first], ring[hinges.second]])
    of = np.empty(int(split.max()) + 1, dtype=np.int64)
    of[split] = ring[:, None]
    # Vertices, less edges, plus triangles: 0 for a ring.
    euler = np.bincount(of) - 2 * np.bincount(ring) + np.bincount(pair[0, ~crease], minlength=count)
    good[surface[(euler != 0)[ring]]] = False
    rim = np.bincount(pair[:, crease].ravel(), np.tile(hinges.length[crease], 2), count)
    width = np.bincount(ring, rest_shapes(V, F).m, count) / np.maximum(rim, np.finfo(float).tiny)
    low, high = np.sort(width[pair[:, crease]], axis=0)
    good[surface[hinges.first[crease][high > _TUNING.torus_widths * low]]] = False
    return good[surface]


def find_pieces(
    V: FloatArray,
    F: IntArray,
    hinges: Hinges,
    cost: FloatArray,
    mirror: Mirror | None = None,
    *,
    max_stretch: float = 1.0,
) -> Pieces:
    """Find developable pieces and unroll them.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    hinges : Hinges
    cost : (f, 3) float64
        Factor on the cost of cutting each side. Triangles stay together at factors of at least `UNDIVIDED_COST`,
        and are apart at factors of at most `DEMANDED_COST`.
    mirror : Mirror, optional
        Mirror images; the cuts of tubes and cones are then mirrored, and lie on the plane where possible.
    max_stretch : float
        Bound on the stretch of curved parts; see `find_coarse_tori`.
    """
    together, apart = hinges.touch(cost >= UNDIVIDED_COST), hinges.touch(cost <= DEMANDED_COST)
    shapes = rest_shapes(V, F)
    area = shapes.m / shapes.m.sum()
    angles, whole = corner_angles(shapes.sides), surface_area(V, F)
    corners = np.ascontiguousarray(V.T).take(F.T, axis=1)
    along = corners - corners[:, (1, 2, 0)]
    length = np.sqrt(dot(along, along)).T
    found = Pieces(np.full(len(F), -1), np.zeros(F.shape, dtype=np.complex128), np.zeros(hinges.one.size, dtype=bool))
    torus = find_coarse_tori(V, F, hinges, max_stretch, apart)
    flat = _mark_flat(F, hinges, angles, len(V))
    for angle in (CREASE, *np.deg2rad(_TUNING.angles), 0.0):
        heartbeat()
        rest = (found.label < 0) & ~torus
        if not rest.any():
            break
        many = np.count_nonzero(rest) > _TUNING.many_triangles
        if 0 < angle < CREASE and many and area[rest & flat].sum() < _TUNING.min_share:
            continue
        within = ~apart & rest[hinges.first] & rest[hinges.second]
        # What is left between pieces can be developable as a whole, with its creases.
        joined = within & ((np.abs(hinges.angle) <= angle) | hinges.flat | together) if angle else within
        if 2 * np.count_nonzero(joined) == F.size:
            # Closed surfaces are not developable.
            continue
        parts = _Parts(F, hinges, joined, angles, area)
        chosen = parts.developable & mark(parts.count, parts.component[rest])
        if not chosen.any():
            continue
        outline = np.where(parts.open_sides, length, 0.0)
        rim: FloatArray = np.bincount(parts.component, outline.T.sum(axis=0), parts.count).astype(np.float64)
        if angle == CREASE:
            chosen &= ~parts.rough | (parts.area >= _TUNING.large_share)
            chosen = _drop_scattered(parts, chosen, rim)
        elif angle:
            chosen &= (parts.area >= _TUNING.min_share) & (rim**2 <= _TUNING.max_perimeter * parts.area * whole)
        if chosen.any():
            _unroll(V, parts, chosen, cost, found, mirror)
    return found


def _mark_flat(F: IntArray, hinges: Hinges, angles: FloatArray, n: int) -> BoolArray:
    """Mark the triangles (f,) with a corner that has no curvature, or in one plane with a neighbour.

    Vertices with curvature are on the outline of a developable piece, with few exceptions. So the only pieces without
    such triangles are thin strips, and fans around a vertex.
    """
    total = np.bincount(F.ravel(), angles.ravel(), n)
    flat = np.abs(2 * np.pi - total) <= _TUNING.defect
    return flat[F].any(axis=1) | mark(len(F), hinges.first[hinges.flat], hinges.second[hinges.flat])


def _unroll(
    V: FloatArray, parts: _Parts, chosen: BoolArray, cost: FloatArray, found: Pieces, mirror: Mirror | None
) -> None:
    """Unroll the chosen parts (c,) and add those that do not overlap themselves to the pieces."""
    F, hinges = parts.F, parts.hinges
    inside = parts.joined & chosen[parts.component[hinges.first]]
    place = _lay(V, F, hinges, inside)
    joined = np.flatnonzero(inside)
    met = mark(inside.size, joined[meet(place, hinges, joined)])
    wrong = mark(parts.count, parts.component[hinges.first[inside & ~met]])
    cut = np.zeros(inside.size, dtype=bool)
    image = None if mirror is None or not wrong.any() else mirror.of_hinges(hinges, F)
    dear = _cut_costs(hinges, cost, image)
    for k in np.flatnonzero(wrong).tolist():
        here = np.flatnonzero(inside & (parts.component[hinges.first] == k))
        if image is not None and cut[image[here]].any():
            # The mirror image of this part has been cut.
            cut[here] = cut[image[here]]
        else:
            cut[here[parts.find_cut(k, here, dear[here])]] = True
    if cut.any():
        place = _lay(V, F, hinges, inside & ~cut)
        # Cuts to holes that need none close again.
        met = mark(inside.size, joined[meet(place, hinges, joined)])
    split, component = fans(F, ~hinges.mark_sides(met, len(F)))
    rows = np.flatnonzero(chosen[parts.component])
    names, own = np.unique(split[rows], return_inverse=True)
    own = own.reshape(-1, 3)
    count = np.bincount(own.ravel())
    z = sum_at(own.ravel(), place[rows].ravel(), len(names)) / count
    origin = np.empty(len(names), dtype=np.int64)
    origin[own] = F[rows]
    kinds, which = np.unique(component[rows], return_inverse=True)
    z = _separate_touching(z, own, which)
    uv = np.stack([z.real, z.imag], axis=1)
    good = covers_once(own, uv, which, np.ones(len(kinds), dtype=bool))
    # Several fans may belong to one part if unglued hinges divide it; such a part is curved.
    part = np.empty(len(kinds), dtype=np.int64)
    part[which] = parts.component[rows]
    good &= np.bincount(part, minlength=parts.count)[part] == 1
    good &= np.bincount(which, weights=_is_stretched(V[origin], own, uv), minlength=len(kinds)) == 0
    accepted = rows[good[which]]
    found.place[accepted] = z[own][good[which]]
    numbers = np.cumsum(good) - 1 + found.count
    found.label[accepted] = numbers[which[good[which]]]
    glue = met.copy()
    glue[met] = mark(len(F), accepted)[hinges.first[met]]
    found.glued |= glue


def _separate_touching(z: ComplexArray, F: IntArray, part: IntArray) -> ComplexArray:
    """Return positions (n,) at which no part touches itself in a vertex, given the part of each triangle (f, 3)."""
    owner = np.empty(len(z), dtype=np.int64)
    owner[F] = part[:, None]
    unit = _TUNING.touching * np.sqrt(np.abs(z).max() ** 2 / len(z))
    key = np.stack(
        [owner, *(np.floor(x / unit + _TUNING.grid_shift).astype(np.int64) for x in (z.real, z.imag))], axis=1
    )
    _, at, times = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    touching = (times > 1)[at.ravel()]
    if not touching.any():
        return z
    corners = z[F]
    inward = corners.mean(axis=1, keepdims=True) - corners
    shortest = np.abs(corners - np.roll(corners, 1, axis=1)).min(axis=1)
    least = np.full(len(z), np.inf)
    np.minimum.at(least, F, shortest[:, None])
    step = sum_at(F.ravel(), inward.ravel(), len(z))
    length = np.maximum(np.abs(step), np.finfo(float).tiny)
    return np.where(touching, z + _TUNING.apart * least * step / length, z)


def _is_stretched(V: FloatArray, F: IntArray, uv: FloatArray) -> BoolArray:
    """Return which triangles (k,) are stretched or inverted by a map that should be isometric."""
    measured = distortion(V, F, uv)
    with np.errstate(all="ignore"):
        high, low = measured.sigma1, measured.sigma2
        middle = np.median(high)
        return ~(np.maximum(high / middle, middle / low) <= _TUNING.max_stretch)


def _lay(V: FloatArray, F: IntArray, hinges: Hinges, inside: BoolArray) -> ComplexArray:
    """Return the positions (f, 3) of triangles that are laid out along some hinges, flat and long ones first."""
    number = np.flatnonzero(inside)
    order = np.lexsort((-hinges.length[number], ~hinges.flat[number]))
    linked, _, component = find_forest(F, hinges, number[order])
    return lay_along(V, F, hinges.one[linked], hinges.other[linked], component)


def _find_cut(ends: IntArray, cost: FloatArray, terminal: IntArray, apexes: IntArray) -> IntArray:
    """Return the edges that connect all boundary loops and apexes of a part, nearest first; a part of a shortest tree.

    Parameters
    ----------
    ends : (e, 2) int64
        Ends of the interior edges.
    cost : (e,) float64
        Cost of cutting each.
    terminal : (n,) int64
        Boundary loop of each vertex, from 0; -1 inside.
    apexes : (k,) int64
        Vertices inside.
    """
    n = len(terminal)
    goal = terminal.copy()
    goal[apexes] = terminal.max() + 1 + np.arange(apexes.size)
    tail, head = ends.astype(np.int32).T
    graph = csr_array((np.tile(cost, 2), (np.concatenate([tail, head]), np.concatenate([head, tail]))), shape=(n, n))
    number = {(a, b): k for k, (a, b) in enumerate(np.sort(ends, axis=1).tolist())}
    reached, path = goal == 0, list[int]()
    while (waiting := np.flatnonzero((goal >= 0) & ~reached)).size:
        distance, before, _ = dijkstra(graph, indices=np.flatnonzero(reached), min_only=True, return_predecessors=True)
        here = int(waiting[np.argmin(distance[waiting])])
        if not np.isfinite(distance[here]):
            break
        reached |= goal == goal[here]
        while before[here] >= 0:
            there = int(before[here])
            path.append(number[min(here, there), max(here, there)])
            reached[here], here = True, there
    return np.array(path, dtype=np.int64)
