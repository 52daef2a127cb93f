"""Interactive view of a surface and its map in a notebook cell; the kernel computes the maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io import MeshData, Texture, read_texture
from quasiharmonic.io.objects import MeshLike, mesh_arrays, stands_for_mesh
from quasiharmonic.io.registry import find_format
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult
from quasiharmonic.ui.studio.history import mapped_model, write_model
from quasiharmonic.ui.studio.page import bundle
from quasiharmonic.ui.studio.protocol import Array, MessageFrame, ProtocolError, decode, encode
from quasiharmonic.ui.studio.session import Session
from quasiharmonic.ui.studio.surface import PageSurface, make_sheet, read_sheet
from quasiharmonic.util.arrays import IntArray, describe, index_array
from quasiharmonic.util.hints import explain_missing

with explain_missing("the widget needs anywidget", extra="notebook"):
    import anywidget
    import traitlets

# Messages to repeat to a new view, in this order.
_REPEATED = "surface", "seams", "map", "obstructions", "image"


class MapWidget(anywidget.AnyWidget):  # type: ignore[misc]
    """View of a model and its map, as in ``qhm studio``: drag the outline, corners and pins, and the map follows.

    The buttons of the view unwrap, flatten and pack, draw seams, select islands, show an image, save and undo. The
    attributes are updated after each action.

    Parameters
    ----------
    surface : Problem, MapResult, (n, 2) or (n, 3) array, mesh or path
        A problem, a result, or a surface. A result keeps its boundary. A surface without a map starts with its boundary
        on a square; a file or a mesh with a map keeps its map. A model of several parts, or with defects, is unwrapped.
    F : (f, 3) array of int, optional
        Triangles, if ``surface`` is an array of positions.
    height : int
        Height of the view in pixels.

    Attributes
    ----------
    mesh : SeamedMesh
        The surface with its seams and the last final map of all islands; it does not change during a drag.
    selected : list of int
        Indices of the selected islands.
    result : MapResult
        The map of the first selected island.
    problem : Problem
        The problem of that map.
    image : Texture or None
        The image on the surface; the method `show_image` sets it.
    revision : int
        Number of maps, selections and images so far. ``view.observe(function, "revision")`` calls a function after
        each.
    vertices : (n,) int64
        Indices of the problem's vertices in the surface. A surface that is cut has copies of vertices.

    Raises
    ------
    ValueError
        If the surface cannot be mapped.
    ImportError
        If anywidget is not installed.
    """

    _esm = f"{bundle('widget')}\nexport default {{ render }};\n"
    height = traitlets.Int(480).tag(sync=True)
    revision = traitlets.Int(0)

    def __init__(
        self, surface: Problem | MapResult | ArrayLike | MeshLike, F: ArrayLike | None = None, *, height: int = 480
    ) -> None:
        super().__init__(height=height)
        self._sent: dict[str, bytes] = {}
        self._note = ""
        self._changed = False
        sheet = _sheet(surface, F)
        self._session = Session(self._tell)
        if not self._session.open(sheet):
            raise KeyboardInterrupt
        self._count()
        self.on_msg(self._receive)

    @property
    def result(self) -> MapResult:
        state = self._session.state
        return replace(state.result, V=state.problem.V)

    @property
    def vertices(self) -> IntArray:
        return self._session.state.active.island.vertices

    @property
    def problem(self) -> Problem:
        return self._session.state.problem

    @property
    def mesh(self) -> SeamedMesh:
        return self._session.state.mesh

    @property
    def selected(self) -> list[int]:
        return list(self._session.state.selected)

    def select(self, islands: int | Sequence[int]) -> None:
        """Select an island or several, to which the other methods apply; raise ValueError if one does not exist."""
        chosen = [islands] if isinstance(islands, int | np.integer) else list(islands)
        self._ask({"do": "select", "islands": index_array("islands", chosen).tolist()})

    def unwrap(self, *, max_stretch: float = 1.5, resolution: int = 2048, padding: float = 4) -> None:
        """Unwrap the whole model, as `quasiharmonic.unwrap` does; raise ValueError if that is not possible."""
        options = {"max_stretch": max_stretch}
        self._ask({"do": "unwrap", "options": options, "resolution": resolution, "padding": padding})

    def flatten(self) -> None:
        """Map with a free boundary, as `quasiharmonic.flatten` does; raise ValueError if that is not possible."""
        self._ask({"do": "flatten"})

    def outline(self, to: str) -> None:
        """Map the boundary to a named outline, such as ``"letter:R"``; raise ValueError if that is not possible."""
        self._ask({"do": "outline", "to": to})

    def polish(self, energy: str = "symmetric-dirichlet", *, slide: bool = False) -> None:
        """Lower the distortion, as `quasiharmonic.polish` does; raise ValueError if that is not possible."""
        self._ask({"do": "polish", "energy": energy, "slide": slide})

    def pack(self, *, resolution: int = 1024, padding: float = 4) -> None:
        """Pack all islands, as `quasiharmonic.atlas.pack_charts` does; raise ValueError if there is no map."""
        self._ask({"do": "pack", "resolution": resolution, "padding": padding})

    @property
    def image(self) -> Texture | None:
        return self._session.texture

    def show_image(self, path: str | PathLike[str]) -> None:
        """Show a PNG or JPEG file on the surface and in the map; raise an error if it is neither."""
        content = np.frombuffer(read_texture(path).data, dtype=np.uint8)
        self._ask({"do": "image"}, {"content": content})

    def save(self, path: str | PathLike[str]) -> None:
        """Write the model with its map, and the image if the format stores one; raise ValueError if there is no map."""
        path = Path(fspath(path))
        image = self.image if find_format(path, "write_map").image else None
        write_model(path, mapped_model(self._session.state, image))

    def undo(self) -> None:
        """Return to the previous map."""
        self._ask({"do": "undo"})

    def redo(self) -> None:
        """Revert the last undo."""
        self._ask({"do": "redo"})

    def _ask(self, header: dict[str, Any], arrays: Mapping[str, Array] | None = None) -> None:
        """Handle a message as if from the view; raise ValueError with the message that the view would show.

        KeyboardInterrupt if the user interrupts the kernel.
        """
        self._note = ""
        finished = self._session.handle(MessageFrame(header, dict(arrays or {})))
        self._count()
        if not finished:
            raise KeyboardInterrupt
        if self._note:
            raise ValueError(self._note)

    def _receive(self, _: object, content: object, buffers: list[Any]) -> None:
        """Handle a message from a view in the notebook."""
        try:
            frame = decode(bytes(buffers[0]) if buffers else b"")
        except ProtocolError as error:
            self._tell({"kind": "note", "level": "error", "text": str(error)}, {})
            return
        if frame.header.get("do") != "show":
            self._session.handle(frame)
            self._count()
            return
        for kind in _REPEATED:
            if kind in self._sent:
                self.send({"kind": kind, "first": True}, [self._sent[kind]])

    def _count(self) -> None:
        """Tell observers that the state changed, now that the message is handled."""
        if self._changed:
            self._changed = False
            self.revision += 1

    def _tell(self, header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        """Send to all views, and store the messages that later views need."""
        kind = header["kind"]
        if kind == "progress":  # cells do not show progress
            return
        data = encode(header, arrays)
        self._changed |= kind == "image" or header.get("state") == "settled"
        if kind == "note":
            self._note = header["text"]
        # A map message without positions contains only the target of the boundary and must not replace a full one.
        if kind in _REPEATED and (kind != "map" or "places" in arrays):
            self._sent[kind] = data
        self.send({"kind": kind}, [data])


def _sheet(surface: Any, F: ArrayLike | None) -> PageSurface:
    """Return the sheet that a session opens."""
    if F is not None:
        return make_sheet(MeshData(np.asarray(surface), np.asarray(F)), "mesh")
    if isinstance(surface, Problem):
        # Only the positions of fixed vertices are used.
        uv = np.zeros((surface.n, 2))
        uv[surface.fixed] = surface.target
        sheet = make_sheet(MeshData(surface.V, surface.F, source="").with_map(uv), "problem", surface.fixed)
        return replace(sheet, posed=True)
    if isinstance(surface, MapResult):
        if surface.V is None:
            raise ValueError("the result has no surface: pass its Problem, or V and F")
        return make_sheet(MeshData(surface.V, surface.F).with_map(surface.uv), "result")
    if isinstance(surface, str | PathLike):
        return read_sheet(Path(fspath(surface)))
    if isinstance(surface, MeshData):
        return make_sheet(surface, "mesh")
    if isinstance(surface, SeamedMesh):
        return make_sheet(_mesh_data(surface), "mesh")
    if stands_for_mesh(surface):
        mesh = MeshData(*mesh_arrays(surface))
        own_map = getattr(getattr(surface, "visual", None), "uv", None)  # The map of a mesh of trimesh
        return make_sheet(mesh if own_map is None else mesh.with_map(own_map), "mesh")
    raise ValueError(f"{describe(surface)} is not a surface: pass V and F, a mesh, a path, a Problem or a MapResult")


def _mesh_data(mesh: SeamedMesh) -> MeshData:
    """Return a mesh with its map; triangles without finite positions have no texture coordinates."""
    if mesh.uv is None:
        return MeshData(mesh.V, mesh.F)
    bare = np.asarray(np.isnan(mesh.uv).any(axis=1))
    return MeshData(mesh.V, mesh.F, vt=np.nan_to_num(mesh.uv), FT=np.where(bare[mesh.FT], -1, mesh.FT))
