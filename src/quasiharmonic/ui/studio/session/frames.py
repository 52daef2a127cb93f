"""Contents of the messages to a page: the surface, the map, the seams."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.session.drag import DragMap
from quasiharmonic.ui.studio.session.seams import find_seams, sides_of
from quasiharmonic.ui.studio.session.state import SessionState, bad_triangles, verdict
from quasiharmonic.util.arrays import FloatArray, pad_to_space

Message = tuple[Mapping[str, Any], Mapping[str, Array]]
#: Number of the chain of edges that must not become seams.
FORBIDDEN = 0xFFFFFFFF
# Maximum number of islands with an entry of their own in the list of the page.
_MAX_LISTED = 400


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
        "drawn": state.drawn is not None,
        "inward": state.sheet.inward,
        "turned": state.sheet.turned,
        "islands": [
            {
                "triangles": len(one.island.F),
                "good": one.injective and bool(one.result and one.result.certificate.bijective),
            }
            for one in state.islands[:_MAX_LISTED]
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
        header = verdict(certificates, len(state.overlapping))
    else:
        k, shown = dragged
        start, places = int(state.numbering.starts[k]), shown.uv * state.islands[k].sign
        uv[start : start + len(places)] = places
        certificates[k] = shown.certificate
        # Overlaps between islands are checked when the drag ends.
        header = verdict(certificates, 0) | {"start": start}
    arrays = {"places": (places - origin).astype(np.float32), "bad": bad_triangles(certificates)}
    return header, arrays, uv


def asked_boundary(state: SessionState, targets: Mapping[int, FloatArray], origin: FloatArray) -> Array:
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
    """Return the seams, each side with the number of its chain; or those that the user drew; then forbidden edges."""
    sides, forbidden = sides_of(state, find_seams(state)), sides_of(state, state.forbidden).edges
    header = {"kind": "seams", "drawn": state.drawn is not None, "chains": int(sides.chains.max(initial=-1)) + 1}
    chains = np.concatenate([sides.chains, np.full(len(forbidden), FORBIDDEN)])
    edges = np.concatenate([sides.edges, forbidden])
    return header, {"edges": edges.astype(np.uint32), "chain": chains.astype(np.uint32)}
