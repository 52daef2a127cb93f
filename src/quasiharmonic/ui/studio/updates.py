"""When a session sends which message to its page: after each new state, in a drag, and during a computation.

`messages` makes the messages that describe a state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quasiharmonic.io.models.textures import Texture
from quasiharmonic.ui.studio.drag import DragMap, Follower
from quasiharmonic.ui.studio.history import History, Storage
from quasiharmonic.ui.studio.messages import (
    DistortionMonitor,
    describe_obstructions,
    find_asked_boundary,
    handle_fields,
    map_message,
    seams_message,
    state_fields,
    surface_message,
)
from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.state import Numbering, SessionState
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.outcome import replace_nonfinite
from quasiharmonic.util.progress import end_work

Tell = Callable[[Mapping[str, Any], Mapping[str, Array]], None]


@dataclass(eq=False)
class DragState:
    """State of a drag."""

    island: int  # The island of the dragged vertex
    place: FloatArray  # (2,): target position of that vertex when the drag started
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
        self._drag_state: DragState | None = None  # The current drag; None if no vertex is grabbed
        # What the page shows: the numbering, which changes with the surface; and the point that it has as its origin,
        # because its positions in single precision are exact only near it.
        self._numbering: Numbering | None = None
        self._origin = np.zeros(2)
        # Number of the last drag step that was handled, -1 for none. Each map has it as ``after``, which tells the page
        # whether the map includes the whole drag.
        self._after = -1
        # Whether the page was told that a computation runs. If it then fails, the page must be sent the state again.
        self._working = False
        # Whether the user has stopped this computation. It then ends with its best result, and reports no progress.
        self._stopped = False

    @property
    def state(self) -> SessionState:
        """The state that the page shows."""
        return self._history.state

    @property
    def texture(self) -> Texture | None:
        """The image on the surface."""
        return self._history.texture

    def _tell_busy(self, what: str) -> None:
        """Report that a computation starts; `_show` reports its end."""
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
            self._tell({"kind": "progress", "flips": step.inverted, "energy": replace_nonfinite(step.energy)}, {})

    def _keep(self, state: SessionState, *, fit: bool = False) -> None:
        """Add a state as the last one, and show it; it ends a drag, which belongs to the state before."""
        self._drag_state = None
        self._history.add(state)
        self._show(fit=fit)

    def _send_surface(self, state: SessionState) -> None:
        self._numbering = state.numbering
        self._monitor = DistortionMonitor(state.numbering.V, state.numbering.F)
        self._tell(*surface_message(state))

    def _send_image(self) -> None:
        content, kind = (b"", "") if self.texture is None else (self.texture.data, self.texture.media_type)
        self._tell({"kind": "image", "type": kind}, {"content": np.frombuffer(content, dtype=np.uint8)})

    def _show(self, *, fit: bool = False) -> None:
        """Send the current state to the page, and store it; any computation has ended."""
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
            header |= more | self._monitor.measure(uv, uv * state.signs, now=seq < 0)
        targets = {} if asked is None or drag is None else {drag.island: asked}
        if targets or (everything and not state.in_place):
            arrays["asked"] = find_asked_boundary(state, targets, self._origin)
        self._tell(header, arrays)
