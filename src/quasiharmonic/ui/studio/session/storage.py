"""Snapshots of a session in a private folder, from which a new process continues after a reload or a crash."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from quasiharmonic.io.models.textures import Texture

_INDEX = "index"


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
