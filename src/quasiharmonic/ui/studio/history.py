"""What a session keeps: its states for undo and redo, its image, which state was saved, and the files that are saved.

The states are stored in a private folder, from which a new process continues after a reload or a crash. The files are
the model with its map, its image, and what the recorded command and script read.
"""

from __future__ import annotations

import pickle
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from quasiharmonic import io
from quasiharmonic.io.formats.gltf.reader import CarriedGltf
from quasiharmonic.io.looks import describe_unfitting, unfitting_textures
from quasiharmonic.io.models.textures import Texture
from quasiharmonic.ui.studio.recipes import MAP, START
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.validation import RequestError

#: Maximum number of states for undo.
MAX_STATES = 40
# Maximum number of triangles in all stored states together; fewer states of large models are stored.
_MAX_STORED = 4_000_000
_INDEX = "index"
#: Formats in which the page saves the map.
FORMATS = "obj", "glb", "ply"


class History:
    """States of a session; with a storage, they are stored after each change."""

    def __init__(self, storage: Storage | None = None) -> None:
        self._storage = storage
        self._states: list[tuple[int, SessionState]] = []  # With their numbers
        self._at = -1
        self._next = 0
        self._saved = 0
        self.texture: Texture | None = None

    def __bool__(self) -> bool:
        return bool(self._states)

    @property
    def state(self) -> SessionState:
        """The state that the page shows."""
        return self._states[self._at][1]

    def clear(self, texture: Texture | None) -> None:
        """Forget all states, for another model with its own image; the next state counts as saved."""
        self._states, self._at = [], -1
        self.texture, self._saved = texture, self._next

    def add(self, state: SessionState) -> None:
        """Add a state after the current one; later ones are forgotten."""
        del self._states[self._at + 1 :]
        self._states.append((self._next, state))
        self._next += 1
        del self._states[:-MAX_STATES]
        self._at = len(self._states) - 1

    def change(self, state: SessionState) -> None:
        """Replace the current state by one with the same map."""
        self._states[self._at] = self._states[self._at][0], state

    def go(self, step: int) -> None:
        """Undo (-1) or redo (1) one step, if there is one."""
        selected = self.state.selected
        self._at = min(max(self._at + step, 0), len(self._states) - 1)
        if max(selected) < len(self.state.islands):
            self.change(replace(self.state, selected=selected))

    def mark_saved(self) -> None:
        """Remember that the current state was saved; `write` stores it."""
        self._saved = self._states[self._at][0]

    def fields(self) -> dict[str, Any]:
        """Return what the controls of a page show about the history."""
        return {
            "undo": self._at > 0,
            "redo": self._at < len(self._states) - 1,
            "unsaved": self._states[self._at][0] != self._saved,
        }

    def write(self) -> None:
        """Store all states; of large models only those around the current one."""
        if self._storage is None or not self._states:
            return
        count = max(2, _MAX_STORED // max(len(self.state.mesh.F), 1))
        low = max(0, self._at + 1 - count)
        states = dict(self._states[low : low + count])
        self._storage.write(StoredSession(states, self._at - low, self.texture, self._saved))

    def restore(self) -> bool:
        """Take over the stored states; return whether there are any."""
        found = None if self._storage is None else self._storage.read()
        if found is None or not found.states:
            return False
        self._states, self._at = list(found.states.items()), found.at
        self.texture, self._saved = found.texture, found.saved
        self._next = max(found.states) + 1
        return True


class StoredSession(NamedTuple):
    """Contents of a session."""

    states: dict[int, Any]  # The undo history, by the numbers of the states, which name their files
    at: int  # The state that is shown
    texture: Texture | None
    saved: int  # Number of the state that was saved last


class Storage:
    """Snapshots in a folder that only this user can read. States are written once, however often they are shown.

    A model has a file of its own, which the states of the model share.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def write(self, snapshot: StoredSession) -> None:
        """Write a snapshot; states that are no longer part of it are removed."""
        kept = set()
        for number, state in snapshot.states.items():
            sheet = state.sheet
            contents = {f"sheet-{sheet.key}": sheet, f"state-{number}": (replace(state, sheet=None), sheet.key)}
            for name, content in contents.items():
                if not (self.folder / name).exists():
                    self._replace(name, content)
            kept |= set(contents)
        self._replace(_INDEX, snapshot._replace(states=dict.fromkeys(snapshot.states)))
        for path in self.folder.iterdir():
            if path.name.startswith(("state-", "sheet-")) and path.name not in kept:
                path.unlink(missing_ok=True)

    def read(self) -> StoredSession | None:
        """Return the last snapshot; None if there is none, or it is damaged."""
        sheet = cache(lambda key: self._load(f"sheet-{key}"))
        try:
            index: StoredSession = self._load(_INDEX)
            stored = {number: self._load(f"state-{number}") for number in index.states}
            return index._replace(states={k: replace(state, sheet=sheet(key)) for k, (state, key) in stored.items()})
        except Exception:  # A damaged pickle can raise anything; the session then starts anew.
            return None

    def _load(self, name: str) -> Any:
        return pickle.loads((self.folder / name).read_bytes())

    def _replace(self, name: str, content: object) -> None:
        """Write a file completely or not at all."""
        partial = self.folder / f"{name}.part"
        partial.write_bytes(pickle.dumps(content))
        partial.replace(self.folder / name)


def make_files(state: SessionState, form: str, texture: io.Texture | None) -> tuple[dict[str, bytes], list[str]]:
    """Return the files of a map by name, and sentences on what they lack and on textures that the map does not fit.

    The files are the model with its map, and its image; in OBJ, also those that the command and the script read.
    RequestError if there is no map.
    """
    if form not in FORMATS:
        raise RequestError(f"unknown format {form[:20]!r}: use {', '.join(FORMATS)}")
    name, mesh = MAP if form == "obj" else f"map.{form}", mapped_model(state, None if form == "ply" else texture)
    files, notes = _write(mesh, name), list[str]()
    if form == "obj":
        recipe = state.recipe
        files |= recipe.texts | ({} if recipe.start is None else _write(recipe.start, START))
    if unfitting := unfitting_textures(state.sheet.mesh, mesh):
        notes.append(describe_unfitting(unfitting))
    if lost := io.not_held(name, mesh):
        notes.append(f"{name} does not have: {'; '.join(lost)}")
    return files, notes


def mapped_model(state: SessionState, texture: io.Texture | None) -> io.MeshData:
    """Return the file's mesh with the map of a state and an image; RequestError if there is no map.

    A glTF file keeps its materials, unless the image is another one than its own.
    """
    if state.mesh.uv is None:
        raise RequestError("there is no map to save yet: press Unwrap or Flatten first")
    mesh = state.sheet.mesh if state.recipe.of_file else state.sheet.mapped_file(state.mesh)
    keeps = isinstance(mesh.carried, CarriedGltf) and texture == state.sheet.texture
    return mesh if texture is None or keeps else replace(mesh, texture=texture)


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
