"""Several surfaces with fixed vertices: each at its target positions, without overlaps between them.

each surface separately (`pins`) ─▶ do they overlap? ─ no ─▶ done
│ yes
▼
all of them as one piece: each at its position, or, if it overlaps others, small around one of its pins, or beside them
─▶ air around all of them, and the same search as for one surface ─▶ guarded descent of all
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quasiharmonic.apps.flattening.parts import Part, anew, furthest_last, united
from quasiharmonic.apps.flattening.piece import Settings
from quasiharmonic.apps.flattening.pins.obstructions import pin_obstructions
from quasiharmonic.apps.flattening.pins.pins import Pinned
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.exact.loops import judge_loops, winding
from quasiharmonic.geometry.mesh.topology import edges
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import FloatArray, IntArray

# Fraction of the free space around a pin that a surface placed there uses; and the distance of a surface placed beside
# the others, relative to their size.
_SHARE, _BESIDE = 0.5, 0.25
# Maximum number of pins per surface around which free space is measured.
_MOST_PINS = 100


def pinned_parts(
    F: IntArray,
    parts: Sequence[Part],
    fixed: IntArray,
    target: FloatArray,
    settings: Settings,
    weights: FloatArray | None = None,
    start: FloatArray | None = None,
) -> MapResult:
    """Map surfaces into the plane bijectively, each with some fixed vertices and an otherwise free boundary.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles of the mesh.
    parts : sequence of Part
        The surfaces that have a fixed vertex.
    fixed : (k,) int64
        Fixed vertices of the mesh, each once.
    target : (k, 2) float64
        Target positions of the fixed vertices.
    settings : Settings
    weights : (f,) float64, optional
    start : (n, 2) float64, optional
        As for `pinned`, for the whole mesh.

    Returns
    -------
    MapResult
        As for `pinned`; ``uv`` and certificate contain only the parts, one after the other. If each part has a
        bijective map but they overlap each other, the status is ``INJECTIVE``.

    Raises
    ------
    KeyboardInterrupt
        If Ctrl-C comes before there is a bijective map of each part, with or without pins.
    """
    began = time.perf_counter()

    def posed(part: Part) -> Pinned:
        """Return the problem of a part, in its own numbering."""
        number = np.full(int(F.max()) + 1, -1)
        number[part.vertices] = np.arange(part.vertices.size)
        here = number[fixed] >= 0
        own = None if weights is None else weights[part.triangles]
        return Pinned(part.piece, number[fixed[here]], target[here], settings, own)

    results: list[MapResult] = []
    for part in parts:
        run = posed(part)
        given = None if start is None else start[part.vertices]
        with np.errstate(all="ignore"):
            if results and results[-1].status is Status.INTERRUPTED:
                # The other parts still need a position, so they are only flattened freely.
                run.lay(given)
                run.status = Status.INTERRUPTED
            else:
                run.run(given)
        results.append(run.result())
    whole = united(parts)
    found = _side_by_side(whole, results)
    if not found.certificate.bijective and found.status is not Status.INTERRUPTED:
        n = int(F.max()) + 1
        diagnosis = pin_obstructions(F, n, edges(F, n), fixed, target)
        failed = [k for k, result in enumerate(results) if not result.certificate.bijective]
        if diagnosis.forbids_bijective:
            found = replace(found, status=Status.IMPOSSIBLE, diagnosis=diagnosis)
        elif failed:
            why = results[failed[0]].diagnosis
            why = None if why is None else _by_the_mesh(why, parts[failed[0]])
            found = replace(found, status=results[failed[0]].status, diagnosis=why)
        else:
            found = _apart(posed(whole), whole, results, found)
    return replace(found, seconds=time.perf_counter() - began)


def _side_by_side(whole: Part, results: Sequence[MapResult]) -> MapResult:
    """Combine the maps of all parts, which may overlap."""
    uv = np.concatenate([result.uv for result in results])
    return MapResult(
        uv=uv,
        status=furthest_last(result.status for result in results),
        certificate=certify(whole.piece.F, uv, loops=whole.piece.loops),
        stages=[stage for result in results for stage in result.stages],
        history=[step for result in results for step in result.history],
        linear_solver=results[0].linear_solver,
    )


def _apart(run: Pinned, whole: Part, results: Sequence[MapResult], found: MapResult) -> MapResult:
    """Find a bijective map of all parts, from separate maps that overlap each other."""
    unit = -run.exponent
    with np.errstate(all="ignore"):
        run.keep(np.ldexp(found.uv, unit))
        maps = [np.ldexp(result.uv, unit) for result in results]
        order = _most_held_first(maps, run.pins[0])
        # The first part keeps its position, which decides whether others lie in its holes.
        for turn in (order, order[::-1]):
            run.seek(_arranged(whole, maps, run.pins, turn))
            if run.certificate.bijective or run.status is Status.INTERRUPTED:
                break
        if run.certificate.bijective and run.status is not Status.INTERRUPTED:
            run.let_go()
    last = run.result()
    if not last.certificate.bijective and last.status is not Status.INTERRUPTED:
        last = replace(last, status=Status.INJECTIVE if last.certificate.injective else last.status, diagnosis=None)
    return replace(last, stages=found.stages + last.stages, history=found.history + last.history)


def _most_held_first(maps: Sequence[FloatArray], fixed: IntArray) -> list[int]:
    """Order parts by decreasing number of pins, then by decreasing size."""
    ends = np.cumsum([len(uv) for uv in maps])
    pins = np.bincount(np.searchsorted(ends, fixed, side="right"), minlength=len(maps))
    return sorted(range(len(maps)), key=lambda k: (-int(pins[k]), -float(np.ptp(maps[k], axis=0).max())))


def _arranged(
    whole: Part, maps: Sequence[FloatArray], pins: tuple[IntArray, FloatArray], order: Sequence[int]
) -> FloatArray:
    """Arrange bijective maps without overlap, in this order: in place, small at one of their pins, or beside."""
    places = np.concatenate(maps)
    ends = np.cumsum([0, *(len(uv) for uv in maps)])
    owner = np.searchsorted(ends, [loop[0] for loop in whole.piece.loops], side="right") - 1
    settled: list[IntArray] = []
    for k in order:
        loops = [loop for loop, own in zip(whole.piece.loops, owner, strict=True) if own == k]
        own = slice(ends[k], ends[k + 1])
        if settled and judge_loops([*settled, *loops], places)[1]:
            places[own] = _with_room(maps[k], places, settled, *_those_of(pins, ends[k], ends[k + 1]))
        settled += loops
    return places


def _those_of(pins: tuple[IntArray, FloatArray], first: int, end: int) -> tuple[IntArray, FloatArray]:
    fixed, target = pins
    own = (fixed >= first) & (fixed < end)
    return fixed[own] - first, target[own]


def _with_room(
    uv: FloatArray, places: FloatArray, settled: Sequence[IntArray], fixed: IntArray, target: FloatArray
) -> FloatArray:
    """Shrink a map around its pin with the most free space; if no pin has any, move the map beside the others."""
    tails = places[np.concatenate(settled)]
    heads = places[np.concatenate([np.roll(loop, -1) for loop in settled])]
    around, on = winding(target, tails, heads)
    free = np.flatnonzero((around == 0) & ~on)[:_MOST_PINS]
    if free.size:
        room = _distances(target[free], tails, heads)
        pin, most = free[int(np.argmax(room))], float(room.max())
        away = uv - uv[fixed[pin]]
        return target[pin] + _SHARE * most / float(np.hypot(*away.T).max()) * away
    low, high = tails.min(axis=0), tails.max(axis=0)
    return uv - uv.min(axis=0) + (high[0] + _BESIDE * float((high - low).max()), low[1])


def _distances(points: FloatArray, tails: FloatArray, heads: FloatArray) -> FloatArray:
    """Distances of points (k, 2) to the nearest of several segments (m, 2); (k,) float64."""
    along, away = (heads - tails) @ (1, 1j), (points[:, None] - tails) @ (1, 1j)
    return np.abs(away - np.clip((away / along).real, 0, 1) * along).min(axis=1)


def _by_the_mesh(diagnosis: Diagnosis, part: Part) -> Diagnosis:
    """Convert a part's diagnosis to the mesh's numbering; messages keep the part's numbering, and say so."""
    return Diagnosis(
        tuple(
            replace(
                one,
                message=f"In {anew(part.vertices)}: {one.message}",
                vertices=part.vertices[one.vertices],
                edges=part.vertices[one.edges],
                triangles=part.triangles[one.triangles],
                split=part.vertices[one.split],
            )
            for one in diagnosis.obstructions
        ),
        diagnosis.unchecked,
    )
