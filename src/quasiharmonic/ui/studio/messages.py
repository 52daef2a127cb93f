"""Messages that describe a state to the page: surface, map with certificate and numbers, seams, obstructions, controls.

`docs/development/page_protocol.md` explains the fields. `updates` decides when each message is sent.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem.diagnosis.obstruction import Kind, Obstruction
from quasiharmonic.ui.studio.drag import DragMap
from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.seams import find_seams, find_sides
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.util.arrays import FloatArray, pad_to_space
from quasiharmonic.util.outcome import replace_nonfinite

Message = tuple[Mapping[str, Any], Mapping[str, Array]]


class MessageLimits(NamedTuple):
    """Limits of the messages, so that pages of large models stay responsive."""

    # Maximum numbers of obstructions, of elements per obstruction, and of islands with an entry in the page's list.
    obstructions: int = 20
    elements: int = 2000
    islands: int = 400
    # Minimum seconds between two measurements of a moving map: its numbers change no faster than one can read them.
    pause: float = 0.15
    # The same, as a multiple of the seconds of the last measurement: a drag spends at most a ninth of its time on them.
    pause_per_cost: float = 8.0


_LIMITS = MessageLimits()
# Number of the chain of edges that must not become seams.
_FORBIDDEN_CHAIN = 0xFFFFFFFF


class DistortionMonitor:
    """Distortion of a moving map; measured only now and then, so that large maps stay responsive."""

    def __init__(self, V: FloatArray, F: Array) -> None:
        self._V, self._F = V, F
        self._when, self._cost = -np.inf, 0.0
        self._numbers: dict[str, Any] = {}

    def measure(self, uv: FloatArray, reflected: FloatArray, *, now: bool) -> dict[str, Any]:
        """Return energy, worst stretch, used space and scale of a map; recent values unless ``now`` is True.

        ``reflected`` is the map with mirrored islands reflected.
        """
        began = time.perf_counter()
        if now or began - self._when > max(_LIMITS.pause, _LIMITS.pause_per_cost * self._cost):
            measured = distortion(self._V, self._F, reflected)
            defined = ~np.isnan(measured.isometric)
            with np.errstate(invalid="ignore"):
                energy = float(measured.share[defined] @ measured.symmetric_dirichlet[defined])
            worst = float(measured.isometric[defined].max()) if defined.any() else np.inf
            self._numbers = {
                "energy": replace_nonfinite(energy),
                "worst": replace_nonfinite(worst),
                "used": _find_used_space(self._F, uv),
                "packed": bool(uv.min() >= 0 and uv.max() <= 1),
                "scale": measured.scale if np.isfinite(measured.scale) else 1.0,
            }
            self._when = time.perf_counter()
            self._cost = self._when - began
        return self._numbers


def _find_used_space(F: Array, uv: FloatArray) -> float | None:
    """Return the share of the unit square that the map covers; if the map leaves the square, that of its box."""
    a, b, c = (uv[F[:, k]] for k in range(3))
    area = float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)
    low, high = uv.min(axis=0), uv.max(axis=0)
    box = 1.0 if low.min() >= 0 and high.max() <= 1 else float(np.prod(high - low))
    return area / box if box > 0 and np.isfinite(area / box) else None


def _describe_certificates(certificates: list[Certificate], overlapping: int) -> dict[str, Any]:
    """Return the certificates of all islands as entries of a message."""
    bad = sum(len(one.inverted) + len(one.degenerate) + len(one.nonfinite) for one in certificates)
    bijective = [bool(one.bijective) for one in certificates]
    if len(certificates) == 1:
        words = certificates[0].summary()
    else:
        words = f"{len(bijective)} islands: {sum(one.injective for one in certificates)} injective, {sum(bijective)} "
        pairs = f"{overlapping} {'pairs overlap' if overlapping > 1 else 'pair overlaps'}"
        words += f"bijective. {pairs if overlapping else 'No two overlap'}."
    return {
        "injective": all(one.injective for one in certificates),
        "bijective": all(bijective) and not overlapping,
        "overlapping": overlapping,
        "flips": bad,
        "verdict": words,
    }


def _list_bad_triangles(certificates: list[Certificate]) -> Array:
    """Return the triangles that are not positive, (k,) uint32, in the numbering of the page."""
    start, found = 0, [np.empty(0, dtype=np.int64)]
    for one in certificates:
        found += [one.inverted + start, one.degenerate + start, one.nonfinite + start]
        start += one.triangles
    return np.sort(np.concatenate(found)).astype(np.uint32)


def describe_obstructions(state: SessionState) -> list[dict[str, Any]]:
    """Return the obstructions to a map, or to a bijective map, as the page marks them; after a drag one for all."""
    found: list[dict[str, Any]] = []
    kinds = set[Kind]()
    for one, start, first in zip(
        state.islands, state.numbering.starts.tolist(), state.numbering.first_triangles.tolist(), strict=False
    ):
        diagnosis = None if one.result is None else one.result.diagnosis
        if diagnosis is None:
            continue
        loops = one.problem.domain.loops
        # Obstructions with vertices or edges are more specific than those of whole loops.
        for each in sorted(diagnosis.obstructions, key=lambda one: not (one.vertices.size or one.edges.size)):
            edges = each.edges if each.edges.size else np.array(_around([loops[k] for k in each.loops]), dtype=np.int64)
            kinds.add(each.kind)
            found.append(
                {
                    "message": each.message,
                    "advice": _advise(each),
                    "forbids": each.forbids.value,
                    "vertices": (each.vertices + start).tolist()[: _LIMITS.elements],
                    "edges": (edges.reshape(-1, 2) + start).tolist()[: _LIMITS.elements],
                    "triangles": (each.triangles + first).tolist()[: _LIMITS.elements],
                }
            )
    if found and state.recipe.dragged:
        crossed = "another side, so the boundary crosses itself"
        across = crossed if Kind.CROSSING in kinds else "the opposite side, so the map is turned over"
        what = {"message": f"It was dragged across {across}.", "advice": "Drag it back.", "undo": True}
        return [found[0] | what]
    return found[: _LIMITS.obstructions]


def _advise(each: Obstruction) -> str:
    """Return advice for a user of the page."""
    return "Mirror the island, then press Repair." if each.kind is Kind.REVERSED else each.advice


def _around(loops: list[Array]) -> list[list[int]]:
    """Return the edges of loops."""
    return [edge for loop in loops for edge in np.stack([loop, np.roll(loop, -1)], axis=1).tolist()]


def surface_message(state: SessionState) -> Message:
    """Return the surface in the numbering of the page."""
    numbering, sheet = state.numbering, state.sheet
    V = pad_to_space(numbering.V)
    starts = numbering.starts[:-1].tolist()
    loops = [loop + start for one, start in zip(state.islands, starts, strict=True) for loop in one.loops]
    header = {
        "kind": "surface",
        "name": sheet.name,
        "vertices": len(V),
        "triangles": len(numbering.F),
        "loops": [len(loop) for loop in loops],
        "starts": starts,
        "first_triangles": numbering.first_triangles[:-1].tolist(),
        "components": sheet.report.components,
        "closed": sheet.report.closed,
        "defects": [f"{found.size:,} {what}" for what, found in sheet.report.defects.items() if found.size],
    }
    arrays = {
        "positions": (V - V.mean(axis=0)).astype(np.float32),
        "triangles": numbering.F.astype(np.uint32),
        "boundary": np.concatenate([np.empty(0, dtype=np.int64), *loops]).astype(np.int32),
    }
    return header, arrays


def state_fields(state: SessionState) -> dict[str, Any]:
    """Return what the controls of a page show about a state at rest."""
    recipe = state.recipe
    return {
        "state": "settled",
        "mapped": state.mapped,
        "reached": state.in_place,
        "command": recipe.command,
        "python": recipe.python,
        "needs": recipe.files(),
        "anew": recipe.anew,
        "outline": None if state.active.outline is None else state.active.outline.to,
        "drawn": state.wanted_seams is not None,
        "inward": state.sheet.inward,
        "turned": state.sheet.turned,
        "islands": [
            {
                "triangles": len(one.island.F),
                "good": one.injective and bool(one.result and one.result.certificate.bijective),
            }
            for one in state.islands[: _LIMITS.islands]
        ],
        "count": len(state.islands),
    }


def handle_fields(state: SessionState) -> dict[str, Any]:
    """Return the handles of a state: corners with their numbers, pins, and the selection."""
    return {
        "corners": state.corners,
        "numbers": [i for one in state.islands for i in range(len(one.corners))],
        "pins": state.pins,
        "selected": list(state.selected),
    }


def map_message(
    state: SessionState, origin: FloatArray, dragged: tuple[int, DragMap] | None
) -> tuple[dict[str, Any], dict[str, Array], FloatArray]:
    """Return verdict and positions for a message, and the whole map; of an island that is dragged its last map.

    If an island is dragged, the message has only the positions of this island.
    """
    certificates = [one.result.certificate for one in state.islands if one.result is not None]
    uv = places = state.uv
    if dragged is None:
        header = _describe_certificates(certificates, len(state.overlapping)) | {"mirrored": state.is_mirrored}
    else:
        k, shown = dragged
        uv = uv.copy()
        start, places = int(state.numbering.starts[k]), shown.uv * state.islands[k].sign
        uv[start : start + len(places)] = places
        certificates[k] = shown.certificate
        # Overlaps between islands are checked when the drag ends.
        header = _describe_certificates(certificates, 0) | {"start": start}
    arrays = {"places": (places - origin).astype(np.float32), "bad": _list_bad_triangles(certificates)}
    return header, arrays, uv


def find_asked_boundary(state: SessionState, targets: Mapping[int, FloatArray], origin: FloatArray) -> Array:
    """Return the requested positions (b, 2) of all boundary loops; ``targets`` are those of islands that move."""
    rows = [np.empty((0, 2))]
    for k, one in enumerate(state.islands):
        if not one.loops:
            continue
        uv = one.result.uv if one.result is not None else np.zeros((len(one.island.vertices), 2))
        target = targets.get(k, one.target)
        if target is not None and one.fixed is not None:
            uv = uv.copy()
            uv[one.fixed] = target
        rows.append(uv[np.concatenate(one.loops)] * one.sign)
    return (np.concatenate(rows) - origin).astype(np.float32)


def seams_message(state: SessionState) -> Message:
    """Return the seams, each side with the number of its chain; or of the wanted ones; then forbidden edges."""
    sides, forbidden = find_sides(state, find_seams(state)), find_sides(state, state.forbidden).edges
    header = {"kind": "seams", "drawn": state.wanted_seams is not None, "chains": int(sides.chains.max(initial=-1)) + 1}
    chains = np.concatenate([sides.chains, np.full(len(forbidden), _FORBIDDEN_CHAIN)])
    edges = np.concatenate([sides.edges, forbidden])
    return header, {"edges": edges.astype(np.uint32), "chain": chains.astype(np.uint32)}
