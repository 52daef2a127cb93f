"""A test client of the studio's session that replaces the browser page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic import boundary_loops, io
from quasiharmonic.surfaces import cat
from quasiharmonic.ui.studio.protocol import MessageFrame, decode, encode
from quasiharmonic.ui.studio.session import Session
from quasiharmonic.ui.studio.surface import make_sheet, read_sheet


class Visitor:
    """A client with a session, which records every frame that the session sends.

    Its model is a file, or an array of positions and one of triangles.
    """

    def __init__(
        self,
        V=None,
        F=None,
        name="surface.obj",
        waiting=lambda: False,
        storage=None,
        restore=False,
        stops=lambda: False,
    ):
        self.frames: list[MessageFrame] = []
        self.session = Session(self._hear, waiting, storage, stops)
        if restore:
            assert self.session.restore()
            return
        if isinstance(V, Path):
            self.session.open(read_sheet(V))
            return
        V, F = cat(10) if V is None else (V, F)
        self.session.open(make_sheet(io.MeshData(V, F, source=name), name))

    def _hear(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        # Encode to bytes and back, as a socket would.
        self.frames.append(decode(encode(header, arrays)))

    def does(self, what: str, arrays: Mapping[str, np.ndarray] | None = None, **words: Any) -> list[MessageFrame]:
        """Send a message; return the frames received since."""
        before = len(self.frames)
        self.session.handle(decode(encode({"do": what, **words}, arrays)))
        return self.frames[before:]

    def drags(self, vertex: int, *places: tuple[float, float]) -> list[MessageFrame]:
        """Grab a vertex, drag it along positions and drop it; return the map frames in between."""
        self.does("grab", vertex=vertex)
        shown = [self.does("drag", seq=i, to=list(place))[-1] for i, place in enumerate(places)]
        self.does("drop")
        return shown

    def last(self, kind: str) -> MessageFrame:
        """The last received frame of a kind."""
        return next(frame for frame in reversed(self.frames) if frame.header["kind"] == kind)

    def place(self, vertex: int) -> np.ndarray:
        """The position of a vertex in the map."""
        return self.session.state.result.uv[vertex]

    def files(self) -> dict[str, bytes]:
        """The saved files, by name."""
        frames = [frame for frame in self.does("save") if frame.header["kind"] == "file"]
        return {frame.header["name"]: frame.arrays["content"].tobytes() for frame in frames}


def boundary(V: np.ndarray, F: np.ndarray) -> np.ndarray:
    """The boundary loop of a disk."""
    (loop,) = boundary_loops(F, len(V))
    return loop
