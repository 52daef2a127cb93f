"""Session of a page: handle its messages and send updates.

The module is independent of sockets and processes. The caller passes in messages and transmits the updates.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quasiharmonic.energies.newton.sliding import moved_onto
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.ui.studio import validation as asking
from quasiharmonic.ui.studio.falloff import grip
from quasiharmonic.ui.studio.finalize import settle
from quasiharmonic.ui.studio.following import Followed, Follower
from quasiharmonic.ui.studio.outlines import outline_by_hand, outline_drawn, outline_named
from quasiharmonic.ui.studio.protocol import Array, Frame
from quasiharmonic.ui.studio.recipes import FIXED, MAP
from quasiharmonic.ui.studio.setup import first_moment, freed, holding, laid, with_corner
from quasiharmonic.ui.studio.state import Measured, SessionState, bad_triangles, told, verdict
from quasiharmonic.ui.studio.surface import Sheet, dropped_sheet, first_sheet
from quasiharmonic.ui.studio.validation import Refused
from quasiharmonic.util.arrays import FloatArray

#: Maximum number of states for undo.
MOST_MOMENTS = 40
ENERGIES = "symmetric-dirichlet", "mips", "blend", "arap-barrier"

Tell = Callable[[Mapping[str, Any], Mapping[str, Array]], None]


@dataclass(eq=False)
class _Hand:
    """State of a drag.

    Attributes
    ----------
    place : (2,) float64
        Position where the drag started.
    share : (k,) float64
        Share of the motion for each fixed vertex.
    follower : Follower or None
        Computes the maps, if the drag starts from an injective map.
    goal : (k, 2) float64 or None
        Current target positions of the fixed vertices.
    shown : Followed or None
        The last map.
    """

    place: FloatArray
    share: FloatArray
    follower: Follower | None
    goal: FloatArray | None = None
    shown: Followed | None = None


class Session:
    """Session of one page.

    Parameters
    ----------
    tell : callable
        Sends a header and arrays to the page.
    waiting : callable
        Returns whether a newer message makes the current computation unnecessary.
    """

    def __init__(self, tell: Tell, waiting: Callable[[], bool] = lambda: False) -> None:
        self._tell, self._waiting = tell, waiting
        self._sheet: Sheet
        self._moments: list[SessionState] = []
        self._at = -1
        self._hand: _Hand | None = None
        self._after = -1

    @property
    def moment(self) -> SessionState:
        """The state that the page shows."""
        return self._moments[self._at]

    def open(self, sheet: Sheet | None = None) -> None:
        """Open a surface, by default a built-in one.

        Raises
        ------
        ValueError
            If the surface cannot be mapped; the page then keeps its previous surface.
        """
        sheet = first_sheet() if sheet is None else sheet
        first = first_moment(sheet)
        self._sheet, self._hand, self._after = sheet, None, -1
        self._origin = first.problem.target.mean(axis=0)
        V = np.zeros((first.problem.n, 3), dtype=np.float64)
        V[:, : first.problem.V.shape[1]] = first.problem.V
        self._measured = Measured(first.problem.V, first.problem.F)
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
        self._moments.clear()
        if first.result.injective:
            self._keep(first, fit=True)
        else:
            self._settle(first, fit=True)

    def handle(self, frame: Frame) -> None:
        """Execute the command of a message; errors are sent to the page."""
        what = frame.header.get("do")
        do = self._DOERS.get(what) if isinstance(what, str) else None
        try:
            if do is None:
                raise Refused(f"unknown request {str(what)[:40]!r}")
            do(self, frame)
        except KeyboardInterrupt:
            self._show()
        except (ValueError, OSError, ArithmeticError, RuntimeError, ImportError) as error:
            self._hand = None
            self._tell({"kind": "note", "level": "error", "text": str(error)}, {})
            if self._moments and not isinstance(error, Refused):
                self._show()

    # --- surfaces and outlines ---------------------------------------------------------------------------------------

    def _load(self, frame: Frame) -> None:
        self.open(dropped_sheet(asking.text(frame, "name"), asking.content(frame)))

    def _outline(self, frame: Frame) -> None:
        self._settle(laid(self._sheet, outline_named(frame.header.get("to"))), fit=True)

    def _drawing(self, frame: Frame) -> None:
        self._settle(laid(self._sheet, outline_drawn(asking.text(frame, "name"), asking.content(frame))), fit=True)

    def _polygon(self, frame: Frame) -> None:
        self._settle(laid(self._sheet, outline_by_hand(asking.points(frame))), fit=True)

    def _corner(self, frame: Frame) -> None:
        self._settle(with_corner(self.moment, asking.vertex(frame, self.moment.problem.n)))

    def _corners(self, frame: Frame) -> None:
        outline = self.moment.recipe.outline
        if outline is None:
            raise Refused("corners need an outline: choose one first")
        self._settle(laid(self._sheet, outline, "auto"))

    def _flatten(self, frame: Frame) -> None:
        moment = self.moment
        self._busy("flattening")
        self._keep(freed(moment.problem, moment.recipe, moment.pins, self._step), fit=True)

    # --- drags and edits ---------------------------------------------------------------------------------------------

    def _pin(self, frame: Frame) -> None:
        moment, vertex = self.moment, asking.vertex(frame, self.moment.problem.n)
        if vertex in np.concatenate(moment.problem.domain.loops):
            raise Refused("that vertex is on the boundary, which is already fixed: drag it in the map")
        if not moment.result.injective:
            raise Refused("pins need a map without inverted triangles, but none was found")
        if vertex not in moment.pins:
            self._keep(holding(moment, [*moment.pins, vertex]))

    def _unpin(self, frame: Frame) -> None:
        vertex = asking.vertex(frame, self.moment.problem.n)
        self._keep(holding(self.moment, [v for v in self.moment.pins if v != vertex]))

    def _grab(self, frame: Frame) -> None:
        moment, vertex = self.moment, asking.vertex(frame, self.moment.problem.n)
        problem, result = moment.problem, moment.result
        share = grip(vertex, problem.fixed, problem.target, problem.domain.loops, moment.corners)
        # Without an injective map the drag only moves the boundary; a search follows at its end.
        follows = result.injective and moment.in_place
        follower = Follower(problem, result.uv, result.certificate) if follows else None
        place = problem.target[np.flatnonzero(problem.fixed == vertex)[0]]
        self._hand = _Hand(place, share, follower)

    def _drag(self, frame: Frame) -> None:
        to, seq = asking.place(frame), asking.number(frame, "seq")
        hand = self._hand
        if hand is None:
            # The vertex could not be grabbed, but the page still waits for an answer.
            return self._tell_map({}, seq=seq)
        self._after = seq
        hand.goal = self.moment.problem.target + hand.share[:, None] * (to - hand.place)
        if hand.follower is None:
            return self._tell_map({}, seq=seq, asked=hand.goal)
        hand.shown = shown = hand.follower.to(hand.goal, self._waiting)
        asked = None if shown.reached else hand.goal
        state = {"state": "following", "reached": shown.reached}
        self._tell_map(state, seq=seq, shown=(shown.uv, shown.certificate), asked=asked)

    def _drop(self, frame: Frame) -> None:
        hand, self._hand = self._hand, None
        if hand is None or hand.goal is None:
            return
        moment = self.moment.with_target(hand.goal)
        if hand.shown is not None and hand.shown.reached:
            result = MapResult(uv=hand.shown.uv, status=Status.INJECTIVE, certificate=hand.shown.certificate)
            moment = replace(moment, result=result)
        self._settle(moment)

    def _polish(self, frame: Frame) -> None:
        energy, slide = asking.text(frame, "energy"), frame.header.get("slide") is True
        if energy not in ENERGIES:
            raise Refused(f"unknown energy {energy[:40]!r}: use {', '.join(ENERGIES)}")
        moment = self.moment
        rails: bool | BoundaryCurves = False
        if slide:
            outline = moment.recipe.outline
            rails = True if outline is None else BoundaryCurves(outline.curves(), fixed=moment.held)
            moment = replace(moment, problem=moved_onto(rails, moment.problem))
        self._settle(moment, energy=energy, slide=rails)

    def _undo(self, frame: Frame) -> None:
        self._go(-1)

    def _redo(self, frame: Frame) -> None:
        self._go(1)

    def _go(self, step: int) -> None:
        self._hand = None
        self._at = min(max(self._at + step, 0), len(self._moments) - 1)
        self._show(fit=True)

    def _stop(self, frame: Frame) -> None:
        """Show the state again; the arrival of this message has already stopped the computation."""
        self._show()

    def _save(self, frame: Frame) -> None:
        moment, recipe = self.moment, self.moment.recipe
        self._send(MAP, self._sheet.written(moment.result.uv))
        if recipe.pinned:
            held = self._sheet.numbers(moment.problem.fixed.tolist())
            self._send(FIXED, "".join(f"{v}\n" for v in held).encode())
        if recipe.outline is not None and recipe.outline.content is not None:
            self._send(recipe.outline.to, recipe.outline.content)

    def _send(self, name: str, content: bytes) -> None:
        self._tell({"kind": "file", "name": name}, {"content": np.frombuffer(content, dtype=np.uint8)})

    # --- final maps and updates of the page --------------------------------------------------------------------------

    def _settle(self, moment: SessionState, *, fit: bool = False, energy: str | None = None,
                slide: bool | BoundaryCurves = False) -> None:  # fmt: skip
        """Compute the map of a state, and add the state."""
        self._busy("polishing" if energy else "finding the map")
        before = moment.result if moment.result.injective and moment.in_place else None
        done = settle(moment.problem, before, energy=energy, slide=slide, callback=self._step)
        recipe = replace(moment.recipe, energy=energy, slide=slide is not False, anew=done.anew)
        problem = moment.problem
        if slide is not False and done.result.injective:
            problem = problem.with_target(done.result.uv[problem.fixed])
        kept = replace(moment, problem=problem, result=done.result, recipe=recipe)
        self._keep(kept, fit=fit)

    def _step(self, step: Step) -> None:
        if self._waiting():
            raise KeyboardInterrupt
        self._tell({"kind": "progress", "flips": step.inverted, "energy": _finite(step.energy)}, {})

    def _keep(self, moment: SessionState, *, fit: bool = False) -> None:
        """Add a state as the last one, and show it."""
        del self._moments[self._at + 1 :]
        self._moments.append(moment)
        del self._moments[:-MOST_MOMENTS]
        self._at = len(self._moments) - 1
        self._show(fit=fit)

    def _show(self, *, fit: bool = False) -> None:
        """Send the current state to the page."""
        moment = self.moment
        result, problem = moment.result, moment.problem
        there = moment.in_place
        # A state without a map is solved from scratch.
        recipe = moment.recipe if result.injective and there else replace(moment.recipe, anew=True)
        state = {
            "state": "settled",
            "reached": there,
            "fit": fit,
            "status": result.status.value,
            "undo": self._at > 0,
            "redo": self._at < len(self._moments) - 1,
            "command": recipe.command(),
            "python": recipe.python(),
            "needs": recipe.files(),
            "anew": recipe.anew,
            "outline": None if moment.recipe.outline is None else moment.recipe.outline.to,
        }
        self._tell_map(state, shown=(result.uv, result.certificate), asked=None if there else problem.target)
        self._tell({"kind": "obstructions", "obstructions": told(moment)}, {})

    def _tell_map(
        self,
        state: Mapping[str, Any],
        *,
        seq: int = -1,
        shown: tuple[FloatArray, Certificate] | None = None,
        asked: FloatArray | None = None,
    ) -> None:
        """Send the map and its certificate; without ``shown`` send only the target of the boundary."""
        moment = self.moment
        header = {
            "kind": "map",
            "seq": seq,
            "after": self._after,
            "fit": False,
            "origin": self._origin.tolist(),
            "corners": list(moment.corners),
            "numbers": list(range(len(moment.corners))),
            "pins": moment.pins,
            **state,
        }
        arrays: dict[str, Array] = {}
        if shown is not None:
            uv, certificate = shown
            header |= verdict(certificate) | self._measured.look(uv, now=seq < 0) | {"scale": self._measured.scale}
            arrays["places"] = (uv - self._origin).astype(np.float32)
            arrays["bad"] = bad_triangles(certificate)
        if asked is not None:
            edge = sum(map(len, moment.problem.domain.loops))
            arrays["asked"] = (asked[:edge] - self._origin).astype(np.float32)
        self._tell(header, arrays)

    def _busy(self, what: str) -> None:
        self._tell({"kind": "busy", "what": what}, {})

    _DOERS: dict[str, Callable[[Session, Frame], None]] = {  # noqa: RUF012
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
