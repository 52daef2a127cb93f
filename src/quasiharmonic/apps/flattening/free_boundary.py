"""Flatten a surface without a given boundary: a bijective map into the plane with low distortion.

    V, F ─▶ connected pieces ─▶ start, a disk ─▶ free descent ─▶ does the boundary touch itself? ─ no ─▶ layout,
                                      │                                       │ yes                  ▲  certified
                                      └───────────────────────────────────────┴─▶ guarded descent ───┘

Overlaps are rare, and the guarded descent takes longer than the free one. So the boundary first moves freely. If the
converged map overlaps itself, the descent starts again with the guard.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.distance_descent import DistanceKeywords, lower_distance_error
from quasiharmonic.apps.flattening.flattening_run import Flattening
from quasiharmonic.apps.flattening.large_surfaces import lower_coarse_distance_error
from quasiharmonic.apps.flattening.piece import (
    COARSE_FROM,
    Part,
    Piece,
    align_with_axis,
    check_in_range,
    fit_unit_square,
    place_in_row,
    split_parts,
    to_given_unit,
)
from quasiharmonic.energies.deformation import positive_weights
from quasiharmonic.energies.energies import Energy, SymmetricDirichlet
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.mesh.splitting import weld_triangles
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.linsolve import check_name
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run, finish_result, run_within
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_choice,
    check_range,
    map_array,
    names_of,
    triangle_rows,
    vertex_array,
)
from quasiharmonic.util.options import FLATTENED, FlattenOptions, takes
from quasiharmonic.util.progress import reports_progress

# Distances are sampled, so their descent converges at a tolerance larger by this factor.
_SAMPLED = 10.0
# Statuses of descents that were not interrupted.
_DESCENDED = Status.POLISHED, Status.EXHAUSTED, Status.STILL_FALLING, Status.COLLAPSED


class FlattenKeywords(DistanceKeywords, total=False):
    """Types of the options of `flatten`."""

    fixed: ArrayLike | None
    target: ArrayLike | None
    energy: str | Energy
    weights: ArrayLike | None
    start: ArrayLike | None
    unit_square: bool
    gap: float
    weld: bool | float
    time_limit: float | None


@accepts_mesh
@reports_progress
@takes(FlattenOptions, FlattenKeywords)
def flatten(V: ArrayLike, F: ArrayLike, **options: Unpack[FlattenKeywords]) -> MapResult:
    """Map a surface into the plane bijectively with a free boundary.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of one or several surfaces. Each surface needs at least one boundary loop and must not have handles.
        Holes are allowed.
    fixed : (k,) array of int, optional
        Fixed vertices. They get exactly the positions in ``target``. Surfaces without fixed vertices are placed beside
        the surfaces that have some.
    target : (k, 2) array, optional
        Target positions of the fixed vertices.
    energy : str or Energy
        The objective, a mean over the surface's area: ``"symmetric-dirichlet"``, ``"mips"`` (angles only),
        ``"blend"``, ``"arap-barrier"`` or an `Energy`; see `quasiharmonic.polish`. With ``"distances"`` the symmetric
        Dirichlet energy is minimised first, then the error of distances between vertices some edges apart; see
        `quasiharmonic.keep_distances`. ``"distances"`` does not accept ``fixed`` or ``weights``. Without ``start``,
        pieces of at least 50,000 triangles use a coarse mesh for it, and ``path`` has only their final map.
    weights : (f,) array, optional
        Positive weight of each triangle's distortion; 1 by default.
    start : (n, 2) array, optional
        Initial injective map, at any scale. If the descent from it collapses or every map overlaps itself, the descent
        starts again from the default initial map.
    unit_square : bool
        Scale the map uniformly into the unit square. By default it is in the surface's unit of length.
    rings : int
        For ``"distances"``: the largest number of edges between two vertices whose distance is kept.
    gap : float
        Minimum space between the bounding boxes of several pieces, in the surface's unit; not negative. The space is
        always at least a twentieth of the longest box side.
    weld : bool or float
        Weld vertices at equal positions first, or within a distance relative to the diagonal of the bounding box; see
        `clean`. ``uv`` has the numbering of the input, and welded vertices have equal positions. The triangles
        ``F`` of the result, which the certificate covers, refer to the welded vertices. Of several welded vertices,
        ``start`` of the first one is used.
    max_iterations : int
        Maximum number of Newton steps on each connected piece. The count starts again when an overlap restarts the
        descent, and for distances. With 0 the map is the initial map. With fixed vertices, each of the two attempts
        of the search takes at most this number of steps, or 2,000 if that is more.
    tol : float
        The descent has converged when Newton's model predicts a decrease below this fraction of the energy. For
        distances, which are sampled, the fraction is ten times larger. Not negative.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step. Between steps it is called again with the last `Step`
        at least every half second, except during a factorisation. ``Step.energy`` is the current mean energy. The
        callback may raise `KeyboardInterrupt`, which ends the descent as Ctrl-C does.
    record_every : int
        Keep the map of every ``record_every``-th step in the result's ``path``, before layout. With 0, the default,
        with several pieces, or with fixed vertices if ``weld`` merges vertices, no maps are kept.
    time_limit : float, optional
        Seconds after which the call returns the best map so far with status ``TIME_LIMIT``. It is checked as often as
        the callback is called. The result then depends on the speed of the machine.

    Returns
    -------
    MapResult
        ``uv`` is certified as bijective. Without fixed vertices the principal axis lies along x, the bounding box
        starts at the origin, and several pieces stand side by side. The status is one of:

        - ``POLISHED``: converged.
        - ``STILL_FALLING``: stopped after ``max_iterations``.
        - ``EXHAUSTED``: doubles cannot represent a better map.
        - ``COLLAPSED``: from every initial map, the result is stretched far more than the surface requires.
        - ``INTERRUPTED``, ``TIME_LIMIT``: stopped by Ctrl-C or ``time_limit``; the map is the best so far.
        - With fixed vertices also ``IMPOSSIBLE``, with the cause in ``diagnosis``, or the status of the search. The
          map is then the best found and may not be injective; see its certificate. The same holds after an interrupt
          of that search.

    Raises
    ------
    ValueError
        If the input is malformed (see `Problem`), a surface is closed or has handles, a rest triangle has no area, or
        ``start`` is not injective; the message names the elements. Also if welding merges corners of a triangle, or
        the map exceeds the range of doubles.
    KeyboardInterrupt
        If Ctrl-C comes before a bijective map exists.
    TimeoutError
        If there is no bijective map within the time limit.

    See Also
    --------
    injective_map : If the boundary has target positions.
    keep_distances : Lowers the error of distances further.
    unwrap : Any model, closed or with defects, into a texture.
    quasiharmonic.atlas.flatten : Every island of a mesh with seams.

    Examples
    --------
    A cone without its tip, cut open, is isometric to a part of a ring:

    >>> import numpy as np
    >>> from quasiharmonic.surfaces import grid
    >>> square, F = grid(12, 6)
    >>> r, angle = 1 + square[:, 1], 5 * square[:, 0]
    >>> V = np.stack([0.6 * r * np.cos(angle), 0.6 * r * np.sin(angle), 0.8 * r], axis=1)
    >>> result = flatten(V, F)
    >>> bool(result.certificate.bijective), result.history[-1].energy < 1e-2
    (True, True)
    """
    return flatten_surface(V, F, FlattenOptions(**options))


def flatten_surface(V: ArrayLike, F: ArrayLike, checked: FlattenOptions) -> MapResult:
    """Map a surface into the plane bijectively with a free boundary; see `flatten`."""
    return run_within(checked.time_limit, lambda: _flatten(V, F, checked))


def _flatten(V: ArrayLike, F: ArrayLike, checked: FlattenOptions) -> MapResult:
    """Map a surface; see `flatten`."""
    began = time.perf_counter()
    _check_combination(checked)
    V, F = vertex_array(V), triangle_rows(F)
    check_range("F", F, len(V))
    F, joint = weld_triangles(V, F, checked.weld)
    weights = None if checked.weights is None else positive_weights(checked.weights, len(F))
    given = None if checked.start is None else _check_start(checked.start, V, F)
    kept = joint == np.arange(len(V))
    held, free, results = list[Part](), split_parts(V, F, None if kept.all() else kept), list[MapResult]()
    if checked.fixed is not None:
        from quasiharmonic.apps.flattening.part_arrangement import flatten_pinned_parts
        from quasiharmonic.apps.flattening.pin_search import PinSearch, check_pins

        pins = _weld_pins(joint, *check_pins(checked.fixed, checked.target, len(V)))
        if len(free) == 1 and kept.all():
            search = PinSearch(free[0].piece, *pins, checked, weights)
            search.run(given)
            return replace(search.result(), seconds=time.perf_counter() - began, V=V)
        has_pins = [bool(np.isin(pins[0], part.vertices).any()) for part in free]
        held = [part for part, has in zip(free, has_pins, strict=True) if has]
        free = [part for part, has in zip(free, has_pins, strict=True) if not has]
        results.append(flatten_pinned_parts(F, held, *pins, checked, weights, given))
    # After Ctrl-C the other pieces still need a position, so they get their initial maps.
    unmoved = replace(checked, max_iterations=0, callback=None)
    for part in free:
        stopped, run = bool(results) and results[-1].status is Status.INTERRUPTED, Run()
        with run.until_interrupted():
            results.append(_flatten_part(part, given, weights, unmoved if stopped else checked))
        if run.interrupted:
            if stopped or not results:
                raise KeyboardInterrupt
            results.append(replace(_flatten_part(part, given, weights, unmoved), status=Status.INTERRUPTED))

    def end() -> MapResult:
        uv = _place(len(V), held, free, results, checked.gap)[joint]
        return _combine(F, fit_unit_square(uv) if checked.unit_square else uv, held, free, results)

    result = finish_result(end)
    if not kept.all():
        # Recorded maps are those of a single part, in its numbering.
        number = (np.cumsum(kept) - 1)[joint]
        path = [] if held else [replace(step, uv=step.uv[number]) for step in result.path]
        result = replace(result, path=path)
    return replace(result, seconds=time.perf_counter() - began, V=V)


def _weld_pins(joint: IntArray, fixed: IntArray, target: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return fixed vertices and their target positions after welding; ValueError if a vertex gets several targets."""
    _, first, group = np.unique(joint[fixed], return_index=True, return_inverse=True)
    differs = (target != target[first[group]]).any(axis=1)
    if differs.any():
        raise ValueError(
            f"{names_of('fixed vertex', 'fixed vertices', fixed[differs])} welded to a fixed vertex with another "
            "target position: give both the same target, or choose a smaller distance"
        )
    first = np.sort(first)
    return joint[fixed[first]], target[first]


def _check_combination(options: FlattenOptions) -> None:
    """Raise ValueError if options exclude each other or name what does not exist."""
    if (options.fixed is None) != (options.target is None):
        raise ValueError("give fixed and target together: fixed vertices and their target positions")
    if options.fixed is not None and options.unit_square:
        raise ValueError("fixed vertices determine the size of the map: omit unit_square")
    check_name(options.linear_solver)
    if isinstance(options.energy, str):
        check_choice("energy", options.energy, FLATTENED)
    if not _keeps_distances(options):
        find_energy(options.energy)
    elif options.fixed is not None or options.weights is not None:
        raise ValueError(
            "the energy 'distances' supports neither fixed vertices nor weights: omit fixed and weights, or choose "
            "another energy"
        )


def _keeps_distances(options: FlattenOptions) -> bool:
    """Whether the energy is that of distances."""
    return isinstance(options.energy, str) and options.energy == "distances"


def _flatten_part(
    part: Part, start: FloatArray | None, weights: FloatArray | None, options: FlattenOptions
) -> MapResult:
    """Flatten one connected surface without fixed vertices."""
    piece = part.piece
    uv = None if start is None else np.ldexp(start[part.vertices], -piece.exponent)
    if _keeps_distances(options):
        return _flatten_with_distances(piece, uv, replace(options, energy="symmetric-dirichlet"))
    return Flattening(piece, options, None if weights is None else weights[part.triangles]).run(uv)


def _place(n: int, held: Sequence[Part], free: Sequence[Part], results: Sequence[MapResult], gap: float) -> FloatArray:
    """Return the positions (n, 2) of all pieces, side by side; pieces with fixed vertices keep their positions."""
    first = len(results) - len(free)
    placed = [result.uv for result in results[:first]]
    low = placed[0].min(axis=0) if placed else 0.0
    with np.errstate(over="ignore"):
        boxes = [check_in_range(uv - low) for uv in placed]
    boxes += [_lay_out(part.piece, result.uv) for part, result in zip(free, results[first:], strict=True)]
    beside = place_in_row(boxes, gap) if len(boxes) > 1 else boxes
    with np.errstate(over="ignore"):
        placed += [check_in_range(place + low) for place in beside[len(placed) :]]
    uv = np.zeros((n, 2))
    uv[np.concatenate([part.vertices for part in [*held, *free]])] = np.concatenate(placed)
    return uv


def _combine(
    F: IntArray, uv: FloatArray, held: Sequence[Part], free: Sequence[Part], results: Sequence[MapResult]
) -> MapResult:
    """Certify the map of all pieces, and combine the reports of the descents."""
    loops = [loop for part in [*held, *free] for loop in part.loops]
    found = MapResult.combine(results, uv, certify(F, uv, loops=loops))
    if held and not found.certificate.bijective and found.status in _DESCENDED:
        # If fixed vertices are far away or at a very different scale, doubles cannot resolve the other pieces there.
        return replace(found, status=Status.ROUNDED)
    return found


def check_flattenable(V: ArrayLike, F: ArrayLike) -> list[Piece]:
    """Return the connected pieces of a mesh, largest first; raise ValueError if `flatten` rejects it."""
    V, F = vertex_array(V), triangle_rows(F)
    pieces = [part.piece for part in split_parts(V, F)]
    for piece in pieces:
        # Raises ValueError and names rest triangles without area.
        piece.energy(SymmetricDirichlet(), None)
    return pieces


def _flatten_with_distances(piece: Piece, start: FloatArray | None, options: FlattenOptions) -> MapResult:
    """Map a piece with ``"distances"``; if interrupted before that map exists, return the map without distances."""
    sampled = replace(options, tol=_SAMPLED * options.tol)
    if start is None and options.max_iterations and len(piece.F) >= COARSE_FROM:
        by_coarse = lower_coarse_distance_error(piece, sampled)
        if by_coarse is not None:
            return by_coarse
    found = Flattening(piece, options, None).run(start)
    if found.status is Status.INTERRUPTED or piece.thin_planar_map() is not None:
        return found
    with Run().until_interrupted():
        then = lower_distance_error(piece, found.uv, sampled, first=len(found.history)).after(found)
        return replace(then, status=Status.COLLAPSED) if found.status is Status.COLLAPSED else then
    return replace(found, status=Status.INTERRUPTED)


def _check_start(start: ArrayLike, V: FloatArray, F: IntArray) -> FloatArray:
    array = map_array("start", start, len(V))
    inverted = inverted_triangles(F, array)
    if inverted.size:
        raise ValueError(
            f"the initial map (start) is not injective: {names_of('triangle', 'triangles', inverted)} inverted or "
            "degenerate; make it injective first (quasiharmonic.repair, qhm repair)"
        )
    return array


def _lay_out(piece: Piece, uv: FloatArray) -> FloatArray:
    """Align a piece's map with its axis in the surface's unit; without the rotation if that would invert a triangle."""
    placed_uv = to_given_unit(align_with_axis(piece.F, uv), piece.exponent)
    if certify(piece.F, placed_uv, loops=piece.loops).bijective:
        return placed_uv
    return to_given_unit(uv, piece.exponent)
