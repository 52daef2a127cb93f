"""What a session sends to its page: surface, seams, map with certificate, progress, and the state of the history."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quasiharmonic.io.models.textures import Texture
from quasiharmonic.ui.studio.drag import DragMap, Follower
from quasiharmonic.ui.studio.history import History, Storage
from quasiharmonic.ui.studio.islands import find_seams, sides_of
from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.state import (
    DistortionMonitor,
    Numbering,
    SessionState,
    bad_triangles,
    describe_obstructions,
    verdict,
)
from quasiharmonic.util.arrays import FloatArray, pad_to_space
from quasiharmonic.util.progress import end_work

Tell = Callable[[Mapping[str, Any], Mapping[str, Array]], None]


@dataclass(eq=False)
class DragState:
    """State of a drag."""

    island: int
    place: FloatArray  # (2,): position where the drag started
    share: FloatArray  # (k,): share of the motion for each fixed vertex
    follower: Follower | None  # Computes the maps, if the drag starts from an injective map
    goal: FloatArray | None = None  # (k, 2): current target positions of the fixed vertices
    shown: DragMap | None = None  # The last map


class PageUpdates:
    """The states of a session, and how the page learns of them.

    ``tell`` sends a header and arrays to the page. ``waiting`` returns whether a newer message makes the current
    computation unnecessary, and ``stops`` whether one asks for its best result so far. With a ``storage``, each state
    at rest is stored.
    """

    def __init__(
        self,
        tell: Tell,
        waiting: Callable[[], bool] = lambda: False,
        storage: Storage | None = None,
        stops: Callable[[], bool] = lambda: False,
    ) -> None:
        self._tell, self._waiting, self._stops = tell, waiting, stops
        self._history = History(storage)
        self._numbering: Numbering | None = None
        self._drag_state: DragState | None = None
        self._after = -1
        self._origin = np.zeros(2)
        self._working = self._stopped = False

    @property
    def state(self) -> SessionState:
        """The state that the page shows."""
        return self._history.state

    @property
    def texture(self) -> Texture | None:
        """The image on the surface."""
        return self._history.texture

    def _tell_busy(self, what: str) -> None:
        self._working, self._stopped = True, False
        self._tell({"kind": "busy", "what": what}, {})

    def _step(self, step: Any) -> None:
        """Report progress of a computation; end it if the user stops it, or if it is no longer needed."""
        if not self._stopped and self._stops():
            self._stopped = True
            end_work()
        if not self._stopped and self._waiting():
            raise KeyboardInterrupt
        if hasattr(step, "phase"):
            self._tell({"kind": "progress", "phase": step.phase, "done": step.done, "total": step.total}, {})
        else:
            self._tell({"kind": "progress", "flips": step.inverted, "energy": _finite(step.energy)}, {})

    def _keep(self, state: SessionState, *, fit: bool = False) -> None:
        """Add a state as the last one, and show it."""
        self._history.add(state)
        self._show(fit=fit)

    def _send_surface(self, state: SessionState) -> None:
        self._numbering = state.numbering
        self._measured = DistortionMonitor(state.numbering.V, state.numbering.F)
        self._tell(*surface_message(state))

    def _send_image(self) -> None:
        content, kind = (b"", "") if self.texture is None else (self.texture.data, self.texture.media_type)
        self._tell({"kind": "image", "type": kind}, {"content": np.frombuffer(content, dtype=np.uint8)})

    def _show(self, *, fit: bool = False) -> None:
        """Send the current state to the page."""
        state, self._working = self.state, False
        if not state.numbering.equals(self._numbering):
            self._send_surface(state)
            fit = True
        if fit and state.mapped:
            uv = state.uv
            self._origin = (uv.min(axis=0) + uv.max(axis=0)) / 2
        fields = state_fields(state) | self._history.fields() | {"fit": fit}
        self._tell(*seams_message(state))
        self._tell_map(fields, everything=state.mapped)
        self._tell({"kind": "obstructions", "obstructions": describe_obstructions(state)}, {})
        self._store()

    def _store(self) -> None:
        """Store the session; if the disk is full, tell the page, which continues."""
        try:
            self._history.write()
        except OSError as error:
            reason = error.strerror or str(error)
            text = f"the session cannot be stored ({reason}): save your map before you close or reload the page"
            self._tell({"kind": "note", "level": "error", "text": text}, {})

    def _tell_map(
        self,
        fields: Mapping[str, Any],
        *,
        seq: int = -1,
        everything: bool = False,
        shown: DragMap | None = None,
        asked: FloatArray | None = None,
    ) -> None:
        """Send the whole map, or that of the dragged island, with its certificate; otherwise only the target."""
        state, drag = self.state, self._drag_state
        header = {"kind": "map", "seq": seq, "after": self._after, "fit": False, "origin": self._origin.tolist()}
        header |= {**handle_fields(state), **fields}
        arrays: dict[str, Array] = {}
        if everything or shown is not None:
            dragged = None if shown is None or drag is None else (drag.island, shown)
            more, arrays, uv = map_message(state, self._origin, dragged)
            header |= more | self._measured.look(uv, uv * state.signs, now=seq < 0)
        targets = {} if asked is None or drag is None else {drag.island: asked}
        if targets or (everything and not state.in_place):
            arrays["asked"] = asked_boundary(state, targets, self._origin)
        self._tell(header, arrays)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


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
