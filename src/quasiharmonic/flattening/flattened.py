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

from quasiharmonic.arrays import (
    FloatArray,
    IntArray,
    check_range,
    index_array,
    map_array,
    named,
    not_negative,
    real_array,
    whole_number,
)
from quasiharmonic.energy.deformation import positive_weights
from quasiharmonic.energy.energies import Energy, SymmetricDirichlet
from quasiharmonic.energy.polishing import energy_named
from quasiharmonic.exact.certificate import certify, flipped_triangles
from quasiharmonic.flattening.distance_descent import kept
from quasiharmonic.flattening.layout import in_unit_square, laid_along_axis, side_by_side
from quasiharmonic.flattening.piece import Flattening, Piece, Settings
from quasiharmonic.mesh.topology import components
from quasiharmonic.result import MapResult, Status, Step

# A descent of distances, which are but a sample, has converged at so many times the tolerance of others.
_SAMPLED = 10.0
# Several pieces together are as far as the one that comes first here.
_FURTHEST_LAST = Status.INTERRUPTED, Status.STILL_FALLING, Status.EXHAUSTED, Status.POLISHED


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
    record: int = 0,
) -> MapResult:
    """Map a surface into the plane bijectively, its boundary going where distortion is least.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions.
    F : (f, 3) array of int
        Triangles of one or several surfaces, each with at least one boundary loop, holes welcome, and no handles.
    fixed : (k,) array of int, optional
        Vertices held at ``target``, to the last bit, of one connected surface. The map then stays where they put it.
    target : (k, 2) array, optional
        Their positions.
    energy : str or Energy
        What is lowered, the mean over the surface's area: ``"symmetric-dirichlet"``, ``"mips"`` (angles alone),
        ``"blend"``, ``"arap-barrier"`` or an `Energy`; see `quasiharmonic.polish`. Or ``"distances"``: the symmetric
        Dirichlet energy first, and then how far distances between vertices some edges apart are off, as
        `quasiharmonic.keep_distances` lowers it; without pins and weights.
    weights : (f,) array, optional
        How much each triangle's distortion counts; positive, 1 by default.
    start : (n, 2) array, optional
        An injective map to begin with, of any size. Where it overlaps itself, and so does all that the descent makes
        of it, a start of the library's own is taken.
    unit_square : bool
        Scale the map evenly into the unit square. By default it is in the surface's own unit of length.
    rings : int
        For ``"distances"``: how many edges apart vertices are at most whose distance is to be kept.
    gap : float
        The least space between the bounding boxes of several pieces, in the surface's unit; a twentieth of the longest
        of their sides is always left. Not negative.
    max_iterations : int
        Newton steps at most on each connected piece, counted anew where an overlap makes the descent begin again, and
        for distances.
    tolerance : float
        The descent has converged when Newton's model promises a further decrease below this fraction of the
        energy; for distances, which are a sample, below ten times of it. Not negative.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step; its ``energy`` is the mean of what is being lowered. It
        may raise `KeyboardInterrupt`, which ends the descent as Ctrl-C does.
    record : int
        Keep the map of every ``record``-th step in the result's ``path``, before it is laid out; none of them by
        default, and none of several pieces.

    Returns
    -------
    MapResult
        Its ``uv`` is bijective, certified; the principal axis lies along x, the bounding box begins at the origin, and
        several pieces stand side by side. The status is ``POLISHED``, ``STILL_FALLING`` after the last iteration,
        ``EXHAUSTED`` when doubles cannot express a better map, or ``INTERRUPTED`` by Ctrl-C, with the best map so far.
        With pins it may also be ``IMPOSSIBLE``, the ``diagnosis`` naming why, or what the search has ended with; the
        map then is the best found, and only the certificate says what it is, as after an interrupt of that search.

    Raises
    ------
    ValueError
        When the input is malformed (see `Problem`), a surface is closed or has handles, a rest triangle has no area, or
        ``start`` is not injective; the message names the elements.
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
        raise ValueError("fixed and target belong together: vertices that are held, and where")
    if fixed is not None and unit_square:
        raise ValueError("vertices that are held decide the map's size: leave unit_square out")
    whole_number("max_iterations", max_iterations, least=0)
    whole_number("record", record, least=0)
    whole_number("rings", rings, least=1)
    not_negative("gap", gap)
    not_negative("tolerance", tolerance)
    of_distances = isinstance(energy, str) and energy == "distances"
    if of_distances and not (fixed is None and weights is None):
        raise ValueError(
            "distances are kept of a map whose vertices are all free and whose triangles all count alike: leave fixed "
            "and weights out, or choose another energy"
        )
    density = SymmetricDirichlet() if of_distances else energy_named(energy)
    name = "symmetric-dirichlet" if of_distances else energy if isinstance(energy, str) else type(energy).__name__
    settings = Settings(density, name, tolerance, max_iterations, linear_solver, callback, record)
    V, F = real_array("V", V), index_array("F", F)
    weights = None if weights is None else positive_weights(weights, len(F))
    given = None if start is None else _injective(start, V, F)
    if fixed is not None and target is not None:
        from quasiharmonic.flattening.pins import pinned

        return replace(pinned(V, F, fixed, target, settings, weights, given), seconds=time.perf_counter() - began)
    parts = _parts(V, F)
    pieces = _pieces(V, F, parts)
    results: list[MapResult] = []
    for piece, (vertices, triangles) in zip(pieces, parts, strict=True):
        if results and results[-1].status is Status.INTERRUPTED:
            # The others still need a place, if not their best one.
            settings = replace(settings, max_iterations=0, callback=None)
        uv = None if given is None else np.ldexp(given[vertices], -piece.exponent)
        run = Flattening(piece, settings, None if weights is None else weights[triangles])
        result = run.run(uv)
        if of_distances and result.status is not Status.INTERRUPTED:
            result = _with_distances(piece, result, rings, replace(settings, tolerance=_SAMPLED * tolerance))
        results.append(result)
    uv = np.zeros((len(V), 2))
    placed = [_laid_out(piece, result.uv) for piece, result in zip(pieces, results, strict=True)]
    for place, (vertices, _) in zip(side_by_side(placed, gap) if len(placed) > 1 else placed, parts, strict=True):
        uv[vertices] = place
    if unit_square:
        uv = in_unit_square(uv)
    loops = [vertices[loop] for piece, (vertices, _) in zip(pieces, parts, strict=True) for loop in piece.loops]
    return MapResult(
        uv=uv,
        status=min((result.status for result in results), key=_FURTHEST_LAST.index),
        certificate=certify(F, uv, loops=loops),
        stages=[stage for result in results for stage in result.stages],
        history=[step for result in results for step in result.history],
        path=results[0].path if len(results) == 1 else [],
        linear_solver=results[0].linear_solver,
        seconds=time.perf_counter() - began,
    )


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
    V, F = real_array("V", V), index_array("F", F)
    pieces = _pieces(V, F, _parts(V, F))
    for piece in pieces:
        # Says which rest triangles have no area.
        piece.energy(SymmetricDirichlet(), None)
    return pieces


def _with_distances(piece: Piece, found: MapResult, rings: int, settings: Settings) -> MapResult:
    """A piece's map after the descent of distances; the one at hand if Ctrl-C comes before there is another."""
    try:
        then = kept(piece, found.uv, rings, settings, first=len(found.history))
    except KeyboardInterrupt:
        return replace(found, status=Status.INTERRUPTED)
    return replace(
        then,
        stages=found.stages + then.stages,
        history=found.history + then.history,
        path=found.path + then.path,
    )


def _parts(V: FloatArray, F: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Vertices and triangles of every connected piece, largest piece first; one of all if the arrays are malformed."""
    everything = np.arange(len(V)), np.arange(len(F))
    if V.ndim != 2 or F.ndim != 2 or F.shape[1] != 3 or not F.size:
        return [everything]
    check_range("F", F, len(V))
    label = components(F, len(V))
    if not label.any() or np.bincount(F.ravel(), minlength=len(V)).min() == 0:
        # What is wrong with vertices of no triangle is said with the rest.
        return [everything]
    of_triangle = label[F[:, 0]]
    labels, count = np.unique(of_triangle, return_counts=True)
    return [
        (np.flatnonzero(label == own), np.flatnonzero(of_triangle == own))
        for own in labels[np.argsort(-count, kind="stable")].tolist()
    ]


def _pieces(V: FloatArray, F: IntArray, parts: list[tuple[IntArray, IntArray]]) -> list[Piece]:
    return [Piece(V, F)] if len(parts) == 1 else [_piece(V, F, *part) for part in parts]


def _piece(V: FloatArray, F: IntArray, vertices: IntArray, triangles: IntArray) -> Piece:
    number = np.zeros(len(V), dtype=np.int64)
    number[vertices] = np.arange(vertices.size)
    try:
        return Piece(V[vertices], number[F[triangles]])
    except ValueError as error:
        raise ValueError(f"the piece around vertex {vertices[0]}, its elements numbered anew: {error}") from None


def _injective(start: ArrayLike, V: FloatArray, F: IntArray) -> FloatArray:
    array = map_array("start", start, len(V))
    flipped = flipped_triangles(F, array)
    if flipped.size:
        raise ValueError(
            f"start is not injective: {named('triangle', 'triangles', flipped)} inverted or without area; "
            "leave it out, or make it injective first (quasiharmonic.repair)"
        )
    return array


def _laid_out(piece: Piece, uv: FloatArray) -> FloatArray:
    """A piece's map in the surface's unit, along its axis; unturned where that would cost an inverted triangle."""
    laid = np.ldexp(laid_along_axis(piece.F, uv), piece.exponent)
    if certify(piece.F, laid, loops=piece.loops).bijective:
        return laid
    return np.ldexp(uv, piece.exponent)
