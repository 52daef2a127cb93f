"""Session of a page: handle its messages, send updates, and make the files that it saves.

The module is independent of sockets and processes. The caller passes in messages and transmits the updates.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic import io
from quasiharmonic.io.models.textures import texture_of
from quasiharmonic.ui.studio import operations, validation
from quasiharmonic.ui.studio.drag import Follower, drag_weights
from quasiharmonic.ui.studio.islands import (
    add_edges,
    add_mirrored,
    find_chain,
    find_seams,
    move_islands,
    pack_all,
    remove_edges,
    shortest_path,
    stitch_seam,
    weld_seams,
)
from quasiharmonic.ui.studio.protocol import MessageFrame
from quasiharmonic.ui.studio.recipes import MAP, START
from quasiharmonic.ui.studio.setup import (
    make_first_state,
    open_without_map,
    pin_vertices,
    read_options,
    turn_over,
    unwrap_model,
    with_corner,
    with_start,
)
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.surface import PageSurface, make_first_sheet, read_upload
from quasiharmonic.ui.studio.updates import DragState, PageUpdates
from quasiharmonic.ui.studio.validation import Outline, RequestError, make_outline, make_polygon, read_drawing
from quasiharmonic.util.arrays import IntArray
from quasiharmonic.util.options import ENERGIES

_LARGEST_TEXTURE = 16_384
#: Formats in which the page saves the map.
FORMATS = "obj", "glb", "ply"


class Session(PageUpdates):
    """Session of one page: handles its messages."""

    def open(self, sheet: PageSurface | None = None) -> None:
        """Open a model, by default a built-in one; its surface is shown before there is a map.

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
        except operations.Interrupted as end:
            self._keep_best(end)
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

    def _keep_best(self, end: operations.Interrupted) -> None:
        """After Stop, keep the map that an interrupted step had, if it is injective."""
        best = operations.as_it_is(self.state, end.mesh, operations.saved_start(end.mesh), keep=("pins",))
        if self._stopped and best.injective:
            self._keep(best)
        else:
            self._show()

    # --- models, selection and seams ---------------------------------------------------------------------------------

    def _do_load(self, frame: MessageFrame) -> None:
        self.open(read_upload(validation.text(frame, "name"), validation.content(frame)))

    def _do_image(self, frame: MessageFrame) -> None:
        texture = texture_of(validation.content(frame))
        if texture is None:
            raise RequestError("this file is not a PNG or JPEG image")
        self._history.texture = texture
        self._store()
        self._send_image()

    def _do_select(self, frame: MessageFrame) -> None:
        chosen = validation.indices(frame, "islands", len(self.state.islands))
        self._history.change(replace(self.state, selected=tuple(chosen or range(len(self.state.islands)))))
        self._show()

    def _do_seam(self, frame: MessageFrame) -> None:
        """Add the shortest path between two vertices to the seams, or to the edges that must not become seams."""
        state, mesh = self.state, self.state.mesh
        start, end = self._model_vertex(frame, "start"), self._model_vertex(frame, "vertex")
        if start == end:
            return
        path = self._add_mirrored(frame, shortest_path(mesh.V, mesh.F, start, end))
        if frame.header.get("forbid") is True:
            self._keep(replace(state, forbidden=add_edges(state.forbidden, path)))
        else:
            kept = remove_edges(state.forbidden, path, len(mesh.V))
            self._keep(replace(state, drawn=add_edges(find_seams(state), path), forbidden=kept))

    def _do_erase(self, frame: MessageFrame) -> None:
        """Remove the nearest chain of seams, or of edges that must not become seams."""
        state, V = self.state, self.state.mesh.V
        seams = find_seams(state)
        chain = find_chain(add_edges(seams, state.forbidden), V, self._model_vertex(frame, "vertex"))
        chain = self._add_mirrored(frame, chain)
        left = remove_edges(seams, chain, len(V))
        drawn = state.drawn if len(left) == len(seams) else left
        self._keep(replace(state, drawn=drawn, forbidden=remove_edges(state.forbidden, chain, len(V))))

    def _add_mirrored(self, frame: MessageFrame, edges: IntArray) -> IntArray:
        """Return edges with their mirror images, if the message names the axis of a symmetry."""
        axis = frame.header.get("symmetry")
        surface = self.state.sheet.surface
        return add_mirrored(edges, surface.V, surface.F, axis if axis in ("x", "y", "z") else None)

    def _do_stitch(self, frame: MessageFrame) -> None:
        self._refuse_drawn()
        operations.require_map(replace(self.state, selected=tuple(range(len(self.state.islands)))))
        self._keep(stitch_seam(self.state, self._model_vertex(frame, "vertex")), fit=True)

    def _do_weld(self, frame: MessageFrame) -> None:
        self._refuse_drawn()
        operations.require_map(replace(self.state, selected=tuple(range(len(self.state.islands)))))
        self._keep(weld_seams(self.state, 1 / _read_size(frame, 2048)["resolution"]))

    def _do_repair(self, frame: MessageFrame) -> None:
        self._refuse_drawn()
        operations.require_map(replace(self.state, selected=tuple(range(len(self.state.islands)))))
        self._tell_busy("repairing")
        self._keep(operations.repair_islands(self.state, self._step))

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
        self._tell_busy("finding the map")
        self._keep(operations.map_to_outline(self.state, outline, corners, self._step), fit=True)

    def _do_corner(self, frame: MessageFrame) -> None:
        k, vertex = self._find(frame)
        self._tell_busy("finding the map")
        self._keep(with_corner(self.state, k, vertex, self._step))

    def _do_corners(self, frame: MessageFrame) -> None:
        outline = self.state.active.outline
        if outline is None:
            raise RequestError("corners need an outline: choose one under Boundary first")
        self._map_to(outline, "auto")

    def _do_flatten(self, frame: MessageFrame) -> None:
        self._tell_busy("flattening")
        self._keep(operations.flatten_islands(self.state, self._step), fit=True)

    def _do_unwrap(self, frame: MessageFrame) -> None:
        options = read_options(frame) | _read_size(frame, 2048)
        which = {name: frame.header.get(name) is True for name in ("keep_seams", "selected")}
        self._tell_busy("unwrapping")
        self._keep(unwrap_model(self.state, self._step, **which, **options), fit=True)

    def _do_place(self, frame: MessageFrame) -> None:
        """Move, rotate, scale or mirror the selected islands."""
        by, turn = validation.place(frame), float(validation.amount(frame, "turn", -360, 360, 0))
        scale, mirror = float(validation.amount(frame, "scale", 1e-3, 1e3, 1)), frame.header.get("mirror") is True
        texels = _read_size(frame, 2048)["resolution"] if "resolution" in frame.header else None
        # The page has already moved them.
        self._tell_busy("moving the islands")
        self._refuse_drawn()
        self._keep(move_islands(self.state, by, turn, scale, mirror, texels))

    def _do_pack(self, frame: MessageFrame) -> None:
        self._refuse_drawn()
        operations.require_injective(replace(self.state, selected=tuple(range(len(self.state.islands)))))
        size = _read_size(frame, 1024)
        self._tell_busy("packing")
        self._keep(pack_all(self.state, **size), fit=True)

    def _do_polish(self, frame: MessageFrame) -> None:
        energy, slide = validation.text(frame, "energy"), frame.header.get("slide") is True
        if energy not in ENERGIES:
            raise RequestError(f"unknown energy {energy[:40]!r}: use {', '.join(ENERGIES)}")
        self._refuse_drawn()
        operations.require_injective(self.state)
        self._tell_busy("lowering the distortion")
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
        self._drag_state = DragState(k, place, share, follower)

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
        self._tell_busy("finding the map")
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
        files = _list_files(self.state, form if isinstance(form, str) else "", self._history.texture)
        for name, content in files.items():
            self._tell({"kind": "file", "name": name}, {"content": np.frombuffer(content, dtype=np.uint8)})
        self._history.mark_saved()
        self._store()
        self._tell({"kind": "saved"}, {})


def _read_size(frame: MessageFrame, resolution: int) -> dict[str, Any]:
    """Return resolution, by default the given one, and padding of a texture."""
    return {
        "resolution": int(validation.amount(frame, "resolution", 16, _LARGEST_TEXTURE, resolution)),
        "padding": float(validation.amount(frame, "padding", 0, 64, 4)),
    }


def _list_files(state: SessionState, form: str, texture: io.Texture | None) -> dict[str, bytes]:
    """Return the files of a map by name: the model with its map, and its image.

    In OBJ, also those that the command and the script read. RequestError if there is no map.
    """
    if form not in FORMATS:
        raise RequestError(f"unknown format {form[:20]!r}: use {', '.join(FORMATS)}")
    mesh = mapped_model(state, None if form == "ply" else texture)
    files = _write(mesh, MAP if form == "obj" else f"map.{form}")
    if form == "obj":
        recipe = state.recipe
        files |= recipe.texts | ({} if recipe.start is None else _write(recipe.start, START))
    return files


def mapped_model(state: SessionState, texture: io.Texture | None) -> io.MeshData:
    """Return the file's mesh with the map of a state and an image; RequestError if there is no map."""
    if state.mesh.uv is None:
        raise RequestError("there is no map to save yet: press Unwrap or Flatten first")
    mesh = state.sheet.mesh if state.recipe.of_file else state.sheet.mapped_file(state.mesh)
    return mesh if texture is None else replace(mesh, texture=texture)


def write_model(path: Path, mesh: io.MeshData) -> None:
    """Write a mesh in the format of the suffix; without a map as OBJ."""
    if mesh.FT is None:
        io.write_obj(path, mesh)
    else:
        io.write_mapped(path, mesh)


def _write(mesh: io.MeshData, name: str) -> dict[str, bytes]:
    """Return a mesh as a file, with the files that belong to it."""
    with tempfile.TemporaryDirectory() as folder:
        write_model(Path(folder) / name, mesh)
        return {each.name: each.read_bytes() for each in sorted(Path(folder).iterdir())}
