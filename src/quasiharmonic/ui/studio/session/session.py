"""Session of a page: handle its messages and send updates.

The module is independent of sockets and processes. The caller passes in messages and transmits the updates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quasiharmonic.io.models.textures import Texture, texture_of
from quasiharmonic.ui.studio.protocol import Array, MessageFrame
from quasiharmonic.ui.studio.session import frames, operations, validation
from quasiharmonic.ui.studio.session.drag import DragMap, Follower, drag_weights
from quasiharmonic.ui.studio.session.exports import list_files
from quasiharmonic.ui.studio.session.history import History
from quasiharmonic.ui.studio.session.islands import Numbering
from quasiharmonic.ui.studio.session.outlines import Outline, make_outline, make_polygon, read_drawing
from quasiharmonic.ui.studio.session.seams import add_edges, erase_chain, find_seams, shortest_path
from quasiharmonic.ui.studio.session.setup import (
    make_first_state,
    open_without_map,
    pin_vertices,
    turn_over,
    with_corner,
    with_start,
)
from quasiharmonic.ui.studio.session.state import DistortionMonitor, SessionState, describe_obstructions
from quasiharmonic.ui.studio.session.storage import Storage
from quasiharmonic.ui.studio.session.surface import PageSurface, make_first_sheet, read_upload
from quasiharmonic.ui.studio.session.unwrapping import unwrap_model
from quasiharmonic.ui.studio.session.validation import RequestError
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.options import ENERGIES

_LARGEST_TEXTURE = 16_384

Tell = Callable[[Mapping[str, Any], Mapping[str, Array]], None]


@dataclass(eq=False)
class _DragState:
    """State of a drag."""

    island: int
    place: FloatArray  # (2,): position where the drag started
    share: FloatArray  # (k,): share of the motion for each fixed vertex
    follower: Follower | None  # Computes the maps, if the drag starts from an injective map
    goal: FloatArray | None = None  # (k, 2): current target positions of the fixed vertices
    shown: DragMap | None = None  # The last map


class Session:
    """Session of one page.

    ``tell`` sends a header and arrays to the page. ``waiting`` returns whether a newer message makes the current
    computation unnecessary. With a ``storage``, each state at rest is stored.
    """

    def __init__(self, tell: Tell, waiting: Callable[[], bool] = lambda: False, storage: Storage | None = None) -> None:
        self._tell, self._waiting = tell, waiting
        self._history = History(storage)
        self._numbering: Numbering | None = None
        self._drag_state: _DragState | None = None
        self._after = -1
        self._origin = np.zeros(2)
        self._working = False

    @property
    def state(self) -> SessionState:
        """The state that the page shows."""
        return self._history.state

    @property
    def texture(self) -> Texture | None:
        """The image on the surface."""
        return self._history.texture

    def open(self, sheet: PageSurface | None = None) -> None:
        """Open a model, by default a built-in one; its surface is shown before there is a map.

        ValueError if the model cannot be opened; the page then keeps its previous one.
        """
        sheet = make_first_sheet() if sheet is None else sheet
        bare = open_without_map(sheet)
        self._drag_state, self._after = None, -1
        self._send_surface(bare)
        self._busy("finding the first map")
        try:
            first = make_first_state(sheet, self._step)
        except KeyboardInterrupt:
            first = bare
        self._history.clear(sheet.texture)
        self._keep(first, fit=True)
        self._send_image()

    def restore(self) -> bool:
        """Continue the stored session; return whether there is one."""
        if not self._history.restore():
            return False
        self._show(fit=True)
        self._send_image()
        return True

    def handle(self, frame: MessageFrame) -> None:
        """Execute the command of a message by the method ``_do_COMMAND``.

        Errors of any type are sent to the page, and the state stays.
        """
        what = frame.header.get("do")
        do = getattr(self, f"_do_{what}", None) if isinstance(what, str) else None
        try:
            if do is None:
                raise RequestError(f"unknown request {str(what)[:40]!r}")
            do(frame)
        except KeyboardInterrupt:
            self._show()
        except Exception as error:
            self._drag_state = None
            if self._history and (self._working or not isinstance(error, RequestError)):
                self._show()
            # The surface of another model hides what was said before.
            known = isinstance(error, ValueError | OSError | ArithmeticError | RuntimeError | ImportError)
            text = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            self._tell({"kind": "note", "level": "error", "text": text}, {})

    # --- models, selection and seams ---------------------------------------------------------------------------------

    def _do_load(self, frame: MessageFrame) -> None:
        self.open(read_upload(validation.text(frame, "name"), validation.content(frame)))

    def _do_image(self, frame: MessageFrame) -> None:
        texture = texture_of(validation.content(frame))
        if texture is None:
            raise RequestError("this file is not a PNG or JPEG image")
        self._history.texture = texture
        self._history.write()
        self._send_image()

    def _do_select(self, frame: MessageFrame) -> None:
        chosen = validation.indices(frame, "islands", len(self.state.islands))
        self._history.change(replace(self.state, selected=tuple(chosen or range(len(self.state.islands)))))
        self._show()

    def _do_seam(self, frame: MessageFrame) -> None:
        """Add the shortest path between two vertices to the seams."""
        state, mesh = self.state, self.state.mesh
        start, end = self._model_vertex(frame, "start"), self._model_vertex(frame, "vertex")
        if start != end:
            path = shortest_path(mesh.V, mesh.F, start, end)
            self._keep(replace(state, drawn=add_edges(find_seams(state), path)))

    def _do_erase(self, frame: MessageFrame) -> None:
        """Remove the chain of seams nearest to a vertex."""
        state = self.state
        vertex = self._model_vertex(frame, "vertex")
        self._keep(replace(state, drawn=erase_chain(find_seams(state), state.mesh.V, vertex)))

    def _model_vertex(self, frame: MessageFrame, name: str) -> int:
        """Return the vertex of the model that a message names by its number on the page."""
        origin = self.state.numbering.origin
        return int(origin[validation.vertex(frame, len(origin), name)])

    def _do_turn(self, frame: MessageFrame) -> None:
        self._keep(turn_over(self.state), fit=True)

    # --- new maps ----------------------------------------------------------------------------------------------------

    def _do_outline(self, frame: MessageFrame) -> None:
        self._map_to(make_outline(frame.header.get("to")))

    def _do_drawing(self, frame: MessageFrame) -> None:
        self._map_to(read_drawing(validation.text(frame, "name"), validation.content(frame)))

    def _do_polygon(self, frame: MessageFrame) -> None:
        self._map_to(make_polygon(validation.points(frame)))

    def _map_to(self, outline: Outline, corners: Any = ()) -> None:
        self._refuse_drawn()
        self._busy("finding the map")
        self._keep(operations.map_to_outline(self.state, outline, corners, self._step), fit=True)

    def _do_corner(self, frame: MessageFrame) -> None:
        k, vertex = self._find(frame)
        self._busy("finding the map")
        self._keep(with_corner(self.state, k, vertex, self._step))

    def _do_corners(self, frame: MessageFrame) -> None:
        outline = self.state.active.outline
        if outline is None:
            raise RequestError("corners need an outline: choose one under Boundary first")
        self._map_to(outline, "auto")

    def _do_flatten(self, frame: MessageFrame) -> None:
        self._busy("flattening")
        self._keep(operations.flatten_islands(self.state, self._step), fit=True)

    def _do_unwrap(self, frame: MessageFrame) -> None:
        max_stretch, size = float(validation.amount(frame, "max_stretch", 1, 10, 1.5)), _read_size(frame, 2048)
        keep_seams = frame.header.get("keep_seams") is True
        self._busy("unwrapping")
        after = unwrap_model(self.state, self._step, max_stretch=max_stretch, keep_seams=keep_seams, **size)
        self._keep(after, fit=True)

    def _do_place(self, frame: MessageFrame) -> None:
        """Move or rotate the selected islands."""
        by, turn = validation.place(frame), validation.amount(frame, "turn", -360, 360, 0)
        # The page has already moved them.
        self._busy("moving the islands")
        self._refuse_drawn()
        self._keep(operations.move_islands(self.state, by, float(turn)))

    def _do_pack(self, frame: MessageFrame) -> None:
        self._refuse_drawn()
        operations.require_injective(replace(self.state, selected=tuple(range(len(self.state.islands)))))
        size = _read_size(frame, 1024)
        self._busy("packing")
        self._keep(operations.pack_all(self.state, **size), fit=True)

    def _do_polish(self, frame: MessageFrame) -> None:
        energy, slide = validation.text(frame, "energy"), frame.header.get("slide") is True
        if energy not in ENERGIES:
            raise RequestError(f"unknown energy {energy[:40]!r}: use {', '.join(ENERGIES)}")
        self._refuse_drawn()
        operations.require_injective(self.state)
        self._busy("lowering the distortion")
        self._keep(operations.polish_islands(self.state, energy, slide, self._step))

    def _refuse_drawn(self) -> None:
        if self.state.drawn is not None:
            raise RequestError("the seams have changed: press Unwrap or Flatten, which cut the surface along them")

    # --- drags and pins ----------------------------------------------------------------------------------------------

    def _do_pin(self, frame: MessageFrame) -> None:
        k, vertex = self._find(frame)
        one = self.state.islands[k]
        if any(vertex in loop for loop in one.loops):
            raise RequestError("that vertex is on the boundary, which is already fixed: drag it in the map")
        if not one.injective:
            raise RequestError("pins need a map without inverted triangles, but none was found")
        if vertex not in one.pins:
            self._keep(pin_vertices(self.state, k, [*one.pins, vertex]))

    def _find(self, frame: MessageFrame) -> tuple[int, int]:
        """Return island and own number of the vertex that a message names."""
        numbering = self.state.numbering
        return numbering.find(validation.vertex(frame, len(numbering.origin)))

    def _do_unpin(self, frame: MessageFrame) -> None:
        k, vertex = self._find(frame)
        self._keep(pin_vertices(self.state, k, [v for v in self.state.islands[k].pins if v != vertex]))

    def _do_grab(self, frame: MessageFrame) -> None:
        k, vertex = self._find(frame)
        self._refuse_drawn()
        one = self.state.islands[k]
        if one.result is None:
            raise RequestError("there is no map to drag yet: press Unwrap or Flatten first")
        if self.state.selected != (k,):
            self._history.change(replace(self.state, selected=(k,)))
        problem = one.problem
        share = drag_weights(vertex, problem.fixed, problem.target, problem.domain.loops, one.corners)
        # Without an injective map the drag only moves the boundary; a search follows at its end.
        follows = one.injective and one.in_place
        follower = Follower(problem, one.result.uv, one.result.certificate) if follows else None
        place = problem.target[np.flatnonzero(problem.fixed == vertex)[0]]
        self._drag_state = _DragState(k, place, share, follower)

    def _do_drag(self, frame: MessageFrame) -> None:
        to, seq = validation.place(frame), validation.number(frame, "seq")
        drag = self._drag_state
        if drag is None:
            # The vertex could not be grabbed, but the page still waits for an answer.
            return self._tell_map({}, seq=seq)
        self._after = seq
        one = self.state.islands[drag.island]
        assert one.target is not None
        drag.goal = one.target + drag.share[:, None] * (to * one.sign - drag.place)
        if drag.follower is None:
            return self._tell_map({}, seq=seq, asked=drag.goal)
        drag.shown = shown = drag.follower.to(drag.goal, self._waiting)
        asked = None if shown.reached else drag.goal
        fields = {"state": "following", "reached": shown.reached}
        self._tell_map(fields, seq=seq, shown=shown, asked=asked)

    def _do_drop(self, frame: MessageFrame) -> None:
        drag, self._drag_state = self._drag_state, None
        if drag is None or drag.goal is None:
            return
        self._busy("finding the map")
        reached = drag.shown is not None and drag.shown.reached
        uv = drag.shown.uv if drag.shown is not None and reached else None
        state, start = with_start(self.state, drag.island, drag.goal, uv)
        try:
            self._keep(operations.map_in_place(state, start, operations.choose(state), self._step, follows=reached))
        except KeyboardInterrupt:
            # The next message came before the final map. If the drag has a map, it is kept.
            if reached:
                self._keep(operations.as_it_is(state, start, operations.saved_start(start), ("pins",)))
            else:
                self._show()

    # --- history and files -------------------------------------------------------------------------------------------

    def _do_undo(self, frame: MessageFrame) -> None:
        self._go(-1)

    def _do_redo(self, frame: MessageFrame) -> None:
        self._go(1)

    def _go(self, step: int) -> None:
        self._drag_state = None
        self._history.go(step)
        self._show(fit=True)

    def _do_stop(self, frame: MessageFrame) -> None:
        """Show the state again; the arrival of this message has already stopped the computation."""
        self._show()

    def _do_save(self, frame: MessageFrame) -> None:
        form = frame.header.get("format", "obj")
        files = list_files(self.state, form if isinstance(form, str) else "", self._history.texture)
        for name, content in files.items():
            self._tell({"kind": "file", "name": name}, {"content": np.frombuffer(content, dtype=np.uint8)})
        self._history.mark_saved()
        self._tell({"kind": "saved"}, {})

    # --- updates of the page -----------------------------------------------------------------------------------------

    def _step(self, step: Any) -> None:
        """Report progress of a computation; KeyboardInterrupt if it is no longer needed."""
        if self._waiting():
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
            header |= more | self._measured.look(uv, now=seq < 0)
        targets = {} if asked is None or drag is None else {drag.island: asked}
        if targets or (everything and not state.in_place):
            arrays["asked"] = frames.asked_boundary(state, targets, self._origin)
        self._tell(header, arrays)

    def _busy(self, what: str) -> None:
        self._working = True
        self._tell({"kind": "busy", "what": what}, {})


def _read_size(frame: MessageFrame, resolution: int) -> dict[str, Any]:
    """Return resolution, by default the given one, and padding of a texture."""
    return {
        "resolution": int(validation.amount(frame, "resolution", 16, _LARGEST_TEXTURE, resolution)),
        "padding": float(validation.amount(frame, "padding", 0, 64, 4)),
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
