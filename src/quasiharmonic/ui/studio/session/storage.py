"""Snapshots of a session in a private folder, from which a new process continues after a reload or a crash."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any, NamedTuple

from quasiharmonic.io.models.textures import Texture

_INDEX = "index"


class Snapshot(NamedTuple):
    """Contents of a session."""

    states: list[Any]  # The undo history
    at: int  # The state that is shown
    texture: Texture | None
    saved: int  # Number of the state that was saved last
    numbers: list[int]  # Numbers of the states, which name their files


class Storage:
    """Snapshots in a folder that only this user can read. States are written once, however often they are shown."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def write(self, snapshot: Snapshot) -> None:
        """Write a snapshot; states that are no longer part of it are removed."""
        shared: list[Any] = []
        for number, state in zip(snapshot.numbers, snapshot.states, strict=True):
            path = self._path(number)
            if not path.exists():
                _replace(path, _dump(state, shared, self.folder))
        index = snapshot._replace(states=[])
        _replace(self.folder / _INDEX, pickle.dumps(index))
        names = {self._path(number).name for number in snapshot.numbers}
        sheets = {f"sheet-{_key(state.sheet)}" for state in snapshot.states}
        for path in self.folder.iterdir():
            if path.name.startswith("state-") and path.name not in names:
                path.unlink(missing_ok=True)
            if path.name.startswith("sheet-") and path.name not in sheets:
                path.unlink(missing_ok=True)

    def read(self) -> Snapshot | None:
        """Return the last snapshot; None if there is none, or it is damaged."""
        try:
            index: Snapshot = pickle.loads((self.folder / _INDEX).read_bytes())
            sheets: dict[str, Any] = {}
            states = [_load(self._path(number).read_bytes(), sheets, self.folder) for number in index.numbers]
            return index._replace(states=states)
        except Exception:  # A damaged pickle can raise anything; the session then starts anew.
            return None

    def _path(self, number: int) -> Path:
        return self.folder / f"state-{number}"


def _key(sheet: Any) -> str:
    """Return a name of a model that stays the same in other processes."""
    found = sheet.__dict__.get("_key")
    if found is None:
        import secrets

        found = sheet.__dict__["_key"] = secrets.token_hex(8)
    return str(found)


def _dump(state: Any, shared: list[Any], folder: Path) -> bytes:
    """Return a state without its model, which is written to a file of its own."""
    sheet = state.sheet
    path = folder / f"sheet-{_key(sheet)}"
    if not path.exists():
        _replace(path, pickle.dumps(sheet))
    shared.append(sheet)
    buffer = io.BytesIO()

    # Python 3.13.0 does not let these methods be assigned.
    class Pickler(pickle.Pickler):
        def persistent_id(self, value: Any) -> str | None:
            return _key(value) if value is sheet else None

    Pickler(buffer, protocol=5).dump(state)
    return buffer.getvalue()


def _load(data: bytes, sheets: dict[str, Any], folder: Path) -> Any:
    class Unpickler(pickle.Unpickler):
        def persistent_load(self, key: Any) -> Any:
            if key not in sheets:
                sheets[key] = pickle.loads((folder / f"sheet-{key}").read_bytes())
            return sheets[key]

    return Unpickler(io.BytesIO(data)).load()


def _replace(path: Path, data: bytes) -> None:
    """Write a file completely or not at all."""
    partial = path.with_name(f"{path.name}.part")
    partial.write_bytes(data)
    partial.replace(path)
