"""Session of a page: handle its messages and send updates.

The module is independent of sockets and processes. The caller passes in messages and transmits the updates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quasiharmonic.energies.newton.sliding_boundary import move_onto
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.ui.studio.protocol import Array, Frame
from quasiharmonic.ui.studio.session import validation
from quasiharmonic.ui.studio.session.drag import DragMap, Follower
from quasiharmonic.ui.studio.session.falloff import drag_weights
from quasiharmonic.ui.studio.session.finalize import compute_final_map
from quasiharmonic.ui.studio.session.outlines import make_outline, make_polygon, read_drawing
from quasiharmonic.ui.studio.session.recipes import FIXED, MAP
from quasiharmonic.ui.studio.session.setup import (
    fit_to_outline,
    free_boundary,
    make_first_state,
    pin_vertices,
    with_corner,
)
from quasiharmonic.ui.studio.session.state import (
    DistortionMonitor,
    SessionState,
    bad_triangles,
    describe_obstructions,
    verdict,
)
from quasiharmonic.ui.studio.session.surface import Sheet, make_first_sheet, read_upload
from quasiharmonic.ui.studio.session.validation import RequestError
from quasiharmonic.util.arrays import FloatArray

#: Maximum number of states for undo.
MAX_STATES = 40
ENERGIES = "symmetric-dirichlet", "mips", "blend", "arap-barrier"

Tell = Callable[[Mapping[str, Any], Mapping[str, Array]], None]


@dataclass(eq=False)
class _DragState:
    """State of a drag."""

    place: FloatArray  # (2,): position where the drag started
    share: FloatArray  # (k,): share of the motion for each fixed vertex
    follower: Follower | None  # Computes the maps, if the drag starts from an injective map
    goal: FloatArray | None = None  # (k, 2): current target positions of the fixed vertices
    shown: DragMap | None = None  # The last map


class Session:
    """Session of one page.

    ``tell`` sends a header and arrays to the page. ``waiting`` returns whether a newer message makes the current
    computation unnecessary.
    """

    def __init__(self, tell: Tell, waiting: Callable[[], bool] = lambda: False) -> None:
        self._tell, self._waiting = tell, waiting
        self._sheet: Sheet
        self._states: list[SessionState] = []
        self._at = -1
        self._drag_state: _DragState | None = None
        self._after = -1

    @property
    def state(self) -> SessionState:
        """The state that the page shows."""
        return self._states[self._at]

    def open(self, sheet: Sheet | None = None) -> None:
        """Open a surface, by default a built-in one.

        ValueError if the surface cannot be mapped; the page then keeps its previous surface.
        """
        sheet = make_first_sheet() if sheet is None else sheet
        first = make_first_state(sheet)
        self._sheet, self._drag_state, self._after = sheet, None, -1
        self._origin = first.problem.target.mean(axis=0)
        V = np.zeros((first.problem.n, 3), dtype=np.float64)
        V[:, : first.problem.V.shape[1]] = first.problem.V
        self._measured = DistortionMonitor(first.problem.V, first.problem.F)
        header = {
            "kind": "surface",
            "name": sheet.name,
            "vertices": first.problem.n,
            "triangles": len(first.problem.F),
            "loops": [len(loop) for loop in first.problem.domain.loops],
        }
        arrays = {
            "positions": (V - V.mean(axis=0)).astype(np.float32),
            "triangles": first.problem.F.astype(np.uint32),
            "boundary": np.concatenate(first.problem.domain.loops).astype(np.int32),
        }
        self._tell(header, arrays)
        self._states.clear()
        if first.result.injective:
            self._keep(first, fit=True)
        else:
            self._finalize(first, fit=True)

    def handle(self, frame: Frame) -> None:
        """Execute the command of a message; errors are sent to the page."""
        what = frame.header.get("do")
        do = self._HANDLERS.get(what) if isinstance(what, str) else None
        try:
            if do is None:
                raise RequestError(f"unknown request {str(what)[:40]!r}")
            do(self, frame)
        except KeyboardInterrupt:
            self._show()
        except (ValueError, OSError, ArithmeticError, RuntimeError, ImportError) as error:
            self._drag_state = None
            self._tell({"kind": "note", "level": "error", "text": str(error)}, {})
            if self._states and not isinstance(error, RequestError):
                self._show()

    # --- surfaces and outlines ---------------------------------------------------------------------------------------

    def _load(self, frame: Frame) -> None:
        self.open(read_upload(validation.text(frame, "name"), validation.content(frame)))

    def _outline(self, frame: Frame) -> None:
        self._finalize(fit_to_outline(self._sheet, make_outline(frame.header.get("to"))), fit=True)

    def _drawing(self, frame: Frame) -> None:
        self._finalize(
            fit_to_outline(self._sheet, read_drawing(validation.text(frame, "name"), validation.content(frame))),
            fit=True,
        )

    def _polygon(self, frame: Frame) -> None:
        self._finalize(fit_to_outline(self._sheet, make_polygon(validation.points(frame))), fit=True)

    def _corner(self, frame: Frame) -> None:
        self._finalize(with_corner(self.state, validation.vertex(frame, self.state.problem.n)))

    def _corners(self, frame: Frame) -> None:
        outline = self.state.recipe.outline
        if outline is None:
            raise RequestError("corners need an outline: choose one first")
        self._finalize(fit_to_outline(self._sheet, outline, "auto"))

    def _flatten(self, frame: Frame) -> None:
        state = self.state
        self._busy("flattening")
        self._keep(free_boundary(state.problem, state.recipe, state.pins, self._step), fit=True)

    # --- drags and edits ---------------------------------------------------------------------------------------------

    def _pin(self, frame: Frame) -> None:
        state, vertex = self.state, validation.vertex(frame, self.state.problem.n)
        if vertex in np.concatenate(state.problem.domain.loops):
            raise RequestError("that vertex is on the boundary, which is already fixed: drag it in the map")
        if not state.result.injective:
            raise RequestError("pins need a map without inverted triangles, but none was found")
        if vertex not in state.pins:
            self._keep(pin_vertices(state, [*state.pins, vertex]))

    def _unpin(self, frame: Frame) -> None:
        vertex = validation.vertex(frame, self.state.problem.n)
        self._keep(pin_vertices(self.state, [v for v in self.state.pins if v != vertex]))

    def _grab(self, frame: Frame) -> None:
        state, vertex = self.state, validation.vertex(frame, self.state.problem.n)
        problem, result = state.problem, state.result
        share = drag_weights(vertex, problem.fixed, problem.target, problem.domain.loops, state.corners)
        # Without an injective map the drag only moves the boundary; a search follows at its end.
        follows = result.injective and state.in_place
        follower = Follower(problem, result.uv, result.certificate) if follows else None
        place = problem.target[np.flatnonzero(problem.fixed == vertex)[0]]
        self._drag_state = _DragState(place, share, follower)

    def _drag(self, frame: Frame) -> None:
        to, seq = validation.place(frame), validation.number(frame, "seq")
        drag = self._drag_state
        if drag is None:
            # The vertex could not be grabbed, but the page still waits for an answer.
            return self._tell_map({}, seq=seq)
        self._after = seq
        drag.goal = self.state.problem.target + drag.share[:, None] * (to - drag.place)
        if drag.follower is None:
            return self._tell_map({}, seq=seq, asked=drag.goal)
        drag.shown = shown = drag.follower.to(drag.goal, self._waiting)
        asked = None if shown.reached else drag.goal
        fields = {"state": "following", "reached": shown.reached}
        self._tell_map(fields, seq=seq, shown=(shown.uv, shown.certificate), asked=asked)

    def _drop(self, frame: Frame) -> None:
        drag, self._drag_state = self._drag_state, None
        if drag is None or drag.goal is None:
            return
        state = self.state.with_target(drag.goal)
        if drag.shown is not None and drag.shown.reached:
            result = MapResult(uv=drag.shown.uv, status=Status.INJECTIVE, certificate=drag.shown.certificate)
            state = replace(state, result=result)
        self._finalize(state)

    def _polish(self, frame: Frame) -> None:
        energy, slide = validation.text(frame, "energy"), frame.header.get("slide") is True
        if energy not in ENERGIES:
            raise RequestError(f"unknown energy {energy[:40]!r}: use {', '.join(ENERGIES)}")
        state = self.state
        curves: bool | BoundaryCurves = False
        if slide:
            outline = state.recipe.outline
            curves = True if outline is None else BoundaryCurves(outline.curves(), fixed=state.held)
            state = replace(state, problem=move_onto(curves, state.problem))
        self._finalize(state, energy=energy, slide=curves)

    def _undo(self, frame: Frame) -> None:
        self._go(-1)

    def _redo(self, frame: Frame) -> None:
        self._go(1)

    def _go(self, step: int) -> None:
        self._drag_state = None
        self._at = min(max(self._at + step, 0), len(self._states) - 1)
        self._show(fit=True)

    def _stop(self, frame: Frame) -> None:
        """Show the state again; the arrival of this message has already stopped the computation."""
        self._show()

    def _save(self, frame: Frame) -> None:
        state, recipe = self.state, self.state.recipe
        self._send(MAP, self._sheet.written(state.result.uv))
        if recipe.pinned:
            held = self._sheet.numbers(state.problem.fixed.tolist())
            self._send(FIXED, "".join(f"{v}\n" for v in held).encode())
        if recipe.outline is not None and recipe.outline.content is not None:
            self._send(recipe.outline.to, recipe.outline.content)

    def _send(self, name: str, content: bytes) -> None:
        self._tell({"kind": "file", "name": name}, {"content": np.frombuffer(content, dtype=np.uint8)})

    # --- final maps and updates of the page --------------------------------------------------------------------------

    def _finalize(self, state: SessionState, *, fit: bool = False, energy: str | None = None,
                slide: bool | BoundaryCurves = False) -> None:  # fmt: skip
        """Compute the map of a state, and add the state."""
        self._busy("polishing" if energy else "finding the map")
        before = state.result if state.result.injective and state.in_place else None
        done = compute_final_map(state.problem, before, energy=energy, slide=slide, callback=self._step)
        recipe = replace(state.recipe, energy=energy, slide=slide is not False, anew=done.anew)
        problem = state.problem
        if slide is not False and done.result.injective:
            problem = problem.with_target(done.result.uv[problem.fixed])
        kept = replace(state, problem=problem, result=done.result, recipe=recipe)
        self._keep(kept, fit=fit)

    def _step(self, step: Step) -> None:
        if self._waiting():
            raise KeyboardInterrupt
        self._tell({"kind": "progress", "flips": step.inverted, "energy": _finite(step.energy)}, {})

    def _keep(self, state: SessionState, *, fit: bool = False) -> None:
        """Add a state as the last one, and show it."""
        del self._states[self._at + 1 :]
        self._states.append(state)
        del self._states[:-MAX_STATES]
        self._at = len(self._states) - 1
        self._show(fit=fit)

    def _show(self, *, fit: bool = False) -> None:
        """Send the current state to the page."""
        state = self.state
        result, problem = state.result, state.problem
        there = state.in_place
        # A state without a map is solved from scratch.
        recipe = state.recipe if result.injective and there else replace(state.recipe, anew=True)
        fields = {
            "state": "settled",
            "reached": there,
            "fit": fit,
            "status": result.status.value,
            "undo": self._at > 0,
            "redo": self._at < len(self._states) - 1,
            "command": recipe.command(),
            "python": recipe.python(),
            "needs": recipe.files(),
            "anew": recipe.anew,
            "outline": None if state.recipe.outline is None else state.recipe.outline.to,
        }
        self._tell_map(fields, shown=(result.uv, result.certificate), asked=None if there else problem.target)
        self._tell({"kind": "obstructions", "obstructions": describe_obstructions(state)}, {})

    def _tell_map(
        self,
        fields: Mapping[str, Any],
        *,
        seq: int = -1,
        shown: tuple[FloatArray, Certificate] | None = None,
        asked: FloatArray | None = None,
    ) -> None:
        """Send the map and its certificate; without ``shown`` send only the target of the boundary."""
        state = self.state
        header = {
            "kind": "map",
            "seq": seq,
            "after": self._after,
            "fit": False,
            "origin": self._origin.tolist(),
            "corners": list(state.corners),
            "numbers": list(range(len(state.corners))),
            "pins": state.pins,
            **fields,
        }
        arrays: dict[str, Array] = {}
        if shown is not None:
            uv, certificate = shown
            header |= verdict(certificate) | self._measured.look(uv, now=seq < 0) | {"scale": self._measured.scale}
            arrays["places"] = (uv - self._origin).astype(np.float32)
            arrays["bad"] = bad_triangles(certificate)
        if asked is not None:
            edge = sum(map(len, state.problem.domain.loops))
            arrays["asked"] = (asked[:edge] - self._origin).astype(np.float32)
        self._tell(header, arrays)

    def _busy(self, what: str) -> None:
        self._tell({"kind": "busy", "what": what}, {})

    _HANDLERS: dict[str, Callable[[Session, Frame], None]] = {  # noqa: RUF012
        "load": _load,
        "outline": _outline,
        "drawing": _drawing,
        "polygon": _polygon,
        "corner": _corner,
        "corners": _corners,
        "flatten": _flatten,
        "pin": _pin,
        "unpin": _unpin,
        "grab": _grab,
        "drag": _drag,
        "drop": _drop,
        "polish": _polish,
        "undo": _undo,
        "redo": _redo,
        "stop": _stop,
        "save": _save,
    }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
