"""Operators that work in a thread: Blender stays responsive, shows progress, and Esc cancels without changes."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import bpy

from .advice import translate_advice
from .surface import Refused, require_local

# Seconds between two checks of a thread.
_LOOK = 0.05
# Steps after which the indicator of a search of unknown length is full once.
_TURN = 20

# A function whose argument is a callback for its steps: `Step` of a search, or `UnwrapStep`.
Work = Callable[[Callable[[Any], None]], Any]


class Job:
    """A function that runs in its own thread.

    Parameters
    ----------
    work : callable
        Receives a callback, which it must call at every step.
    """

    def __init__(self, work: Work) -> None:
        self.step: Any = None
        self.steps = 0
        self.error: BaseException | None = None
        self.result: Any = None
        self._work = work
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Request the work to stop at its next step."""
        self._stopped.set()

    @property
    def stopped(self) -> bool:
        """Whether a stop was requested."""
        return self._stopped.is_set()

    @property
    def running(self) -> bool:
        """Whether the thread is still running."""
        return self._thread.is_alive()

    def wait(self) -> None:
        """Wait until the thread ends."""
        self._thread.join()

    def _run(self) -> None:
        try:
            self.result = self._work(self._heard)
        except BaseException as error:
            self.error = error

    def _heard(self, step: Any) -> None:
        self.step = step
        self.steps += 1
        if self.stopped:
            raise KeyboardInterrupt


def describe_progress(job: Job) -> tuple[str, float | None]:
    """Return what a job is doing, and the finished share of its phase; None if its length is unknown."""
    step = job.step
    if step is None:
        return "starting", None
    if hasattr(step, "phase"):
        return f"{step.phase} {step.done} of {step.total}", step.done / max(step.total, 1)
    return f"step {job.steps}, energy {step.energy:.4g}", None


class Working(bpy.types.Operator):
    """An operator whose work is a `Job`: `prepare` returns the work, `finish` receives its result."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012 (Blender's convention)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object is a mesh."""
        thing = context.active_object
        return thing is not None and thing.type == "MESH"

    def prepare(self, context: bpy.types.Context) -> Work:
        """Return the work for the thread. The work must not access Blender's data."""
        raise NotImplementedError

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write the result of the work."""
        raise NotImplementedError

    def find_objects(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """Return the mesh objects to work on, the active one first: in edit mode those edited.

        Objects whose mesh is linked from another file are left out and reported. If it is the active one, raise
        `Refused`.
        """
        active, things = context.active_object, self.edited
        require_local(active)
        if self.mode != "EDIT":
            things = context.selected_objects if active.select_get() else []
        others = [thing for thing in things if thing.type == "MESH" and thing != active]
        if linked := [thing.name for thing in others if thing.data.library is not None]:
            said = f"linked from another file, so left unchanged: {list_names(linked)}"
            self.report({"INFO"}, f"{self.bl_label}: {said}")
        return [active, *(thing for thing in others if thing.data.library is None)]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Run the work immediately, as scripts expect."""
        return self._guarded(context, self._at_once)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Run the work in a thread, as buttons expect."""
        if bpy.app.background:
            return self.execute(context)
        return self._guarded(context, self._begin)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Check the thread at every timer event."""
        if event.type == "ESC" and event.value == "PRESS":
            self._job.stop()
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        manager = context.window_manager
        manager.progress_update(self._job.steps % 100)
        text, share = describe_progress(self._job)

        def draw(header: Any, _: bpy.types.Context) -> None:
            label = f"{self.bl_label}: {text} (Esc cancels)"
            if share is None:
                header.layout.progress(text=label, factor=self._job.steps % _TURN / _TURN, type="RING")
            else:
                header.layout.progress(text=label, factor=share, type="BAR")

        context.workspace.status_text_set(draw)
        if self._job.running:
            return {"RUNNING_MODAL"}
        manager.event_timer_remove(self._timer)
        manager.progress_end()
        context.workspace.status_text_set(None)
        return self._guarded(context, self._end)

    def _at_once(self, context: bpy.types.Context) -> set[str]:
        self._job = Job(self.prepare(context))
        self._job.start()
        self._job.wait()
        return self._end(context)

    def _begin(self, context: bpy.types.Context) -> set[str]:
        self._job = Job(self.prepare(context))
        manager = context.window_manager
        self._timer = manager.event_timer_add(_LOOK, window=context.window)
        manager.progress_begin(0, 100)
        manager.modal_handler_add(self)
        self._job.start()
        return {"RUNNING_MODAL"}

    def _end(self, context: bpy.types.Context) -> set[str]:
        if self._job.stopped or isinstance(self._job.error, KeyboardInterrupt):
            self.report({"INFO"}, f"{self.bl_label}: cancelled, nothing has changed")
            return {"CANCELLED"}
        if self._job.error is not None:
            raise self._job.error
        self.finish(context, self._job.result)
        return {"FINISHED"}

    def _guarded(self, context: bpy.types.Context, act: Callable[[bpy.types.Context], set[str]]) -> set[str]:
        """Call ``act`` in object mode, where mesh data is up to date, and report errors to the user."""
        with _object_mode(context) as (self.mode, self.edited):
            try:
                return act(context)
            except (Refused, ValueError, ImportError) as error:
                self.report({"ERROR"}, f"{self.bl_label}: {translate_advice(' '.join(str(error).split()))}")
            except Exception as error:
                # An error of the extension. The traceback goes to the console.
                traceback.print_exc()
                name = type(error).__name__
                self.report({"ERROR"}, f"{self.bl_label}: internal error, nothing has changed. {name}: {error}")
            return {"CANCELLED"}


def list_names(names: list[str]) -> str:
    """Return the first three names."""
    return ", ".join(names[:3]) + (", …" if len(names) > 3 else "")


@contextmanager
def _object_mode(context: bpy.types.Context) -> Iterator[tuple[str, list[bpy.types.Object]]]:
    """Leave the current mode, and enter it again with the same objects; yields the mode and these objects."""
    mode, objects = context.active_object.mode, list(context.objects_in_mode)
    if mode == "OBJECT":
        yield mode, []
        return
    bpy.ops.object.mode_set(mode="OBJECT")
    try:
        yield mode, objects
    finally:
        # Edit mode is entered by all selected objects.
        selected = list(context.selected_objects)
        for thing in {*selected, *objects}:
            thing.select_set(thing in objects)
        bpy.ops.object.mode_set(mode=mode)
        for thing in {*selected, *objects}:
            thing.select_set(thing in selected)
