"""A surface flattened with nothing given: a bijective map into the plane, of little distortion.

    V, F ─▶ connected pieces ─▶ start, a disk ─▶ free descent ─▶ does the boundary meet itself? ─ no ─▶ laid out,
                                      │                                       │ yes                  ▲  certified
                                      └───────────────────────────────────────┴─▶ guarded descent ───┘

Overlap is rare, and what guards against it takes longer than the descent itself. So the boundary is first let go where
it likes, and only where it has come to rest on itself is it taken back to the start.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.distances.descent import kept
from quasiharmonic.apps.flattening.distances.multilevel import kept_by_coarse
from quasiharmonic.apps.flattening.layout import in_given_unit, in_range, in_unit_square, laid_along_axis, side_by_side
from quasiharmonic.apps.flattening.parts import Part, furthest_last, parts_of
from quasiharmonic.apps.flattening.piece import COARSE_FROM, Flattening, Piece, Settings
from quasiharmonic.energies.deformation import positive_weights
from quasiharmonic.energies.energies import Energy, SymmetricDirichlet
from quasiharmonic.energies.polishing import energy_named
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    map_array,
    named,
    not_negative,
    triangle_rows,
    true_or_false,
    vertex_array,
    whole_number,
)
from quasiharmonic.util.progress import reports_progress

# A descent of distances, which are but a sample, has converged at so many times the tolerance of others.
_SAMPLED = 10.0
# How descents end that nobody has stopped.
_DESCENDED = Status.POLISHED, Status.EXHAUSTED, Status.STILL_FALLING, Status.COLLAPSED


@accepts_mesh
@reports_progress
def flatten(
    V: ArrayLike,
    F: ArrayLike,
    *,
    fixed: ArrayLike | None = None,
    target: ArrayLike | None = None,
    energy: str | Energy = "symmetric-dirichlet",
    weights: ArrayLike | None = None,
    start: ArrayLike | None = None,
    unit_square: bool = False,
    rings: int = 20,
    gap: float = 0.0,
    max_iterations: int = 500,
    tolerance: float = 1e-4,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record_every: int = 0,
) -> MapResult:
    """Map a surface into the plane bijectively, its boundary going where distortion is least.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of one or several surfaces, each with at least one boundary loop, holes welcome, and no handles.
    fixed : (k,) array of int, optional
        Vertices held at ``target``, to the last bit. Surfaces with one stay where theirs put them, those with none are
        laid beside.
    target : (k, 2) array, optional
        Their positions.
    energy : str or Energy
        What is lowered, the mean over the surface's area: ``"symmetric-dirichlet"``, ``"mips"`` (angles alone),
        ``"blend"``, ``"arap-barrier"`` or an `Energy`; see `quasiharmonic.polish`. Or ``"distances"``: the symmetric
        Dirichlet energy first, and then how far distances between vertices some edges apart are off, as
        `quasiharmonic.keep_distances` lowers it; without pins and weights. From 50,000 triangles on that is done on
        a coarse mesh, if no ``start`` is given, and of its steps ``path`` has none but the map at the end.
    weights : (f,) array, optional
        How much each triangle's distortion counts; positive, 1 by default.
    start : (n, 2) array, optional
        An injective map to begin with, of any size. Where it overlaps itself, and so does all that the descent makes
        of it, or where that collapses, a start of the library's own is taken.
    unit_square : bool
        Scale the map evenly into the unit square. By default it is in the surface's own unit of length.
    rings : int
        For ``"distances"``: how many edges apart vertices are at most whose distance is to be kept.
    gap : float
        The least space between the bounding boxes of several pieces, in the surface's unit; a twentieth of the longest
        of their sides is always left. Not negative.
    max_iterations : int
        Newton steps at most on each connected piece, counted anew where an overlap makes the descent begin again, and
        for distances; with 0 the map is the start. The search for pins takes as many, or 2,000 if that is more, in each
        of two tries.
    tolerance : float
        The descent has converged when Newton's model promises a further decrease below this fraction of the
        energy; for distances, which are a sample, below ten times of it. Not negative.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step, and with the last one again at least every half second
        in between, but not within a single factorisation; its ``energy`` is the mean of what is being lowered. It may
        raise `KeyboardInterrupt`, which ends the descent as Ctrl-C does.
    record_every : int
        Keep the map of every ``record_every``-th step in the result's ``path``, before it is laid out; none of them by
        default, and none of several pieces.

    Returns
    -------
    MapResult
        Its ``uv`` is bijective, certified; the principal axis lies along x, the bounding box begins at the origin, and
        several pieces stand side by side. The status is ``POLISHED``, ``STILL_FALLING`` after the last iteration,
        ``EXHAUSTED`` when doubles cannot express a better map, ``COLLAPSED`` when the map is stretched far more than
        the surface asks for, whatever it was started from, or ``INTERRUPTED`` by Ctrl-C, with the best map so far.
        With pins it may also be ``IMPOSSIBLE``, the ``diagnosis`` naming why, or what the search has ended with; the
        map then is the best found, and only the certificate says what it is, as after an interrupt of that search.

    Raises
    ------
    ValueError
        When the input is malformed (see `Problem`), a surface is closed or has handles, a rest triangle has no area, or
        ``start`` is not injective; the message names the elements. When the map does not fit into the range of doubles.
    KeyboardInterrupt
        When Ctrl-C comes before there is a bijective map.

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
    began = time.perf_counter()
    if (fixed is None) != (target is None):
        raise ValueError("give fixed and target together: fixed vertices and their target positions")
    if fixed is not None and unit_square:
        raise ValueError("fixed vertices determine the size of the map: omit unit_square")
    whole_number("max_iterations", max_iterations, least=0)
    whole_number("record_every", record_every, least=0)
    whole_number("rings", rings, least=1)
    not_negative("gap", gap)
    true_or_false("unit_square", unit_square)
    not_negative("tolerance", tolerance)
    of_distances = isinstance(energy, str) and energy == "distances"
    if of_distances and not (fixed is None and weights is None):
        raise ValueError(
            "the energy 'distances' supports neither fixed vertices nor weights: omit fixed and weights, or choose "
            "another energy"
        )
    density = SymmetricDirichlet() if of_distances else energy_named(energy)
    name = "symmetric-dirichlet" if of_distances else energy if isinstance(energy, str) else type(energy).__name__
    settings = Settings(density, name, tolerance, max_iterations, linear_solver, callback, record_every)
    V, F = vertex_array(V), triangle_rows(F)
    weights = None if weights is None else positive_weights(weights, len(F))
    given = None if start is None else _injective(start, V, F)
    parts = parts_of(V, F)
    results: list[MapResult] = []
    held: list[Part] = []
    free = parts
    if fixed is not None and target is not None:
        from quasiharmonic.apps.flattening.pins.parts import pinned_parts
        from quasiharmonic.apps.flattening.pins.pins import checked_pins, pinned

        pins = checked_pins(fixed, target, len(V))
        if len(parts) == 1:
            result = pinned(parts[0].piece, *pins, settings, weights, given)
            return replace(result, seconds=time.perf_counter() - began, V=V)
        has_pins = [bool(np.isin(pins[0], part.vertices).any()) for part in parts]
        held = [part for part, has in zip(parts, has_pins, strict=True) if has]
        free = [part for part, has in zip(parts, has_pins, strict=True) if not has]
        results.append(pinned_parts(F, held, *pins, settings, weights, given))
    for piece, vertices, triangles in free:
        if results and results[-1].status is Status.INTERRUPTED:
            # The others still need a place, if not their best one.
            settings = replace(settings, max_iterations=0, callback=None)
        uv = None if given is None else np.ldexp(given[vertices], -piece.exponent)
        if of_distances:
            results.append(_with_distances(piece, uv, rings, settings))
        else:
            results.append(Flattening(piece, settings, None if weights is None else weights[triangles]).run(uv))
    # Where pins have put something, that stays.
    first = len(results) - len(free)
    placed = [result.uv for result in results[:first]]
    low = placed[0].min(axis=0) if placed else 0.0
    with np.errstate(over="ignore"):
        boxes = [in_range(uv - low) for uv in placed]
    boxes += [_laid_out(part.piece, result.uv) for part, result in zip(free, results[first:], strict=True)]
    beside = side_by_side(boxes, gap) if len(boxes) > 1 else boxes
    with np.errstate(over="ignore"):
        placed += [in_range(place + low) for place in beside[len(placed) :]]
    uv = np.zeros((len(V), 2))
    uv[np.concatenate([part.vertices for part in [*held, *free]])] = np.concatenate(placed)
    if unit_square:
        uv = in_unit_square(uv)
    status, certificate = furthest_last(result.status for result in results), certify(F, uv, loops=_loops(parts))
    if held and not certificate.bijective and status in _DESCENDED:
        # Beside what is held so far away, or at such a size, doubles do not tell the triangles of the others.
        status = Status.ROUNDED
    return MapResult(
        uv=uv,
        status=status,
        certificate=certificate,
        stages=[stage for result in results for stage in result.stages],
        history=[step for result in results for step in result.history],
        path=results[0].path if len(results) == 1 else [],
        diagnosis=results[0].diagnosis,
        linear_solver=results[0].linear_solver,
        seconds=time.perf_counter() - began,
        V=V,
    )


def _loops(parts: list[Part]) -> list[IntArray]:
    return [loop for part in parts for loop in part.loops]


def flattenable(V: ArrayLike, F: ArrayLike) -> list[Piece]:
    """The connected pieces of a mesh, largest first, if it is one that `flatten` takes; raises what that would.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
    F : (f, 3) array of int

    Returns
    -------
    list of Piece

    Raises
    ------
    ValueError
        As `flatten` says of surfaces.
    """
    V, F = vertex_array(V), triangle_rows(F)
    pieces = [part.piece for part in parts_of(V, F)]
    for piece in pieces:
        # Says which rest triangles have no area.
        piece.energy(SymmetricDirichlet(), None)
    return pieces


def _with_distances(piece: Piece, start: FloatArray | None, rings: int, settings: Settings) -> MapResult:
    """A piece's map with distances kept; the one without if Ctrl-C comes before there is another."""
    sampled = replace(settings, tolerance=_SAMPLED * settings.tolerance)
    if start is None and settings.max_iterations and len(piece.F) >= COARSE_FROM:
        by_coarse = kept_by_coarse(piece, rings, sampled)
        if by_coarse is not None:
            return by_coarse
    found = Flattening(piece, settings, None).run(start)
    if found.status is Status.INTERRUPTED:
        return found
    try:
        then = kept(piece, found.uv, rings, sampled, first=len(found.history))
    except KeyboardInterrupt:
        return replace(found, status=Status.INTERRUPTED)
    return replace(
        then,
        status=Status.COLLAPSED if found.status is Status.COLLAPSED else then.status,
        stages=found.stages + then.stages,
        history=found.history + then.history,
        path=found.path + then.path,
    )


def _injective(start: ArrayLike, V: FloatArray, F: IntArray) -> FloatArray:
    array = map_array("start", start, len(V))
    inverted = inverted_triangles(F, array)
    if inverted.size:
        raise ValueError(
            f"start is not injective: {named('triangle', 'triangles', inverted)} inverted or degenerate; "
            "omit it, or make it injective first (quasiharmonic.repair)"
        )
    return array


def _laid_out(piece: Piece, uv: FloatArray) -> FloatArray:
    """A piece's map in the surface's unit, along its axis; unturned where that would cost an inverted triangle."""
    laid = in_given_unit(laid_along_axis(piece.F, uv), piece.exponent)
    if certify(piece.F, laid, loops=piece.loops).bijective:
        return laid
    return in_given_unit(uv, piece.exponent)
