"""A page's session: what a visitor does, one message after another, and what is told of it.

It knows neither sockets nor processes; whoever has a page hands over its messages, and carries what is told to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.apply.fitting import at_corners, held_in_place, laid_along
from quasiharmonic.arrays import FloatArray
from quasiharmonic.curves import Rails
from quasiharmonic.energy.sliding import moved_onto
from quasiharmonic.exact.certificate import Certificate
from quasiharmonic.flattening.flattened import flatten
from quasiharmonic.problem import Problem
from quasiharmonic.result import MapResult, Status, Step
from quasiharmonic.studio import asking
from quasiharmonic.studio.asking import Refused
from quasiharmonic.studio.following import Followed, Follower
from quasiharmonic.studio.grips import grip
from quasiharmonic.studio.moments import Measured, Moment, bad_triangles, held_at, told, verdict
from quasiharmonic.studio.outlines import Outline, outline_by_hand, outline_drawn, outline_named
from quasiharmonic.studio.protocol import Array, Frame
from quasiharmonic.studio.recipes import FIXED, MAP, Recipe
from quasiharmonic.studio.settling import settle
from quasiharmonic.studio.sheets import Sheet, dropped_sheet, first_sheet
from quasiharmonic.targets import filled, nearest_on_boundary
from quasiharmonic.targets.asked_corners import read_corners

#: States to go back to.
MOST_MOMENTS = 40
ENERGIES = "symmetric-dirichlet", "mips", "blend", "arap-barrier"
_FIRST_OUTLINE = "rect:1x1"

Tell = Callable[[Mapping[str, Any], Mapping[str, Array]], None]


class _Hand(NamedTuple):
    """A hand that holds a vertex: where all began, what moves with it, and what follows it, if there is a map to."""

    vertex: int
    target: FloatArray
    share: FloatArray
    follower: Follower | None


class Session:
    """What one page is doing.

    Parameters
    ----------
    tell : callable
        Takes headers and arrays to the page.
    waiting : callable
        Whether the visitor has done something that makes what is being computed needless.
    """

    def __init__(self, tell: Tell, waiting: Callable[[], bool] = lambda: False) -> None:
        self._tell, self._waiting = tell, waiting
        self._sheet: Sheet
        self._moments: list[Moment] = []
        self._at = -1
        self._hand: _Hand | None = None
        self._shown: Followed | None = None
        self._seq = -1
        self._asked_corners: dict[int, int] = {}

    @property
    def moment(self) -> Moment:
        """The state that the page shows."""
        return self._moments[self._at]

    def open(self, sheet: Sheet | None = None) -> None:
        """Begin with a surface, by default one of ours.

        Raises
        ------
        ValueError
            When it is none that can be mapped; the page then goes on with what it had.
        """
        sheet = first_sheet() if sheet is None else sheet
        first = self._first(sheet)
        self._sheet, self._moments, self._at, self._hand = sheet, [first], 0, None
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
        self._settle(first, fit=True, replacing=True)

    def handle(self, frame: Frame) -> None:
        """Do what a message asks for; what cannot be done is told."""
        what = frame.header.get("do")
        do = self._DOERS.get(what) if isinstance(what, str) else None
        try:
            if do is None:
                raise Refused(f"the page asks for {str(what)[:40]!r}, which is nothing that is done here")
            do(self, frame)
        except (ValueError, OSError, ArithmeticError, RuntimeError, ImportError) as error:
            self._hand = None
            self._tell({"kind": "note", "level": "error", "text": str(error)}, {})
            if self._moments and not isinstance(error, Refused):
                self._show()

    # --- surfaces and outlines ---------------------------------------------------------------------------------------

    def _first(self, sheet: Sheet) -> Moment:
        """The problem that a surface comes with: the places of its own map, or else a square."""
        island = sheet.island
        if not np.isnan(island.uv).any():
            problem = held_in_place(island, None).problem
            loops = np.concatenate(problem.domain.loops)
            pins = [] if sheet.fixed is None else np.setdiff1d(sheet.fixed, loops)
            fixed = np.concatenate([loops, np.asarray(pins, dtype=np.int64)])
            posed = Problem(island.V, island.F, fixed, island.uv[fixed])
            return Moment(posed, _nothing(posed), Recipe(sheet, pinned=len(pins) > 0))
        return self._laid(sheet, outline_named(_FIRST_OUTLINE), "auto")

    def _laid(self, sheet: Sheet, outline: Outline, corners: str | None) -> Moment:
        """A surface's boundary along an outline."""
        island = sheet.island
        asked = None if corners is None else read_corners(corners)
        try:
            fitted = laid_along(island.V, island.F, outline.contours, corners=asked)
        except ValueError:
            if corners != "auto":
                raise
            # An outline without corners, or fewer vertices than these need.
            corners, fitted = None, laid_along(island.V, island.F, outline.contours)
        contours = filled(outline.contours) if fitted.filled else outline.contours
        problem = fitted.problem
        at = tuple(at_corners(problem.fixed, problem.target, contours))
        # What the command calls these vertices may be another number.
        spoken = corners if asked is None or corners == "auto" or corners is None else _spoken(sheet, corners)
        return Moment(problem, _nothing(problem), Recipe(sheet, outline, spoken), at)

    def _load(self, frame: Frame) -> None:
        self.open(dropped_sheet(asking.text(frame, "name"), asking.content(frame)))

    def _outline(self, frame: Frame) -> None:
        self._onto(outline_named(frame.header.get("to")))

    def _drawing(self, frame: Frame) -> None:
        self._onto(outline_drawn(asking.text(frame, "name"), asking.content(frame)))

    def _polygon(self, frame: Frame) -> None:
        self._onto(outline_by_hand(asking.points(frame)))

    def _onto(self, outline: Outline, corners: str | None = "auto") -> None:
        self._settle(self._laid(self._sheet, outline, corners), fit=True)
        self._asked_corners: dict[int, int] = {} if corners in (None, "auto") else self._asked_corners

    def _corner(self, frame: Frame) -> None:
        outline = self.moment.recipe.outline
        if outline is None:
            raise Refused("corners are those of an outline: choose one first")
        problem = self.moment.problem
        near = problem.V[asking.vertex(frame, problem.n)]
        vertex = int(nearest_on_boundary(problem.V, problem.F, near[None])[0])
        count = max(len(self.moment.corners), 1)
        before = {v: k for v, k in self._asked_corners.items() if v != vertex}
        number = len(before) % count
        if len(before) >= count:
            before = {}
        asked = {**before, vertex: number}
        # Kept only where the outline can be followed so.
        moment = self._laid(self._sheet, outline, ",".join(f"{v}:{k}" for v, k in asked.items()))
        self._asked_corners = asked
        self._settle(moment)

    def _flatten(self, frame: Frame) -> None:
        moment = self.moment
        pins = np.array(moment.pins, dtype=np.int64)
        given = (
            {"fixed": pins, "target": moment.problem.target[held_at(moment.problem, moment.pins)]} if len(pins) else {}
        )
        self._busy("laying it flat")
        result = flatten(moment.problem.V, moment.problem.F, callback=self._step, **given)
        if not result.injective:
            raise Refused(result.status.value)
        recipe = Recipe(self._sheet, pinned=len(pins) > 0, free=True)
        problem = moment.problem.moved(result.uv[moment.problem.fixed])
        self._keep(Moment(problem, result, recipe), fit=True)

    # --- what the hand does ------------------------------------------------------------------------------------------

    def _pin(self, frame: Frame) -> None:
        moment, vertex = self.moment, asking.vertex(frame, self.moment.problem.n)
        if vertex in np.concatenate(moment.problem.domain.loops):
            raise Refused("that vertex is on the boundary, which is held already: drag it in the map")
        if not moment.result.injective:
            raise Refused("pins are put where the map is, and there is none without inverted triangles")
        if vertex not in moment.pins:
            self._hold([*moment.pins, vertex])

    def _unpin(self, frame: Frame) -> None:
        vertex = asking.vertex(frame, self.moment.problem.n)
        self._hold([v for v in self.moment.pins if v != vertex])

    def _hold(self, pins: list[int]) -> None:
        """Hold other vertices inside, where they are."""
        moment = self.moment
        fixed = np.concatenate([*moment.problem.domain.loops, np.array(pins, dtype=np.int64)])
        problem = Problem(moment.problem.V, moment.problem.F, fixed, moment.result.uv[fixed])
        held = replace(moment, problem=problem).with_target(problem.target)
        self._keep(replace(held, recipe=replace(held.recipe, pinned=bool(pins), anew=False)))

    def _grab(self, frame: Frame) -> None:
        moment, vertex = self.moment, asking.vertex(frame, self.moment.problem.n)
        problem = moment.problem
        share = grip(vertex, problem.fixed, problem.target, problem.domain.loops, moment.corners)
        follower = Follower(problem, moment.result.uv, moment.result.certificate) if self._followed(moment) else None
        self._hand, self._shown = _Hand(vertex, problem.target, share, follower), None

    def _followed(self, moment: Moment) -> bool:
        return moment.result.injective and np.array_equal(moment.result.uv[moment.problem.fixed], moment.problem.target)

    def _drag(self, frame: Frame) -> None:
        to, self._seq = asking.place(frame), asking.number(frame, "seq")
        if self._hand is None:
            # The hand has let go of what could not be held; the page waits for an answer all the same.
            return self._tell_map({}, seq=self._seq)
        target = self._target(to)
        if self._hand.follower is None:
            return self._tell_map({}, seq=self._seq, asked=target)
        shown = self._hand.follower.to(target, self._waiting)
        self._shown = shown
        self._goal = target
        state = {"state": "following", "reached": shown.reached}
        self._tell_map(
            state, seq=self._seq, shown=(shown.uv, shown.certificate), asked=None if shown.reached else target
        )

    def _target(self, to: FloatArray) -> FloatArray:
        assert self._hand is not None
        row = held_at(self.moment.problem, [self._hand.vertex])[0]
        self._goal = self._hand.target + self._hand.share[:, None] * (to - self._hand.target[row])
        return self._goal

    def _drop(self, frame: Frame) -> None:
        hand, shown, self._hand = self._hand, self._shown, None
        if hand is None or self._seq < 0:
            return
        self._seq = -1
        self._asked_corners: dict[int, int] = {}
        moment = self.moment.with_target(self._goal)
        if shown is not None and shown.reached:
            moment = replace(moment, result=_of(shown))
        self._settle(moment)

    def _polish(self, frame: Frame) -> None:
        energy, slide = asking.text(frame, "energy"), frame.header.get("slide") is True
        if energy not in ENERGIES:
            raise Refused(f"{energy[:40]!r} is no energy; there are {', '.join(ENERGIES)}")
        moment = self.moment
        rails: bool | Rails = False
        if slide:
            outline = moment.recipe.outline
            rails = True if outline is None else Rails(outline.curves(), held=self._held())
            moment = replace(moment, problem=moved_onto(rails, moment.problem))
        self._settle(moment, energy=energy, slide=rails)

    def _held(self) -> list[int]:
        """Corners that somebody has chosen."""
        chosen = self.moment.recipe.corners
        return list(self.moment.corners) if chosen == "auto" else list(self._asked_corners)

    def _undo(self, frame: Frame) -> None:
        self._go(-1)

    def _redo(self, frame: Frame) -> None:
        self._go(1)

    def _go(self, step: int) -> None:
        self._hand = None
        self._at = min(max(self._at + step, 0), len(self._moments) - 1)
        self._show(fit=True)

    def _stop(self, frame: Frame) -> None:
        """Nothing: it has ended what was going on by being there."""
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

    # --- maps at rest, and what is told ------------------------------------------------------------------------------

    def _settle(self, moment: Moment, *, fit: bool = False, replacing: bool = False, energy: str | None = None,
                slide: bool | Rails = False) -> None:  # fmt: skip
        """Find the map of a moment, and keep it."""
        self._busy("polishing" if energy else "finding the map")
        before = moment.result if moment.result.injective and self._followed(moment) else None
        done = settle(moment.problem, before, energy=energy, slide=slide, callback=self._step)
        recipe = replace(moment.recipe, energy=energy, slide=slide is not False, anew=done.anew)
        problem = moment.problem
        if slide is not False and done.result.injective:
            problem = problem.moved(done.result.uv[problem.fixed])
        kept = replace(moment, problem=problem, result=done.result, recipe=recipe)
        if replacing:
            self._moments.clear()
        self._keep(kept, fit=fit)

    def _step(self, step: Step) -> None:
        if self._waiting():
            raise KeyboardInterrupt
        self._tell({"kind": "progress", "flips": step.flipped, "energy": _finite(step.energy)}, {})

    def _keep(self, moment: Moment, *, fit: bool = False) -> None:
        """Make a moment the last one, and show it."""
        del self._moments[self._at + 1 :]
        self._moments.append(moment)
        del self._moments[:-MOST_MOMENTS]
        self._at = len(self._moments) - 1
        if moment.recipe.outline is None:
            self._asked_corners = {}
        self._show(fit=fit)

    def _show(self, *, fit: bool = False) -> None:
        """Tell all about the moment at hand."""
        moment = self.moment
        result, problem = moment.result, moment.problem
        there = np.array_equal(result.uv[problem.fixed], problem.target)
        state = {
            "state": "settled",
            "reached": there,
            "fit": fit,
            "status": result.status.value,
            "undo": self._at > 0,
            "redo": self._at < len(self._moments) - 1,
            "command": moment.recipe.command(),
            "python": moment.recipe.python(),
            "needs": moment.recipe.files(),
            "anew": moment.recipe.anew,
            "outline": None if moment.recipe.outline is None else moment.recipe.outline.to,
        }
        self._tell_map(state, shown=(result.uv, result.certificate), asked=None if there else problem.target)
        self._tell({"kind": "obstructions", "obstructions": told(result)}, {})

    def _tell_map(
        self,
        state: Mapping[str, Any],
        *,
        seq: int = -1,
        shown: tuple[FloatArray, Certificate] | None = None,
        asked: FloatArray | None = None,
    ) -> None:
        """Tell where the map is, and what is certain about it; only where its boundary is asked to be without one."""
        moment = self.moment
        header = {
            "kind": "map",
            "seq": seq,
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


def _of(shown: Followed) -> MapResult:
    return MapResult(uv=shown.uv, status=Status.INJECTIVE, certificate=shown.certificate)


def _nothing(problem: Problem) -> MapResult:
    """No map yet: every vertex at the middle of the target, which is never shown."""
    from quasiharmonic.exact.certificate import certify

    uv = np.broadcast_to(problem.target.mean(axis=0), (problem.n, 2)).copy()
    return MapResult(uv=uv, status=Status.INTERRUPTED, certificate=certify(problem.F, uv, boundary=False))


def _spoken(sheet: Sheet, corners: str) -> str:
    """Corners by the file's numbers of their vertices."""
    parts = [part.partition(":") for part in corners.split(",")]
    numbers = sheet.numbers([int(v) for v, _, _ in parts])
    return ",".join(f"{v}{colon}{k}" for v, (_, colon, k) in zip(numbers, parts, strict=True))


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
