"""Several surfaces with fixed vertices: each at its target positions, without overlaps between them.

::

    each surface separately (`pin_search`) ─▶ do they overlap? ─ no ─▶ done
      │ yes
      ▼
    all as one piece: each at its position, or, if it overlaps others, small around one of its pins, or beside them
      ─▶ air around all of them, and the same search as for one surface ─▶ guarded descent of all
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quasiharmonic.apps.flattening.contacts import nearest_on_edges
from quasiharmonic.apps.flattening.piece import Part, name_part, unite_parts
from quasiharmonic.apps.flattening.pin_obstructions import find_pin_obstructions
from quasiharmonic.apps.flattening.pin_search import PinSearch
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.exact.loops import check_loops, winding
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.diagnosis.obstruction import renumber_obstruction
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.util.arrays import FloatArray, IntArray, invert_indices
from quasiharmonic.util.options import FlattenOptions

# A surface placed at a pin fills this fraction of the free space around it.
_FILLED = 0.5
# Distance of a surface placed beside the others, relative to their size.
_GAP = 0.25
# Maximum number of pins per surface around which free space is measured.
_MAX_PINS = 100


def flatten_pinned_parts(
    F: IntArray,
    parts: Sequence[Part],
    fixed: IntArray,
    target: FloatArray,
    options: FlattenOptions,
    weights: FloatArray | None = None,
    start: FloatArray | None = None,
) -> MapResult:
    """Map surfaces into the plane bijectively, each with some fixed vertices and an otherwise free boundary.

    ``parts`` are the surfaces that have a fixed vertex; the other arguments are those of `PinSearch`, for the
    whole mesh. The result's ``uv`` and certificate contain only the parts, one after the other. If each part has a
    bijective map but they overlap each other, the status is ``INJECTIVE``. Ctrl-C raises KeyboardInterrupt before there
    is a bijective map of each part, with or without pins.
    """
    began = time.perf_counter()

    def make_search(part: Part) -> PinSearch:
        """Return the problem of a part, in its own numbering."""
        number = invert_indices(int(F.max()) + 1, part.vertices)
        here = number[fixed] >= 0
        own = None if weights is None else weights[part.triangles]
        return PinSearch(part.piece, number[fixed[here]], target[here], options, own)

    results: list[MapResult] = []
    for part in parts:
        run = make_search(part)
        given = None if start is None else start[part.vertices]
        if results and results[-1].status is Status.INTERRUPTED:
            # The other parts still need a position, so they are only flattened freely.
            run.flatten_freely(given)
            run.status = Status.INTERRUPTED
        else:
            run.run(given)
        results.append(run.result())
    union = unite_parts(parts)
    found = _combine(union, results)
    if not found.certificate.bijective and found.status is not Status.INTERRUPTED:
        diagnosis = find_pin_obstructions(F, int(F.max()) + 1, fixed, target)
        failed = [k for k, result in enumerate(results) if not result.certificate.bijective]
        if diagnosis.forbids_bijective:
            found = replace(found, status=Status.IMPOSSIBLE, diagnosis=diagnosis)
        elif failed:
            why = results[failed[0]].diagnosis
            why = None if why is None else _renumber_diagnosis(why, parts[failed[0]])
            found = replace(found, status=results[failed[0]].status, diagnosis=why)
        else:
            found = _push_parts_apart(make_search(union), union, results, found)
    return replace(found, seconds=time.perf_counter() - began)


def _combine(union: Part, results: Sequence[MapResult]) -> MapResult:
    """Combine the maps of all parts, which may overlap."""
    uv = np.concatenate([result.uv for result in results])
    certificate = certify(union.piece.F, uv, loops=union.piece.loops)
    return replace(MapResult.combine(results, uv, certificate), path=[], diagnosis=None)


def _push_parts_apart(run: PinSearch, union: Part, results: Sequence[MapResult], found: MapResult) -> MapResult:
    """Find a bijective map of all parts, from separate maps that overlap each other."""
    unit = -run.exponent
    with np.errstate(all="ignore"):
        run.keep(np.ldexp(found.uv, unit))
        maps = [np.ldexp(result.uv, unit) for result in results]
        order = _order_by_pins(maps, run.pins[0])
        # The first part keeps its position, which decides whether others lie in its holes.
        for turn in (order, order[::-1]):
            run.find_bijective(_arrange(union, maps, run.pins, turn))
            if run.certificate.bijective or run.status is Status.INTERRUPTED:
                break
        if run.certificate.bijective and run.status is not Status.INTERRUPTED:
            run.lower_distortion()
    last = run.result()
    if not last.certificate.bijective and last.status is not Status.INTERRUPTED:
        last = replace(last, status=Status.INJECTIVE if last.certificate.injective else last.status, diagnosis=None)
    return last.after(found)


def _order_by_pins(maps: Sequence[FloatArray], fixed: IntArray) -> list[int]:
    """Order parts by decreasing number of pins, then by decreasing size."""
    ends = np.cumsum([len(uv) for uv in maps])
    pins = np.bincount(np.searchsorted(ends, fixed, side="right"), minlength=len(maps))
    return sorted(range(len(maps)), key=lambda k: (-int(pins[k]), -float(np.ptp(maps[k], axis=0).max())))


def _arrange(
    union: Part, maps: Sequence[FloatArray], pins: tuple[IntArray, FloatArray], order: Sequence[int]
) -> FloatArray:
    """Arrange bijective maps without overlap, in this order: in place, small at one of their pins, or beside."""
    positions = np.concatenate(maps)
    ends = np.cumsum([0, *(len(uv) for uv in maps)])
    owner = np.searchsorted(ends, [loop[0] for loop in union.piece.loops], side="right") - 1
    arranged: list[IntArray] = []
    for k in order:
        loops = [loop for loop, own in zip(union.piece.loops, owner, strict=True) if own == k]
        own = slice(ends[k], ends[k + 1])
        if arranged and check_loops([*arranged, *loops], positions)[1]:
            own_pins = _select_pins(pins, ends[k], ends[k + 1])
            positions[own] = _move_to_free_space(maps[k], positions, arranged, *own_pins)
        arranged += loops
    return positions


def _select_pins(pins: tuple[IntArray, FloatArray], first: int, end: int) -> tuple[IntArray, FloatArray]:
    fixed, target = pins
    own = (fixed >= first) & (fixed < end)
    return fixed[own] - first, target[own]


def _move_to_free_space(
    uv: FloatArray, positions: FloatArray, arranged: Sequence[IntArray], fixed: IntArray, target: FloatArray
) -> FloatArray:
    """Shrink a map around its pin with the most free space; if no pin has any, move the map beside the others."""
    tails = positions[np.concatenate(arranged)]
    heads = positions[np.concatenate([np.roll(loop, -1) for loop in arranged])]
    around, on = winding(target, tails, heads)
    free = np.flatnonzero((around == 0) & ~on)[:_MAX_PINS]
    if free.size:
        away, starts, ends = (in_units(points, 0) for points in (target[free], tails, heads))
        clearance = nearest_on_edges(away[:, None], starts, ends)[0].min(axis=1)
        pin, max_clearance = free[int(np.argmax(clearance))], float(clearance.max())
        away = uv - uv[fixed[pin]]
        return target[pin] + _FILLED * max_clearance / float(np.hypot(*away.T).max()) * away
    low, high = tails.min(axis=0), tails.max(axis=0)
    return uv - uv.min(axis=0) + (high[0] + _GAP * float((high - low).max()), low[1])


def _renumber_diagnosis(diagnosis: Diagnosis, part: Part) -> Diagnosis:
    """Convert a part's diagnosis to the mesh's numbering; messages keep the part's numbering, and say so."""
    where = name_part(part.vertices)
    renumbered = (renumber_obstruction(one, part.vertices, part.triangles) for one in diagnosis.obstructions)
    return Diagnosis(
        tuple(replace(one, message=f"In {where}: {one.message}") for one in renumbered),
        diagnosis.unchecked,
    )
