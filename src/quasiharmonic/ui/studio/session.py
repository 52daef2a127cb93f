"""Session of a page: handle its messages.

The module is independent of sockets and processes. The caller passes in messages and transmits the updates.
`docs/development/page_protocol.md` lists the messages with their fields. The method ``_do_COMMAND`` handles COMMAND.

A message that makes a new state is an operation. Its method has the decorator `Operation`, which declares what the
operation requires. The method only reads the fields, and returns a function that computes the state (None: there is
nothing to do). `Session._perform` does the rest, in this order:

1. Raise RequestError if the state does not meet the requirements.
2. Call the method, which raises RequestError if a field is invalid.
3. Tell the page that a computation starts.
4. Compute the state, add it to the history and show it.

After an error in 1 and 2 the page still shows the state. After an error in 3 and 4 `Session.handle` sends it again.

The other methods make no state: they open models, select, drag, save, or switch between states. They check what they
require themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any

import numpy as np

from quasiharmonic.io.models.textures import texture_of
from quasiharmonic.ui.studio import operations, validation
from quasiharmonic.ui.studio.drag import Follower, drag_weights
from quasiharmonic.ui.studio.history import make_files
from quasiharmonic.ui.studio.operations import require_injective, require_map, require_not_mirrored
from quasiharmonic.ui.studio.protocol import MessageFrame
from quasiharmonic.ui.studio.seams import draw_seam, erase_seam, move_islands, pack_all, stitch_seam, weld_seams
from quasiharmonic.ui.studio.setup import make_first_state, open_without_map, turn_over, unwrap_model
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.surface import PageSurface, make_first_sheet, read_upload
from quasiharmonic.ui.studio.updates import DragState, PageUpdates
from quasiharmonic.ui.studio.validation import Outline, RequestError, make_outline, make_polygon, read_drawing
from quasiharmonic.util.options import ENERGIES

Plan = Callable[[], SessionState] | None
Planner = Callable[["Session", MessageFrame], Plan]


@dataclass(frozen=True)
class Operation:
    """Decorator of the method of an operation; the docstring of the module states what such a method does.

    Most operations would lose the seams that the user changed, so by default they are refused until the surface is cut
    along these.
    """

    busy: str = ""  # What the page shows during the computation; empty if it takes no time
    requires: Callable[[SessionState], None] | None = None  # Check of the selected islands, by RequestError
    of_all: bool = False  # Whether the check concerns all islands, not only the selected ones
    changed_seams: bool = False  # Whether it keeps the seams that the user changed, or cuts along them
    # Whether the page has already moved the map, so that step 3 comes first: any error moves it back
    ahead: bool = False
    fit: bool = False  # Whether the page then shows the whole map

    def __call__(self, plan: Planner) -> Callable[[Session, MessageFrame], None]:
        """Return the method that performs the operation."""

        @wraps(plan)
        def perform(session: Session, frame: MessageFrame) -> None:
            session._perform(self, plan, frame)

        return perform


_MAP_TO_OUTLINE = Operation("finding the map", fit=True)


class Session(PageUpdates):
    """Session of one page: handles its messages."""

    def open(self, sheet: PageSurface | None = None) -> bool:
        """Open a model, by default a built-in one; its surface is shown before there is a map.

        Return False if an interrupt ended the search for the map.
        ValueError if the model cannot be opened; the page then keeps its previous one.
        """
        sheet = make_first_sheet() if sheet is None else sheet
        bare = open_without_map(sheet)
        self._drag_state, self._after = None, -1
        self._send_surface(bare)
        self._tell_busy("finding the first map")
        try:
            first = make_first_state(sheet, self._step)
        except KeyboardInterrupt:
            first = bare
        self._history.clear(sheet.texture)
        self._keep(first, fit=True)
        self._send_image()
        if len(sheet.unmapped):
            what = "the new charts are right of them" if first.mapped else "press Unwrap to map only these triangles"
            text = f"{len(sheet.unmapped)} of {len(sheet.surface.F)} triangles of {sheet.name} lack texture coordinates"
            self._tell({"kind": "note", "level": "info", "text": f"{text}; the others keep theirs: {what}"}, {})
        return first is not bare

    def restore(self) -> bool:
        """Continue the stored session; return whether there is one."""
        if not self._history.restore():
            return False
        self._show(fit=True)
        self._send_image()
        return True

    def handle(self, frame: MessageFrame) -> bool:
        """Execute the command of a message by the method ``_do_COMMAND``; return False if an interrupt ended it.

        Errors of any type are sent to the page, and the state stays.
        """
        what = frame.header.get("do")
        do = getattr(self, f"_do_{what}", None) if isinstance(what, str) else None
        try:
            if do is None:
                raise RequestError(f"unknown request {str(what)[:40]!r}")
            do(frame)
        except operations.Interrupted as end:
            self._keep_best(end)
            return False
        except KeyboardInterrupt:
            self._show()
            return False
        except Exception as error:
            self._drag_state = None
            if self._history and (self._working or not isinstance(error, RequestError)):
                self._show()
            # Sent after the state, because the page removes its notes when it gets another surface.
            known = isinstance(error, ValueError | OSError | ArithmeticError | RuntimeError | ImportError)
            text = str(error) if known else f"unexpected {type(error).__name__}: {error}"
            self._tell({"kind": "note", "level": "error", "text": text}, {})
        return True

    def _perform(self, rule: Operation, plan: Planner, frame: MessageFrame) -> None:
        """Perform an operation in the order that the docstring of the module states."""
        if rule.ahead:
            self._tell_busy(rule.busy)
        if not rule.changed_seams:
            self._refuse_changed_seams()
        if rule.requires is not None:
            rule.requires(self.state.select_all() if rule.of_all else self.state)
        compute = plan(self, frame)
        if compute is None:
            return
        if rule.busy and not rule.ahead:
            self._tell_busy(rule.busy)
        before, after = self.state, compute()
        self._keep(after, fit=rule.fit)
        if after.recipe.note and after.recipe is not before.recipe:
            self._tell({"kind": "note", "level": "info", "text": after.recipe.note}, {})

    def _refuse_changed_seams(self) -> None:
        if self.state.wanted_seams is not None:
            raise RequestError("the seams have changed: press Unwrap or Flatten, which cut the surface along them")

    def _keep_best(self, end: operations.Interrupted) -> None:
        """After Stop, keep the map that an interrupted step had, if it is injective."""
        if self._stopped:
            best = operations.rebuild_from_mesh(self.state, end.mesh, operations.record_start(end.mesh), keep=("pins",))
            if best.injective:
                return self._keep(best)
        self._show()

    # --- models, selection and seams ---------------------------------------------------------------------------------

    def _do_load(self, frame: MessageFrame) -> None:
        self.open(read_upload(validation.read_text(frame, "name"), validation.read_content(frame)))

    def _do_image(self, frame: MessageFrame) -> None:
        texture = texture_of(validation.read_content(frame))
        if texture is None:
            raise RequestError("this file is not a PNG or JPEG image")
        self._history.texture = texture
        self._store()
        self._send_image()

    def _do_select(self, frame: MessageFrame) -> None:
        chosen = tuple(validation.read_indices(frame, "islands", len(self.state.islands)))
        self._history.change(replace(self.state, selected=chosen) if chosen else self.state.select_all())
        self._show()

    @Operation(changed_seams=True)
    def _do_seam(self, frame: MessageFrame) -> Plan:
        start, end = self._find_model_vertex(frame, "start"), self._find_model_vertex(frame, "vertex")
        axis, forbid = _read_symmetry(frame), frame.header.get("forbid") is True
        return None if start == end else lambda: draw_seam(self.state, start, end, axis, forbid=forbid)

    @Operation(changed_seams=True)
    def _do_erase(self, frame: MessageFrame) -> Plan:
        vertex, axis = self._find_model_vertex(frame, "vertex"), _read_symmetry(frame)
        return lambda: erase_seam(self.state, vertex, axis)

    @Operation(requires=require_map, of_all=True, fit=True)
    def _do_stitch(self, frame: MessageFrame) -> Plan:
        vertex = self._find_model_vertex(frame, "vertex")
        return lambda: stitch_seam(self.state, vertex)

    @Operation(requires=require_map, of_all=True)
    def _do_weld(self, frame: MessageFrame) -> Plan:
        texels = validation.read_texture_size(frame)["resolution"]
        return lambda: weld_seams(self.state, 1 / texels)

    def _find_model_vertex(self, frame: MessageFrame, name: str) -> int:
        """Return the vertex of the model that a message names by its number on the page."""
        origin = self.state.numbering.origin
        return int(origin[validation.read_vertex(frame, len(origin), name)])

    # --- new maps ----------------------------------------------------------------------------------------------------

    @_MAP_TO_OUTLINE
    def _do_outline(self, frame: MessageFrame) -> Plan:
        return self._map_to(make_outline(frame.header.get("to")))

    @_MAP_TO_OUTLINE
    def _do_drawing(self, frame: MessageFrame) -> Plan:
        return self._map_to(read_drawing(validation.read_text(frame, "name"), validation.read_content(frame)))

    @_MAP_TO_OUTLINE
    def _do_polygon(self, frame: MessageFrame) -> Plan:
        return self._map_to(make_polygon(validation.read_points(frame)))

    @_MAP_TO_OUTLINE
    def _do_corners(self, frame: MessageFrame) -> Plan:
        return self._map_to(operations.require_outline(self.state.active), "auto")

    def _map_to(self, outline: Outline, corners: Any = ()) -> Plan:
        return lambda: operations.map_to_outline(self.state, outline, corners, self._step)

    @Operation("finding the map")
    def _do_corner(self, frame: MessageFrame) -> Plan:
        k, vertex = self._find(frame)
        return lambda: operations.assign_corner(self.state, k, vertex, self._step)

    @Operation("flattening", changed_seams=True, fit=True)
    def _do_flatten(self, frame: MessageFrame) -> Plan:
        return lambda: operations.flatten_islands(self.state, self._step)

    @Operation("unwrapping", changed_seams=True, fit=True)
    def _do_unwrap(self, frame: MessageFrame) -> Plan:
        options = validation.read_options(frame) | validation.read_texture_size(frame)
        which = {name: frame.header.get(name) is True for name in ("keep_seams", "selected")}
        return lambda: unwrap_model(self.state, self._step, **which, **options)

    # --- changes of the map ------------------------------------------------------------------------------------------

    @Operation("repairing", requires=require_map, of_all=True)
    def _do_repair(self, frame: MessageFrame) -> Plan:
        return lambda: operations.repair_islands(self.state, self._step)

    @Operation(fit=True)
    def _do_turn(self, frame: MessageFrame) -> Plan:
        return lambda: turn_over(self.state)

    @Operation("moving the islands", requires=require_map, ahead=True)
    def _do_place(self, frame: MessageFrame) -> Plan:
        """Move, rotate, scale or mirror the selected islands."""
        by, turn = validation.read_place(frame), float(validation.read_amount(frame, "turn", -360, 360, 0))
        scale, mirror = float(validation.read_amount(frame, "scale", 1e-3, 1e3, 1)), frame.header.get("mirror") is True
        texels = validation.read_texture_size(frame)["resolution"] if "resolution" in frame.header else None
        return lambda: move_islands(self.state, by, turn, scale, mirror, texels)

    @Operation("packing", requires=require_injective, of_all=True, fit=True)
    def _do_pack(self, frame: MessageFrame) -> Plan:
        size = validation.read_texture_size(frame, validation.PACKING_RESOLUTION)
        return lambda: pack_all(self.state, **size)

    @Operation("lowering the distortion", requires=require_injective)
    def _do_polish(self, frame: MessageFrame) -> Plan:
        energy, slide = validation.read_text(frame, "energy"), frame.header.get("slide") is True
        if energy not in ENERGIES:
            raise RequestError(f"unknown energy {energy[:40]!r}: use {', '.join(ENERGIES)}")
        return lambda: operations.polish_islands(self.state, energy, slide, self._step)

    # --- drags and pins ----------------------------------------------------------------------------------------------

    @Operation(changed_seams=True)
    def _do_pin(self, frame: MessageFrame) -> Plan:
        k, vertex = self._find(frame)
        require_not_mirrored(self.state)
        one = self.state.islands[k]
        if any(vertex in loop for loop in one.loops):
            raise RequestError("that vertex is on the boundary, which is already fixed: drag it in the map")
        if not one.injective:
            raise RequestError("pins need a map without inverted triangles, but none was found")
        return None if vertex in one.pins else lambda: operations.pin_vertices(self.state, k, [*one.pins, vertex])

    def _find(self, frame: MessageFrame) -> tuple[int, int]:
        """Return island and own number of the vertex that a message names."""
        numbering = self.state.numbering
        return numbering.find(validation.read_vertex(frame, len(numbering.origin)))

    @Operation(changed_seams=True)
    def _do_unpin(self, frame: MessageFrame) -> Plan:
        k, vertex = self._find(frame)
        pins = self.state.islands[k].pins
        left = [v for v in pins if v != vertex]
        return None if len(left) == len(pins) else lambda: operations.pin_vertices(self.state, k, left)

    def _do_grab(self, frame: MessageFrame) -> None:
        k, vertex = self._find(frame)
        self._refuse_changed_seams()
        one = self.state.islands[k]
        if one.result is None:
            raise RequestError("there is no map to drag yet: press Unwrap or Flatten first")
        require_not_mirrored(self.state)
        if self.state.selected != (k,):
            self._history.change(replace(self.state, selected=(k,)))
        problem = one.problem
        share = drag_weights(vertex, problem.fixed, problem.target, problem.domain.loops, one.corners)
        # Without an injective map the drag only moves the boundary; a search follows at its end.
        follows = one.injective and one.in_place
        follower = Follower(problem, one.result.uv, one.result.certificate) if follows else None
        place = problem.target[np.flatnonzero(problem.fixed == vertex)[0]]
        self._drag_state = DragState(k, place, share, follower)

    def _do_drag(self, frame: MessageFrame) -> None:
        to, seq = validation.read_place(frame), validation.read_number(frame, "seq")
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
        drag.shown = shown = drag.follower.move_to(drag.goal, self._waiting)
        asked = None if shown.reached else drag.goal
        fields = {"state": "following", "reached": shown.reached}
        self._tell_map(fields, seq=seq, shown=shown, asked=asked)

    # `grab` has refused changed seams.
    @Operation("finding the map", changed_seams=True)
    def _do_drop(self, frame: MessageFrame) -> Plan:
        drag, self._drag_state = self._drag_state, None
        if drag is None or drag.goal is None:
            return None
        goal, shown = drag.goal, drag.shown
        uv = shown.uv if shown is not None and shown.reached else None

        def compute() -> SessionState:
            state, start = operations.move_target(self.state, drag.island, goal, uv)
            try:
                only = operations.list_selected(state)
                return operations.map_in_place(state, start, only, self._step, follows=uv is not None)
            except KeyboardInterrupt:
                # The next message came before the final map. If the drag has a map, it is kept.
                if uv is None:
                    raise
                return operations.rebuild_from_mesh(state, start, operations.record_start(start), ("pins",))

        return compute

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
        form = str(frame.header.get("format", "obj"))
        files, notes = make_files(self.state, form, self._history.texture)
        for name, content in files.items():
            self._tell({"kind": "file", "name": name}, {"content": np.frombuffer(content, dtype=np.uint8)})
        self._history.mark_saved()
        self._store()
        self._tell({"kind": "saved"}, {})
        if notes:
            self._tell({"kind": "note", "level": "info", "text": "; ".join(notes)}, {})


def _read_symmetry(frame: MessageFrame) -> str | None:
    """Return the axis of the symmetry in which seams are mirrored; None for no symmetry."""
    axis = frame.header.get("symmetry")
    return axis if axis in ("x", "y", "z") else None
