"""What a session sends to its page: surface, map with certificate, progress, and the state of the history."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from quasiharmonic.io.models.textures import Texture
from quasiharmonic.ui.studio.protocol import Array
from quasiharmonic.ui.studio.session import frames
from quasiharmonic.ui.studio.session.drag import DragMap, Follower
from quasiharmonic.ui.studio.session.history import History
from quasiharmonic.ui.studio.session.islands import Numbering
from quasiharmonic.ui.studio.session.state import DistortionMonitor, SessionState, describe_obstructions
from quasiharmonic.ui.studio.session.storage import Storage
from quasiharmonic.util.arrays import FloatArray
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

    def _busy(self, what: str) -> None:
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
        self._tell(*frames.surface_message(state))

    def _send_image(self) -> None:
        content, kind = (b"", "") if self.texture is None else (self.texture.data, self.texture.media_type)
        self._tell({"kind": "image", "type": kind}, {"content": np.frombuffer(content, dtype=np.uint8)})

    def _show(self, *, fit: bool = False) -> None:
        """Send the current state to the page."""
        state, self._working = self.state, False
        if not state.numbering.same(self._numbering):
            self._send_surface(state)
            fit = True
        if fit and state.mapped:
            uv = state.uv
            self._origin = (uv.min(axis=0) + uv.max(axis=0)) / 2
        fields = frames.state_fields(state) | self._history.fields() | {"fit": fit}
        self._tell(*frames.seams_message(state))
        self._tell_map(fields, everything=state.mapped)
        self._tell({"kind": "obstructions", "obstructions": describe_obstructions(state)}, {})
        self._history.write()

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
        header |= {**frames.handle_fields(state), **fields}
        arrays: dict[str, Array] = {}
        if everything or shown is not None:
            dragged = None if shown is None or drag is None else (drag.island, shown)
            more, arrays, uv = frames.map_message(state, self._origin, dragged)
            header |= more | self._measured.look(uv, uv * state.signs, now=seq < 0)
        targets = {} if asked is None or drag is None else {drag.island: asked}
        if targets or (everything and not state.in_place):
            arrays["asked"] = frames.asked_boundary(state, targets, self._origin)
        self._tell(header, arrays)


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
